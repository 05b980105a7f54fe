"""``igtl-gateway lint``: the rules of ``doctor`` on a recording."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from igtl_gateway.cli.common import config_to_run, count_text
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.doctor.observer import Observer
from igtl_gateway.doctor.report import DoctorReport
from igtl_gateway.errors import DamagedRecording
from igtl_gateway.sessionfile.reader import SessionFile
from igtl_gateway.sessionfile.salvage import Salvage

EXAMPLES = """\
  igtl-gateway lint out.mcap            findings: stamps, names, units, CRCs, header versions, losses
  igtl-gateway lint out.mcap --json     the same for programs
exit code: 0 no error found, 1 an error, 2 usage"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="a recording, or the folder of a split one")
    parser.add_argument("--config", type=Path, metavar="FILE", help="another configuration than the recorded one")
    parser.add_argument("--json", action="store_true", help="print everything as one JSON object")


def run(options: argparse.Namespace) -> int:
    try:
        with SessionFile.open(options.file) as file:
            seen = _seen(file, options.config)
    except DamagedRecording as error:
        if options.file.is_dir():
            raise  # it names the part that is damaged
        with Salvage.open(options.file) as salvage:
            seen = _seen(salvage, options.config)
        seen.damage = str(error)
    report = DoctorReport.of(seen)
    if options.json:
        print_json({"file": str(options.file)} | report.to_dict())
    else:
        print_line(f"{options.file}: {count_text(len(seen.streams), 'OpenIGTLink stream')}")
        for line in report.lines():
            print_line(line)
    return int(report.failed)


def _seen(file: SessionFile | Salvage, config: Path | None) -> Observer:
    seen = Observer(config_to_run(file.session, config))
    for entry in file.entries():
        seen.add(entry)
    seen.losses = dict(_losses(file.ledger or {}))
    return seen


def _losses(ledger: dict[str, Any]) -> Iterator[tuple[str, int]]:
    """What the ledger says of messages that came to nothing at the edges; the messages show the rest themselves."""
    for link, fates in ledger.get("links", {}).items():
        for fate in ("dropped", "ignored"):
            if number := sum(fates.get(fate, {}).values()):
                yield f"{fate} on the way to {'links that are gone' if link == '0' else f'link {link}'}", number
    for topic, counts in ledger.get("ros_topics", {}).items():
        if number := counts.get("lost", 0):
            yield f"{topic}, before the bridge took them", number
    if number := ledger.get("recorder", {}).get("dropped_entries", 0):
        yield "entries that the recorder could not keep up with", number
