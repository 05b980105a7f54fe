"""Messages that repeat one of their stream have the result of the rules, and nothing that differs is taken for one."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.addons.deidentify import session
from igtl_gateway.addons.deidentify.profile import BASIC, Profile
from igtl_gateway.addons.deidentify.repeated import Repeated, RepeatedRows
from igtl_gateway.addons.deidentify.ros import RosLayout
from igtl_gateway.addons.deidentify.session import deidentify
from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS, ns_to_ticks
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.message import Item
from igtl_gateway.wire.transform import Position, Transform
from tests.places import FIXTURES
from tests.tables import table
from tools.recheck import CONFIG, START_NS, random_session, written

KEY = bytes(range(32))
PROFILES = {"basic": (BASIC, None), "names and times stay": (replace(BASIC, keep_names=("*",)), 0)}


def both(path: Path, folder: Path, profile: Profile, shift_ns: int | None) -> int:
    """De-identify a session with and without repeated messages; return how many there are."""
    repeated = 0
    given, given_rows = Repeated.apply, RepeatedRows.__iter__

    def counted(self: Repeated, entry: Entry) -> Entry | None:
        nonlocal repeated
        found = given(self, entry)
        repeated += found is not None
        return found

    def counted_rows(self: RepeatedRows) -> Iterator[Entry | None]:
        nonlocal repeated
        for found in given_rows(self):
            repeated += found is not None
            yield found

    reports = []
    for name in ("quick", "rules"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Repeated, "apply", counted if name == "quick" else lambda _self, _entry: None)
            patch.setattr(RepeatedRows, "__iter__", counted_rows)
            if name == "rules":
                patch.setattr(Repeated, "rows", lambda _self, rows, _heads: RepeatedRows(len(rows)))
                patch.setattr(session, "make_core", lambda config: Gateway(config, fast_path=False))
            reports.append(deidentify(path, folder / name, profile, KEY, shift_ns=shift_ns, overwrite=True).to_dict())
    assert (folder / "quick").read_bytes() == (folder / "rules").read_bytes()
    assert reports[0] == reports[1]
    return repeated


@table("name", ["paper-types", "crtk"], gate=lambda name: name == "paper-types")
@table("profile", PROFILES)
def test_a_fixture_has_the_result_of_the_rules(name: str, profile: str, tmp_path: Path) -> None:
    assert both(FIXTURES / f"{name}.mcap", tmp_path, *PROFILES[profile]) >= 0


@pytest.mark.slow
@table("path", sorted(FIXTURES.glob("*.mcap")), ids=lambda path: str(path.stem))
def test_every_fixture_has_the_result_of_the_rules(path: Path, tmp_path: Path) -> None:
    both(path, tmp_path, BASIC, None)


@table("seed", range(2), gate=lambda seed: seed < 1)
@table("profile", PROFILES)
def test_a_random_session_has_the_result_of_the_rules(seed: int, profile: str, tmp_path: Path) -> None:
    config, entries = random_session(random.Random(seed), 300)
    path = written(tmp_path / "a.mcap", config, entries)
    assert both(path, tmp_path, *PROFILES[profile]) > 100


@table("seed", range(3))
def test_a_message_with_other_bytes_goes_through_the_rules(seed: int, tmp_path: Path) -> None:
    """Messages of one stream and one size, of which some have one other byte."""
    chance, odd = random.Random(seed), (0.3, 0.03, 0.003)[seed]
    core = Session(Gateway(CONFIG))
    now_ns = START_NS
    note = Note(Level.INFO, LINK_UP, LINK_UP).pack()
    entries = core.input(now_ns, Kind.LINK, (note,), links=(1,))
    for step in range(400):
        now_ns += NS_PER_MS
        numbers = chance.uniform(-1, 1), 0.5, 0.25
        kind: Kind
        named: dict[str, Any] = {}
        if step % 2:
            header = Header(now_ns, "Jane Doe")
            message: Any = TransformStamped(header, "tool", numbers, (0.0, 0.6, 0.0, 0.8))
            if step % 4 == 1:
                message = PoseStamped(header, (*numbers, 0.0, 0.6, 0.0, 0.8))
            kind, data = Kind.ROS_IN, bytearray(message.pack())
            named = {"channel": f"/a/{message.TYPE[-6:-1]}", "type_name": message.TYPE, "source_ns": now_ns - 5}
        else:
            version = 1 + step // 2 % 2
            items = (Item.of("status", "OK"), Item.of("Surgeon", "Jane")) if version == 2 else ()
            content: Any = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, *numbers))
            form = "TRANSFORM"
            if step % 8 == 4:
                form, content = "POSITION", Position(numbers, (0.0, 0.6, 0.0, 0.8), "all")
            ticks = ns_to_ticks(now_ns)
            kind, data = (
                Kind.IGTL_IN,
                bytearray(join(encode(Message(form, "JaneDoe", content, ticks, version, step, items)))),
            )
            named = {"links": (1,)}
        if chance.random() < odd:
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        entries += core.input(now_ns, kind, (bytes(data),), **named)
    path = written(tmp_path / "a.mcap", CONFIG, entries, chunk_bytes=(20_000, 40_000, 1 << 20)[seed])
    assert both(path, tmp_path, BASIC, None) > 150
    assert b"Jane" not in (tmp_path / "quick").read_bytes()


def test_repeated_messages_are_changed_many_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    core = Session(Gateway(CONFIG))
    entries = core.input(START_NS, Kind.LINK, (Note(Level.INFO, LINK_UP, LINK_UP).pack(),), links=(1,))
    for step in range(1, 200):
        now_ns = START_NS + step * NS_PER_MS
        pose = TransformStamped(Header(now_ns, "Jane"), "tool", (0.1, 0.2, step), (0.0, 0.6, 0.0, 0.8))
        entries += core.input(now_ns, Kind.ROS_IN, (pose.pack(),), channel="/a", type_name=pose.TYPE)
        content = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, step, 0.0, 0.0))
        data = join(encode(Message("TRANSFORM", "Jane", content, ns_to_ticks(now_ns), 1 + step % 2)))
        entries += core.input(now_ns + 500, Kind.IGTL_IN, (data,), links=(1,))
    path = written(tmp_path / "a.mcap", CONFIG, entries)
    alone = 0
    given = Repeated.apply

    def counted(self: Repeated, entry: Entry) -> Entry | None:
        nonlocal alone
        alone += 1
        return given(self, entry)

    monkeypatch.setattr(Repeated, "apply", counted)
    report = deidentify(path, tmp_path / "out", BASIC, KEY)
    assert alone < report.inputs / 2


def test_the_layout_is_that_of_the_codec() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    layout = RosLayout(store.fielddefs)
    found = 0
    for name in sorted(store.fielddefs):
        for text in ("", "a", "abc", "abcd", "longer name"):
            try:
                data = bytes(store.serialize_cdr(default(store, name, text), name))
            except (AttributeError, KeyError, TypeError, ValueError, AssertionError):
                continue
            places = layout.places(name, data)
            if places is None:
                break
            found += 1
            stamps, numbers = places
            for at in stamps:
                assert data[at : at + 8] == b"\x07\0\0\0\x09\0\0\0", name
            assert data[numbers:] == b"\0\0\0\0\0\0\xf8\x3f" * ((len(data) - numbers) // 8), name
            assert b"\xf8\x3f" not in data[:numbers], name
            assert layout.places(name, data + b"\0") is layout.places(name, data[:-1]) is None
    assert found > 50


def default(store: Any, name: str, text: str) -> Any:
    """A message of a type with these strings, 1.5 as each number, and 7.000000009 s as each time."""
    values: dict[str, Any] = {}
    for field, (kind, inner) in store.fielddefs[name][1]:
        if name == "builtin_interfaces/msg/Time":
            values[field] = 7 if field == "sec" else 9
        elif kind.name == "NAME":
            values[field] = default(store, inner, text)
        elif kind.name == "BASE":
            values[field] = text if inner[0] == "string" else 1.5 if inner[0].startswith("float") else 1
        else:
            count = inner[1] if kind.name == "ARRAY" else 0
            values[field] = np.full(count, 1.5)
    return store.types[name](**values)
