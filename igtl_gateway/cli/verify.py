"""``igtl-gateway verify``: check that the outputs of a recording follow from its inputs."""

from __future__ import annotations

import argparse

from igtl_gateway.app.verification import RECORDED, Verification, verify_recording
from igtl_gateway.cli.common import count_text
from igtl_gateway.cli.options import add_config, add_file, add_json
from igtl_gateway.cli.terminal import print_json, print_line

EXAMPLES = """\
  # exit code 0: all outputs are equal; 1: print the first difference
  igtl-gateway verify out.mcap
  # number of differences and the first one of each stream
  igtl-gateway verify out.mcap --all
  # what another configuration would change
  igtl-gateway verify out.mcap --config new.toml
  # up to 1,000 differences, for programs
  igtl-gateway verify out.mcap --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser)
    add_config(parser)
    parser.add_argument("--all", action="store_true", help="print the first difference of each stream")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    result = verify_recording(options.file, options.config)
    if options.json:
        print_json(result.to_dict())
    else:
        _print(result, options.all)
    return 0 if result.good else 1


def _print(result: Verification, everything: bool) -> None:
    versions = f"recorded by igtl-gateway {result.recorded_by or '(unknown)'}, verified by {result.verified_by}"
    configuration = "the recorded configuration" if result.config == RECORDED else result.config
    print_line(f"{result.file}: {versions} with {configuration}")
    print_line(f"  {count_text(result.inputs, 'input')} processed, {count_text(result.outputs, 'output')} compared")
    if result.good and not result.outputs:
        print_line("nothing to verify: no outputs recorded, none computed")
    elif result.good:
        print_line(f"verified: all {count_text(result.equal, 'output')} equal, byte for byte")
    else:
        print_line(f"DIFFERENT: {count_text(result.differing, 'output')} of {result.outputs:,}")
        for difference in result.firsts.values() if everything else result.differences[:1]:
            print_line(f"  {difference}")
        for stream, number in sorted(result.by_stream.items()):
            print_line(f"  {stream}: {count_text(number, 'difference')}")
    for number, thing, things, why in (
        (result.lost, "output", "", "that the recording has lost"),
        (result.missing, "further entry", "further entries", "that the recording has lost or not selected"),
        (result.orphans, "output", "", "whose input is one of these"),
        (result.late, "note", "", "of a stream whose first message is one of these"),
    ):
        if number:
            print_line(f"not verified: {count_text(number, thing, things)} {why}")
