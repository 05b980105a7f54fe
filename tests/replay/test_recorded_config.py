"""The configuration of a recording: which one is run, what it lacks, and the units that follow from it."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from igtl_gateway.base.errors import ConfigError, UnsupportedRecording
from igtl_gateway.config.configuration import Config, ToRosRow
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.to_igtl.sender import ARM_UNIT
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_config import (
    absent_sources,
    config_to_run,
    peer_units,
    recorded_acceptance,
    recorded_units,
    units_of,
)
from tests.record import samples
from tests.tables import table


def recorded(config: Config) -> dict[str, str]:
    return {"config": json.dumps(config.to_dict())}


def test_the_recorded_configuration_is_run() -> None:
    config = Config(base_frame="theatre", igtl_unit="m")
    assert config_to_run(recorded(config)) == config
    old = config_to_run({})
    assert old == replace(Config(), naming=0, fitting=0, reading=0), "a recording without one is older than their rules"


def test_a_file_replaces_it(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text('[gateway]\nbase_frame = "other"\n')
    found = config_to_run(recorded(Config(base_frame="theatre", igtl_unit="m")), path)
    assert (found.base_frame, found.igtl_unit) == ("other", Config().igtl_unit)


def test_what_a_file_does_not_have_of_older_recordings_is_as_recorded(tmp_path: Path) -> None:
    """The rules of names and the guard: a file without them does not change what a recording was made with."""
    path = tmp_path / "a.toml"
    path.write_text('[gateway]\nbase_frame = "other"\n')
    for live in (Config(), Config().watched(), Config(watch=False)):
        found = config_to_run(recorded(live), path)
        assert (found.watch, found.cautious, found.naming) == (live.watch, live.cautious, live.naming)
    path.write_text("[gateway]\nwatch = true\n")
    assert config_to_run(recorded(Config(watch=False)), path).watch is True


@table(
    ("session", "reason"),
    [
        ({"config": '{"igtl_unit": "inch"}'}, "the recorded configuration cannot be used: "),
        ({"config": "["}, "the recorded configuration cannot be used: "),
        ({"config": '{"unheardof": 1}'}, "the recorded configuration cannot be used: "),
    ],
)
def test_a_recorded_configuration_that_is_invalid(session: dict[str, str], reason: str, tmp_path: Path) -> None:
    with pytest.raises(UnsupportedRecording, match=reason):
        config_to_run(session)
    path = tmp_path / "a.toml"
    path.write_text('[gateway]\nbase_frame = "other"\n')
    assert config_to_run(session, path) == Config.from_toml(path), "a file is the way out"


def test_a_file_that_is_invalid_is_the_fault_of_the_user(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("[gateway]\nigtl_unit = 5\n")
    with pytest.raises(ConfigError, match=r"a\.toml"):
        config_to_run({}, path)


def test_what_a_recording_does_not_have_is_named(tmp_path: Path) -> None:
    path = samples.write(tmp_path / "a.mcap", samples.every_kind(2))
    config = Config(
        to_ros=(ToRosRow(device="ProbeToTracker"), ToRosRow(device="ProbToTracker"), ToRosRow(device="/chatter"))
    )
    with SessionFile.open(path) as file:
        assert absent_sources(file, Config()) == []
        found = absent_sources(file, config)
    assert len(found) == 2
    assert found[0].startswith("device ProbToTracker: no peer sends it; did you mean 'ProbeToTracker'? (to")


@dataclass
class Stream:
    kind: Kind
    stream: str
    entry_type: str
    count: int = 1


@dataclass
class File:
    """What is needed of a session file."""

    session: Mapping[str, str]
    channels: Sequence[Stream] = ()
    notes: list[Entry] = field(default_factory=list)

    def entries_of_kinds(self, kinds: Collection[Kind]) -> Iterator[Entry]:
        yield from (each for each in self.notes if each.kind in kinds)

    def prologue(self) -> list[Entry]:
        return []


TOOL = (Stream(Kind.IGTL_IN, "TRANSFORM/Tool", "TRANSFORM"),)


KEY = (Kind.IGTL_IN, "TRANSFORM/Tool", "TRANSFORM")


@table("unit", ["m", "mm", "um"])
def test_units_are_those_of_the_recorded_configuration(unit: str) -> None:
    file = File(recorded(Config(igtl_unit=unit)), TOOL)
    assert recorded_units(file).of(*KEY) == unit
    assert units_of(Config(igtl_unit="cm"), file).of(*KEY) == "cm", "by another configuration"


def test_without_a_usable_configuration_units_are_the_usual_ones() -> None:
    for session in ({}, {"config": "["}, {"config": '{"igtl_unit": "inch"}'}):
        assert recorded_units(File(session, TOOL)).of(*KEY) == Config().igtl_unit == "mm"
        assert recorded_acceptance(File(session)).check_crc, "as by default"


def test_what_a_session_accepted_is_as_recorded() -> None:
    assert recorded_acceptance(File(recorded(Config(check_crc=False)))) == Acceptance(check_crc=False)


def test_streams_without_a_name_have_no_unit_yet() -> None:
    assert recorded_units(File({}, (Stream(Kind.IGTL_IN, "", ""),))).of(*KEY) == "mm"


@table(
    ("config", "units"),
    [
        (Config(profile="crtk"), {3: "mm"}),
        (Config(), {}),  # without arms
        (Config(profile="crtk", fitting=0), {}),  # before there were notes about it
    ],
)
def test_peers_have_units_of_their_own_only_beside_arms(config: Config, units: dict[int, str]) -> None:
    note = Note(Level.INFO, ARM_UNIT, "text", "", {"unit": "mm"})
    file = File({}, (), [Entry(1, 5, Kind.NOTE, payload=(note.pack(),), links=(3,))])
    assert peer_units(config, file) == units
    pose = (Kind.IGTL_IN, "TRANSFORM/PSM1/measured_cp", "TRANSFORM", (3,))
    assert units_of(config, file).of(*pose) == ("m" if not units and config.all_arms else "mm")
