"""``igtl-gateway lint``: the rules of ``doctor`` on a recording."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from igtl_gateway.cli.common import count_text
from igtl_gateway.cli.options import add_config, add_file, add_json
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.doctor.observer import Observer
from igtl_gateway.doctor.report import DoctorReport
from igtl_gateway.errors import DamagedRecording
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.sessionfile.reader import SessionFile
from igtl_gateway.sessionfile.salvage import Salvage

EXAMPLES = """\
  # findings about stamps, names, units, CRCs, header versions, losses
  igtl-gateway lint out.mcap
  # for programs
  igtl-gateway lint out.mcap --json

exit code 0: no error found; 1: an error; 2: wrong usage"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, "recording, or directory of a split recording")
    add_config(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    try:
        with SessionFile.open(options.file) as file:
            seen = _observe(file, options.config)
    except DamagedRecording as error:
        if options.file.is_dir():
            raise  # it names the part that is damaged
        with Salvage.open(options.file) as salvage:
            seen = _observe(salvage, options.config)
        seen.damage = str(error)
    report = DoctorReport.of(seen)
    if options.json:
        print_json({"file": str(options.file)} | report.to_dict())
    else:
        print_line(f"{options.file}: {count_text(len(seen.streams), 'OpenIGTLink stream')}")
        for line in report.lines():
            print_line(line)
    return int(report.failed)


def _observe(file: SessionFile | Salvage, config: Path | None) -> Observer:
    seen = Observer(config_to_run(file.session, config))
    for entry in file.entries():
        seen.add(entry)
    seen.losses = dict(_losses(file.ledger or {}))
    return seen


def _losses(ledger: dict[str, Any]) -> Iterator[tuple[str, int]]:
    """Yield (description, number) of messages that were lost at the edges; other losses are visible in the messages."""
    for link, fates in ledger.get("links", {}).items():
        for fate in ("dropped", "ignored"):
            if number := sum(fates.get(fate, {}).values()):
                yield f"messages {fate}, to {'closed links' if link == '0' else f'link {link}'}", number
    for topic, counts in ledger.get("ros_topics", {}).items():
        if number := counts.get("lost", 0):
            yield f"messages on {topic}, lost before the bridge received them", number
    if number := ledger.get("recorder", {}).get("dropped_entries", 0):
        yield "entries dropped because the queue of the recorder was full", number
