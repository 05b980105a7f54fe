"""``igtl-gateway verify``: are a recording's outputs what the gateway says to its inputs?"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from igtl_gateway.cli.common import count, print_json, recorded_config
from igtl_gateway.errors import UnsupportedRecording
from igtl_gateway.replay.mcap_reader import SessionFile
from igtl_gateway.replay.verify import Report, verify

EXAMPLES = """\
  igtl-gateway verify out.mcap                     exit code 0: every byte follows; 1: the first difference
  igtl-gateway verify out.mcap --config new.toml   what would change under another configuration?
  igtl-gateway verify out.mcap --all --json        all differences, for programs"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="a recording")
    parser.add_argument(
        "--config", metavar="TOML", type=Path, help="use this configuration instead of the recorded one"
    )
    parser.add_argument("--all", action="store_true", help="print all differences (up to 100), not only the first")
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object")


def run(options: argparse.Namespace) -> int:
    with SessionFile.open(options.file) as file:
        if file.foreign:
            raise UnsupportedRecording(f"{options.file}: is no session of igtl-gateway: it has no outputs to verify")
        config = recorded_config(file.session, options.config)
        recorder = (file.ledger or {}).get("recorder", {})
        report = verify(file.entries(), config, int(recorder.get("dropped_entries", 0)), file.prologue())
    if options.json:
        print_json({"file": str(options.file), "good": report.good, **asdict(report)})
    else:
        _print(options.file, report, options.all)
    return 0 if report.good else 1


def _print(file: Path, report: Report, everything: bool) -> None:
    print(f"{file}: {count(report.inputs, 'input')} fed to the gateway, {count(report.outputs, 'output')} compared")
    if report.good:
        print(f"verified: all {count(report.equal, 'output')} equal, byte for byte")
        if report.lost:
            print(f"not verified: {count(report.lost, 'output')} that the recorder said it dropped")
        return
    print(f"DIFFERENT: {count(report.differing, 'output')} of {report.outputs}")
    for difference in report.differences if everything else report.differences[:1]:
        print(f"  {difference}")
    for stream, number in sorted(report.by_stream.items()):
        print(f"  {stream}: {count(number, 'difference')}")
