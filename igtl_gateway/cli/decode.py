"""``igtl-gateway decode``: a raw OpenIGTLink byte stream as JSON lines."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.cli.options import add_output, add_overwrite, default
from igtl_gateway.wire.header import DEFAULT_MAX_BODY

EXAMPLES = """\
  # one JSON object per message
  igtl-gateway decode capture.igtl
  # the messages of a server, live
  nc localhost 18944 | igtl-gateway decode -
  # decode, encode again, write
  igtl-gateway decode in.igtl -o out.igtl

The object of a damaged message has an `error` with what was found and what was
expected.  After a wrong CRC the content is unreliable.  Exit code 1 if a
message is damaged or the stream ends inside a message; the readable messages
are printed, and written to OUT.  A stream that is not OpenIGTLink, or a longer
body, ends the work, and OUT is not written."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="file of consecutive messages; - for standard input")
    add_output(
        parser,
        "decode and encode each message, and write it to OUT; damaged messages are copied",
        old=("--reencode",),
    )
    add_overwrite(parser, "OUT")
    parser.add_argument(
        "--max-body",
        type=int,
        default=DEFAULT_MAX_BODY,
        metavar="BYTES",
        help="maximum body size " + default(DEFAULT_MAX_BODY),
    )


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.decode_run import run  # here: the help does not wait for it

    return run
