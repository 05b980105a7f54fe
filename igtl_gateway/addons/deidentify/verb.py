"""``igtl-gateway deidentify``: a session without identity, as a new file that verifies."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.addon.terminal import (
    add_file,
    add_json,
    add_output,
    add_overwrite,
    default,
    new_recording,
)

EXAMPLES = """\
  # no names, no text, other times; random pseudonyms
  igtl-gateway deidentify out.mcap -o clean.mcap
  # the same pseudonyms in all sessions of a study
  head -c 32 /dev/urandom > study.key && chmod 600 study.key
  igtl-gateway deidentify out.mcap -o clean.mcap --secret study.key
  # names that stay, rules for text, masks of pictures
  igtl-gateway deidentify out.mcap -o clean.mcap --profile study.toml

The result verifies: inputs are changed, outputs are computed again.  The report
names each rule with its option of DICOM PS3.15, what was left, and what no
rule covers, such as faces in volumes.  See docs/how-to/deidentify.md.

exit code 1 if pictures are left without a mask, and a mask of the profile
matches no stream."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser)
    add_output(parser, read=new_recording, required=True)
    parser.add_argument(
        "--profile", type=Path, metavar="FILE", help="what stays, rules and masks (TOML) " + default("basic: nothing")
    )
    parser.add_argument(
        "--secret", type=Path, metavar="FILE", help="key of the pseudonyms " + default("random, and not stored")
    )
    times = parser.add_mutually_exclusive_group()
    times.add_argument(
        "--shift", type=int, metavar="S", help="move all times by this number of seconds " + default("from the key")
    )
    times.add_argument("--keep-times", action="store_true", help="keep all times")
    add_overwrite(parser, "OUT")
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.deidentify.verb_run import run  # here: the help does not wait for it

    return run
