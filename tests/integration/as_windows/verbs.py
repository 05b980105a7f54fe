"""Runs verbs of the command line one after the other: a JSON list of arguments a line in, a list of results out."""

from __future__ import annotations

import contextlib
import io
import json
import sys
import traceback

from igtl_gateway.cli import main

told = sys.stdout
for line in sys.stdin:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code: object = main(json.loads(line))
        except SystemExit as end:
            code = end.code
        except Exception:
            code = traceback.format_exc()
    told.write(json.dumps([code, out.getvalue(), err.getvalue()]) + "\n")
    told.flush()
