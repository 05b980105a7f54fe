"""``igtl-gateway simulate``: a synthetic session as a recording."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from igtl_gateway import __version__
from igtl_gateway.cli.common import count, print_json, size
from igtl_gateway.config import Config
from igtl_gateway.errors import ConfigError
from igtl_gateway.gateway import Gateway
from igtl_gateway.record.mcap_writer import SessionWriter
from igtl_gateway.simulate.catalogue import SCENARIOS

EXAMPLES = """\
  igtl-gateway simulate star --out star.mcap          12 s of a synthetic STAR suturing session
  igtl-gateway simulate star --out long.mcap --duration 60
  igtl-gateway simulate paper-types --out types.mcap  one of each message type, both directions"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    names = "; ".join(f"{name}: {scenario.title}" for name, scenario in SCENARIOS.items())
    parser.add_argument("name", choices=tuple(SCENARIOS), help=names)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the recording to write")
    parser.add_argument("--duration", type=float, metavar="S", help="seconds of the session")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object")


def run(options: argparse.Namespace) -> int:
    if options.duration is not None and not 0 < options.duration < 3600:
        raise ConfigError(f"--duration: found {options.duration}, expected more than 0 and less than 3600 seconds")
    scenario = SCENARIOS[options.name]
    gateway = Gateway(scenario.config)
    writer = SessionWriter(
        options.out,
        facts(options.name, scenario.config),
        qos_of=lambda topic, ros_type: gateway.qos(topic) or gateway.subscription(topic, ros_type),
        compression="zstd",
        overwrite=options.overwrite,
    )
    entries = 0
    for entry in scenario.entries(options.duration, gateway):
        writer.write(entry)
        entries += 1
    writer.close({"streams": gateway.ledger.to_dict()})
    told = {"file": str(options.out), "entries": entries, "bytes": options.out.stat().st_size}
    if options.json:
        print_json(told)
    else:
        print(f"{scenario.title}")
        print(f"{options.out}: {count(entries, 'entry', 'entries')}, {size(told['bytes'])}")
    return 0


def facts(name: str, config: Config) -> dict[str, str]:
    """What the file says of itself: nothing of this machine or moment, so that equal sessions are equal files."""
    return {
        "config": json.dumps(config.to_dict(), sort_keys=True),
        "igtl_gateway_version": __version__,
        "scenario": name,
        "synthetic": "yes: no robot, no patient, no camera",
    }
