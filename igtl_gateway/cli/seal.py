"""``igtl-gateway seal``: seal a recording that exists already."""

from __future__ import annotations

import argparse
from pathlib import Path

from igtl_gateway.app.sealing import seal_recording
from igtl_gateway.cli.common import size_text
from igtl_gateway.cli.options import RECORDING_OR_BAG, add_file, add_overwrite
from igtl_gateway.cli.terminal import print_line

EXAMPLES = """\
  # write a sealed copy of a recording
  igtl-gateway seal out.mcap --key recorder.key -o sealed.mcap

`keys new` makes a key; `bridge --seal KEY` seals while it records.
The seal states what the file contained at this moment, and nothing about the
time before it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    parser.add_argument("--key", required=True, metavar="KEY", type=Path, help="private key (Ed25519, PEM)")
    parser.add_argument("-o", "--output", required=True, metavar="OUT", type=Path, help="file to write")
    add_overwrite(parser, "OUT")


def run(options: argparse.Namespace) -> int:
    key, size = seal_recording(options.file, options.key, options.output, overwrite=options.overwrite)
    print_line(f"{options.output}: {size_text(size)}, sealed by key {key}")
    return 0
