"""``igtl-gateway keep``: the retention and the upload of ``bridge``, once."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.cli.keep_options import keep_options
from igtl_gateway.cli.settings import add_absent, add_settings

EXAMPLES = """\
  # which recordings would be deleted, and which are kept although they are old
  igtl-gateway keep recordings --retention '30 d, 200 GB' --dry-run
  # delete them
  igtl-gateway keep recordings --retention '30 d, 200 GB'
  # delete only those that are sealed to their end
  igtl-gateway keep recordings --retention '30 d' --only-sealed
  # upload all recordings of a directory, or what a bridge has left of them
  igtl-gateway keep recordings --upload s3://sessions/or1
  # upload, then delete those that are old and that the store has
  igtl-gateway keep recordings --upload s3://sessions/or1 \\
      --retention '30 d' --only-uploaded

It deletes closed recordings and parts of split recordings, the oldest first,
and nothing else. `bridge --retention` and `bridge --upload` do the same while
they record.  Keys of the store come from AWS_ACCESS_KEY_ID and
AWS_SECRET_ACCESS_KEY, or from ~/.aws; AWS_ENDPOINT_URL names another store
than that of AWS.  An upload that was interrupted continues.  Objects are
created, never replaced."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", type=Path, help="directory of recordings")
    add_settings(parser, keep_options())
    add_absent(parser, "upload")


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.keep_run import run  # here: the help does not wait for it

    return run
