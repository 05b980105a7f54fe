"""The program that does jobs: one line of JSON for each job on its input, one line with the reply on its output.

``python -m igtl_gateway.addons.cohort.worker BYTES``: its data may take this number of bytes, so that a file that needs
more is a result and not the end of the machine.  It ends with its input.
"""

from __future__ import annotations

import json
import os
import sys

from igtl_gateway.addon.processes import limit_data
from igtl_gateway.addons.cohort.ends import MEMORY
from igtl_gateway.addons.cohort.jobs import TOO_LARGE, run_job


def main() -> None:
    """Do jobs until the input ends."""
    replies = os.fdopen(os.dup(1), "w", encoding="ascii")
    os.dup2(2, 1)  # what a library prints is no reply
    most = int(sys.argv[1])
    if most:
        limit_data(most)
    with open(0, encoding="utf-8", closefd=False) as jobs:
        for line in jobs:
            try:
                text = json.dumps(run_job(json.loads(line)))
            except MemoryError:
                text = json.dumps({"status": MEMORY, "error": TOO_LARGE})
            replies.write(f"{text}\n")
            replies.flush()


if __name__ == "__main__":
    main()
