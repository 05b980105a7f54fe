from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app.replay_plan import plan_replay
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.columns import Unfit
from igtl_gateway.record.sessionfile.only import only_of_kinds
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_marks import marks_of
from igtl_gateway.replay.shared_names import shared_names
from igtl_gateway.replay.timeline import clock_steps_of
from tests.places import FIXTURES

KINDS = (frozenset({Kind.NOTE}), frozenset({Kind.EDGE_NOTE, Kind.LINK}), frozenset({Kind.IGTL_IN, Kind.NOTE}))


def facts(entries: Iterator[Entry]) -> list[tuple[Any, ...]]:
    return [(one.seq, one.stamp_ns, one.kind, one.channel, one.type, one.links, one.data()) for one in entries]


@pytest.mark.parametrize("is_old", [False, True])
def test_only_the_entries_of_the_kinds(is_old: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    def unfit(*_: object, **__: object) -> None:
        raise Unfit

    if is_old:
        monkeypatch.setattr(SessionFile, "columns", unfit)
    with SessionFile.open(FIXTURES / "every-type.mcap") as file:
        for kinds in KINDS:
            expected = facts(each for each in file.entries() if each.kind in kinds)
            assert expected and facts(only_of_kinds(file, kinds)) == expected


def test_what_a_replay_asks_before_it_begins_makes_no_object_of_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording of 233 MB opened after 62 s."""

    def refused(*_: object, **__: object) -> None:
        raise AssertionError("all entries were read")

    for name in ("entries", "entries_of_kinds", "_numbered"):
        monkeypatch.setattr(SessionFile, name, refused)
    for path in sorted(Path(FIXTURES).glob("*.mcap")):
        with SessionFile.open(path) as file:
            clock_steps_of(file)
            assert list(shared_names(file)) is not None and marks_of(file) is not None
            assert plan_replay(file, "both", recompute=False).why
