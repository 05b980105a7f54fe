"""``igtl-gateway verify``: check that the outputs of a recording follow from its inputs."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from igtl_gateway import __version__
from igtl_gateway.cli.common import config_to_run, count_text
from igtl_gateway.cli.options import add_config, add_file, add_json
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.config import Config
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.errors import UnsupportedRecording
from igtl_gateway.replay.compare import LeafDecoder
from igtl_gateway.replay.verify import DeclaredLosses, VerifyReport, verify
from igtl_gateway.sessionfile.reader import SessionFile

EXAMPLES = """\
  # exit code 0: all outputs are equal; 1: print the first difference
  igtl-gateway verify out.mcap
  # number of differences and the first one of each stream
  igtl-gateway verify out.mcap --all
  # what another configuration would change
  igtl-gateway verify out.mcap --config new.toml
  # up to 1,000 differences, for programs
  igtl-gateway verify out.mcap --json"""

#: Key of the version that recorded the session.
_VERSION = "igtl_gateway_version"
#: Key of the source format of an imported session.
_IMPORTED = "imported_format"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser)
    add_config(parser)
    parser.add_argument("--all", action="store_true", help="print the first difference of each stream")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    with SessionFile.open(options.file) as file:
        if file.foreign:
            raise UnsupportedRecording(
                f"{options.file}: found an MCAP file of another program, expected a session of igtl-gateway"
            )
        if _IMPORTED in file.session:
            raise UnsupportedRecording(
                f"{options.file}: found an import ({file.session[_IMPORTED]}), expected a recording of the gateway: "
                "it has no outputs; `replay --through-gateway` computes them"
            )
        recorded_by = file.session.get(_VERSION, "")
        config = _config(options, file, recorded_by)
        decoder = LeafDecoder(file.definitions, LengthUnits(config.ros_unit, config.igtl_unit))
        losses = DeclaredLosses.of(file.session, file.ledger)
        report = verify(file.entries(), config, losses, before=file.prologue(), decoder=decoder)
    facts: dict[str, Any] = {
        "file": str(options.file),
        "good": report.good,
        "recorded_by": recorded_by,
        "verified_by": __version__,
        "config": str(options.config) if options.config else "recorded",
    }
    if options.json:
        print_json({**facts, **asdict(report)})
    else:
        _print(facts, report, options.all)
    return 0 if report.good else 1


def _config(options: argparse.Namespace, file: SessionFile, recorded_by: str) -> Config:
    """The configuration to verify with.  Raises ConfigError, or UnsupportedRecording with both versions."""
    try:
        return config_to_run(file.session, options.config)
    except UnsupportedRecording as error:
        raise UnsupportedRecording(
            f"{options.file}: {error}; recorded by igtl-gateway {recorded_by or 'of an unknown version'}, "
            f"this is {__version__}: give a configuration with --config"
        ) from None


def _print(facts: dict[str, Any], report: VerifyReport, everything: bool) -> None:
    versions = f"recorded by igtl-gateway {facts['recorded_by'] or '(unknown)'}, verified by {facts['verified_by']}"
    configuration = "the recorded configuration" if facts["config"] == "recorded" else facts["config"]
    print_line(f"{facts['file']}: {versions} with {configuration}")
    print_line(f"  {count_text(report.inputs, 'input')} processed, {count_text(report.outputs, 'output')} compared")
    if report.good and not report.outputs:
        print_line("nothing to verify: no outputs recorded, none computed")
    elif report.good:
        print_line(f"verified: all {count_text(report.equal, 'output')} equal, byte for byte")
    else:
        print_line(f"DIFFERENT: {count_text(report.differing, 'output')} of {report.outputs:,}")
        for difference in report.firsts.values() if everything else report.differences[:1]:
            print_line(f"  {difference}")
        for stream, number in sorted(report.by_stream.items()):
            print_line(f"  {stream}: {count_text(number, 'difference')}")
    for number, thing, things, why in (
        (report.lost, "output", "", "that the recording has lost"),
        (report.missing, "further entry", "further entries", "that the recording has lost or not selected"),
        (report.orphans, "output", "", "whose input is one of these"),
        (report.late, "note", "", "of a stream whose first message is one of these"),
    ):
        if number:
            print_line(f"not verified: {count_text(number, thing, things)} {why}")
