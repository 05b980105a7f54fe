"""A recording that begins anywhere in a session with a robot knows the results of the commands before it."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.deidentify.profile import Profile
from igtl_gateway.addons.deidentify.session import deidentify
from igtl_gateway.app.recording import state_rule
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.slice import Slice
from igtl_gateway.replay.slice_state import SliceWindow
from igtl_gateway.replay.source import through_gateway
from igtl_gateway.replay.verify import DeclaredLosses, verify
from igtl_gateway.testing.gateway import ManualGateway
from tests.gateway.robot_worlds import World

MIDWAY = DeclaredLosses(midway=True)


@dataclass(frozen=True)
class Midway:
    """A session that begins in the middle of a world of robots."""

    config: Config
    before: Sequence[Entry]
    entries: Sequence[Entry]


def session_of(seed: int, monkeypatch: pytest.MonkeyPatch) -> tuple[Config, list[Entry]]:
    """Return configuration and log of a world."""
    log: list[Entry] = []
    configs: list[Config] = []
    take = Session.input

    def logged(self: Session, *args: Any, **more: Any) -> list[Entry]:
        configs.append(self.gateway.config)
        entries = take(self, *args, **more)
        log.extend(entries)
        return entries

    with monkeypatch.context() as patched:
        patched.setattr(Session, "input", logged)
        World(seed, recorded=True).run()
    return configs[0], log


def cut(config: Config, log: Sequence[Entry], at: int) -> Midway:
    prologue = Prologue(state_rule(config))
    for entry in log[:at]:
        prologue.observe(entry)
    return Midway(config, prologue.entries(), log[at:])


def cuts(seed: int, monkeypatch: pytest.MonkeyPatch, number: int) -> list[Midway]:
    config, log = session_of(seed, monkeypatch)
    inputs = [at for at, entry in enumerate(log) if entry.kind.is_input][4:]
    places = random.Random(seed).sample(inputs, min(number, len(inputs)))
    return [cut(config, log, at) for at in places]


@pytest.mark.parametrize("seed", range(40))
def test_it_verifies_and_so_do_its_slices(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refused first messages, other frames, states that stop or are not valid, commands in a BIND."""
    for one in cuts(seed, monkeypatch, 3):
        report = verify(one.entries, one.config, MIDWAY, before=one.before)
        assert report.good and report.equal == report.outputs, report.differences[:1]
        first_ns, end_ns = one.entries[0].stamp_ns, one.entries[-1].stamp_ns + 1
        for start_ns in (first_ns, (first_ns + end_ns) // 2):
            part = Slice(lambda: one.entries, one.config, SliceWindow(start_ns, end_ns), before=one.before)  # noqa: B023
            sliced = list(part.entries())
            assert not part.report.differing
            assert verify(sliced, one.config, before=part.before()).good


def one_with_both(monkeypatch: pytest.MonkeyPatch) -> Midway:
    """A session whose prologue has accepted and refused commands, and that goes on with both."""
    for seed in range(200):
        for one in cuts(seed, monkeypatch, 2):
            if all(
                {Kind.ROS_OUT, Kind.NOTE} <= {entry.kind for entry in entries} for entries in (one.before, one.entries)
            ):
                return one
    raise AssertionError("no world has both")


def written(path: Path, one: Midway) -> Path:
    facts = {layout.CONFIGURATION_KEY: json.dumps(one.config.to_dict()), layout.SNAPSHOT_KEY: "10"}
    writer = SessionWriter(path, facts, prologue=one.before)
    for entry in one.entries:
        writer.write(entry)
    writer.close({})
    return path


def test_a_prologue_of_before_these_outputs_means_that_its_commands_were_accepted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one = one_with_both(monkeypatch)
    groups: dict[int, list[Entry]] = {}
    for entry in one.before:
        if entry.kind.is_input:
            cause = entry.seq
        groups.setdefault(cause, []).append(entry)
    accepted = [
        group[0] for group in groups.values() if all(entry.kind in (group[0].kind, Kind.ROS_OUT) for entry in group)
    ]
    session = list(through_gateway([], one.config, has_links=True, before=accepted))
    published = [entry for entry in session if entry.kind is Kind.ROS_OUT]
    assert {entry.channel for entry in published} >= {
        entry.channel for entry in one.before if entry.kind is Kind.ROS_OUT
    }
    assert not [entry for entry in session if entry.kind is Kind.NOTE and "command_" in Note.of(entry.data()).code]


def test_every_program_that_begins_with_a_prologue_goes_on_in_the_same_way(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = one_with_both(monkeypatch)
    path, new = written(tmp_path / "part.mcap", one), tmp_path / "new.mcap"
    assert main(["verify", str(path)]) == 0
    recorded = [entry for entry in one.entries if not entry.kind.is_input]
    with SessionFile.open(path) as file:
        assert file.prologue() == list(one.before)
    computed = through_gateway(one.entries, one.config, has_links=True, before=one.before)
    assert [entry for entry in computed if not entry.kind.is_input][-len(recorded) :] == recorded
    assert [entry.data() for entry in ManualGateway(path).play(path).entries if entry.kind is Kind.ROS_OUT] == [
        entry.data() for entry in recorded if entry.kind is Kind.ROS_OUT
    ]
    assert main(["slice", str(path), "-o", str(new)]) == 0
    assert main(["verify", str(new)]) == 0
    kept = Profile(keep_names=("**",))
    deidentify(path, tmp_path / "cleaned.mcap", kept, b"key", shift_ns=0)
    with SessionFile.open(tmp_path / "cleaned.mcap") as file:
        codes = [Note.of(entry.data()).code for entry in file.entries() if entry.kind is Kind.NOTE]
    assert codes == [Note.of(entry.data()).code for entry in recorded if entry.kind is Kind.NOTE]
    capsys.readouterr()
