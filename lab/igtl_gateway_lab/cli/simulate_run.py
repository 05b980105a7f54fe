"""``igtl-gateway simulate``: a scenario, live over real connections or as a recording."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.quantities import count_text, size_text
from igtl_gateway.base.version import __version__
from igtl_gateway.cli.terminal import print_json, print_line, print_text
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.interfaces import SHARES
from igtl_gateway.gateway import Gateway
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.whole_files import written
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway_lab.cli import stage
from igtl_gateway_lab.simulate.catalogue import SCENARIOS
from igtl_gateway_lab.simulate.content import ContentDigest
from igtl_gateway_lab.simulate.load import Load
from igtl_gateway_lab.simulate.scenario import SYNTHETIC, Scenario

_MAX_S = 3600.0


def run(options: argparse.Namespace) -> int:
    for name in ("duration", "timeout"):
        given = getattr(options, name)
        if given is not None and not 0 < given < _MAX_S:
            raise ConfigError(f"--{name}: found {given}, expected more than 0 and less than {_MAX_S:g} seconds")
    scenario = _loaded(options)
    if options.actor:
        return stage.play_actor(options, scenario)
    if options.print_config:
        print_text(scenario.config.to_toml())
        return 0
    if not options.output:
        return stage.play_live(options, scenario)
    for name in ("record", "view", "side", "connect", "listen", "timeout"):
        if getattr(options, name):
            raise ConfigError(f"--{name} is for a live scenario: it cannot be used with -o")
    return _write(options, scenario)


def _loaded(options: argparse.Namespace) -> Scenario:
    """The scenario, with the load that was asked for."""
    scenario: Scenario = SCENARIOS[options.name]
    given = {
        field: getattr(options, option)
        for option, field in stage.LOAD_OPTIONS.items()
        if getattr(options, option) is not None
    }
    if not given:
        return scenario
    if not scenario.loaded:
        raise ConfigError(
            f"--{next(o for o, f in stage.LOAD_OPTIONS.items() if f in given)}: {options.name} has no load"
        )
    return scenario.loaded(Load(**given))


def _write(options: argparse.Namespace, scenario: Scenario) -> int:
    """Play offline into a file."""
    cast = scenario.cast(options.duration)  # refuses what does not fit, before a file is replaced
    gateway = Gateway(_with_ages(scenario.config))
    entries, content = 0, ContentDigest()
    with written(options.output, overwrite=options.overwrite) as place:
        writer = SessionWriter(
            place,
            scenario_facts(options.name, scenario.config),
            qos_of=lambda topic, ros_type: gateway.qos(topic) or gateway.subscription(topic, ros_type),
            compression="zstd",
            types=RosTypes(SHARES),  # equal files with and without ROS on this machine
        )
        for entry in scenario.entries(options.duration, gateway, cast):
            writer.write(entry)
            content.update(entry)
            entries += 1
        writer.close({"streams": gateway.ledger.to_dict()})
    reports = {actor.name: (actor.done, actor.report()) for actor in cast}
    good = all(done and report.good for done, report in reports.values())
    length, sha256 = options.output.stat().st_size, content.hexdigest()
    facts = {"file": str(options.output), "entries": entries, "bytes": length, "sha256": sha256, "good": good}
    if options.json:
        actors = {name: stage.report_facts(done, report) for name, (done, report) in reports.items()}
        print_json(facts | ({"actors": actors} if actors else {}))
    else:
        print_line(scenario.title)
        for name, (done, report) in reports.items():
            print_line(*stage.report_lines(name, "", done, report))
        print_line(
            f"{options.output}: {count_text(entries, 'entry', 'entries')}, {size_text(length)}",
            f"sha256 {sha256} of the content",
        )
    return 0 if good else 1


def _with_ages(config: Config) -> Config:
    """Return a configuration whose rows state their maximum age, and no rules of names, as those of the fixtures do."""
    return replace(
        config,
        naming=0,
        to_igtl=tuple(replace(row, max_age_s=config.max_age_of(row)) for row in config.to_igtl),
        to_ros=tuple(replace(row, max_age_s=config.max_age_of(row)) for row in config.to_ros),
        tf_out=tuple(replace(row, max_age_s=config.max_age_of(row)) for row in config.tf_out),
    )


def scenario_facts(name: str, config: Config) -> dict[str, str]:
    """Metadata of the file: nothing of this machine or time, so that equal sessions have equal contents."""
    return {
        "config": json.dumps(_with_ages(config).to_dict(), sort_keys=True),
        "igtl_gateway_version": __version__,
        "scenario": name,
        "synthetic": SYNTHETIC,
    }
