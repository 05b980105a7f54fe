"""Many entries drawn at once: rows, facts and counts are those of one by one, by rerun's own reader."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view import session, stream
from igtl_gateway.addons.view.canvas import Options
from igtl_gateway.addons.view.session import SessionView
from igtl_gateway.base.errors import DamagedRecording, GatewayError
from igtl_gateway.convert.common_msgs import (
    FrameTransform,
    JointState,
    Joy,
    PoseArray,
    PoseStamped,
    TFMessage,
    TwistStamped,
    WrenchStamped,
)
from igtl_gateway.convert.igtl_msgs import Sensor, TrackedTool, TrackingData
from igtl_gateway.convert.rosmsg import Header, String, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.columns import Unfit, in_larger_blocks
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES
from tools import mcap_mutations

from .conftest import START_NS, Drawn, read_back

MS = 1_000_000
SEED, MUTANTS = 61, 100
URDF = '<robot name="arm"><link name="a"/><link name="b"/><joint name="elbow" type="revolute"><parent link="a"/>'
URDF += '<child link="b"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint></robot>'


def drawn(path: Path, out: Path, *, at_once: bool, **options: Any) -> tuple[Drawn, str]:
    """A recording drawn in one of both ways, and where it ends by damage."""
    recording = stream.to_file(out, "test")
    view = SessionView(recording, "base", Options(**options))
    damage = ""
    with SessionFile.open(path) as file:
        try:
            if at_once:
                for columns in in_larger_blocks(file.columns(), 2_000, 1 << 22):
                    view.take_columns(columns)
            else:
                for entry in file.entries():
                    view.take(entry)
        except DamagedRecording as error:
            damage = str(error)
    view.finish()
    stream.close(recording)
    return read_back(out, view), damage


def content(found: Drawn) -> dict[str, list[str]]:
    """All rows of all entities, with the types of their columns."""
    rows = {}
    for path, batches in found.batches.items():
        types = {
            f"{column.name} {column.type}" for batch in batches for column in batch.schema if "RowId" not in column.name
        }
        rows[path] = [
            *sorted(types),
            *sorted(map(repr, found.rows(path)), key=lambda row: (row.partition(",")[0], row)),
        ]
    return rows | {f"always {path}": [repr(sorted(found.static(path).items()))] for path in found.static_batches}


def check(path: Path, folder: Path, **options: Any) -> tuple[Drawn, str]:
    """Compare both ways; return the one at once, and where it ends by damage."""
    one, damage = drawn(path, folder / "one.rrd", at_once=False, **options)
    many, other_damage = drawn(path, folder / "many.rrd", at_once=True, **options)
    expected, got = content(one), content(many)
    assert got.keys() == expected.keys()
    for entity, rows in expected.items():
        assert got[entity] == rows, entity
    assert many.view.counts == one.view.counts
    assert many.view.seen == one.view.seen
    assert many.view.clocks() == one.view.clocks()
    assert other_damage == damage
    return many, damage


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> list[Entry]:
    """The entries that are drawn one by one, of both ways."""
    taken: list[Entry] = []
    draw = SessionView._draw_message

    def counted(self: SessionView, entry: Entry) -> None:
        taken.append(entry)
        draw(self, entry)

    monkeypatch.setattr(SessionView, "_draw_message", counted)
    return taken


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.name for path in FIXTURES.glob("*.mcap")))
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_fixtures_look_the_same_drawn_at_once(name: str, tmp_path: Path) -> None:
    check(FIXTURES / name, tmp_path)


def recorded(path: Path, said: Iterable[tuple[int, Kind, str, Any]]) -> Path:
    """A recording of (ms, kind, topic, message or note or bytes of another type)."""
    writer = SessionWriter(path, {})
    number = 0
    for at_ms, kind, topic, message in said:
        number += 1
        if isinstance(message, int):  # entries that are missing
            number += message
            continue
        name, data = ("", message.pack()) if isinstance(message, Note) else (message.TYPE, message.pack())
        stamp_ns = START_NS + at_ms * MS + number
        source_ns = stamp_ns - 5 * MS if number % 3 else 0
        writer.write(Entry(number, stamp_ns, kind, topic, name, (data,), source_ns=0 if not name else source_ns))
    writer.close({})
    return path


def turned(number: int) -> tuple[float, float, float, float]:
    return (0.0, 0.0, math.sin(number / 50), math.cos(number / 50))


def header(number: int, frame: str = "base") -> Header:
    return Header((START_NS + number * 7 * MS) * bool(number % 4), frame)


def tool(number: int, frame: str = "base", child: str = "tool") -> TransformStamped:
    return TransformStamped(header(number, frame), child, (number / 1000, math.sin(number / 9), 0.1), turned(number))


def test_a_stream_of_poses_is_drawn_at_once(tmp_path: Path, alone: list[Entry]) -> None:
    path = recorded(tmp_path / "a.mcap", ((each, Kind.ROS_IN, "/tool", tool(each)) for each in range(3000)))
    many, _ = check(path, tmp_path)
    assert len(many.rows("tool")) == 3000
    assert len(many.rows("tool/trail")) == 30
    assert len(alone) - 3000 < 200  # up to the first line of the trail


def varied(seed: int) -> Iterable[tuple[int, Kind, str, Any]]:
    """A session with all that is drawn at once, and with all that ends it."""
    chance = np.random.default_rng(seed)
    nan, huge = math.nan, 1e300
    makes: list[Callable[[int], tuple[Kind, str, Any]]] = [
        lambda n: (Kind.ROS_IN, "/tool", tool(n)),
        lambda n: (Kind.ROS_IN, "/tool", tool(n, "camera" if n // 40 % 2 else "base")),
        lambda n: (Kind.ROS_OUT, "/other", tool(n, "base", "tool" if n % 90 else "second")),
        lambda n: (Kind.ROS_IN, "/pose", PoseStamped(header(n), (0.1, nan if n % 7 == 0 else 2e6, 0.3, *turned(n)))),
        lambda n: (Kind.ROS_IN, "/zero", PoseStamped(header(n), (0.1, 0.2, huge, 0.0, 0.0, 0.0, 0.0))),
        lambda n: (Kind.ROS_IN, "/tf", TFMessage((FrameTransform(header(n), f"f{n % 3}", (0.0, n, 1.0, *turned(n))),))),
        lambda n: (Kind.ROS_IN, "/tf_static", TFMessage((FrameTransform(header(n), "s", (0, 0, 1.0, *turned(0))),))),
        lambda n: (Kind.ROS_OUT, "/igtl/in/T/poses", PoseArray(header(n), np.array([[n, 1, 2, *turned(n)]] * 2))),
        lambda n: (
            Kind.ROS_OUT,
            "/igtl/in/T/tracking",
            TrackingData(header(n), (TrackedTool("P", 2, (n, 0.0, 0.0, *turned(n))), TrackedTool("Q", 2, (0.0,) * 7))),
        ),
        lambda n: (
            Kind.ROS_IN,
            "/joint_states",
            JointState(header(n), ("a", "b")[: 1 + bool(n % 5)], np.arange(1 + bool(n % 5)) + n / 7, np.array([nan])),
        ),
        lambda n: (Kind.ROS_IN, "/sensor", Sensor(header(n), 0, 0, "mN"[n > 200], np.arange(1 + n // 150) / 3)),
        lambda n: (Kind.ROS_IN, "/wrench", WrenchStamped(header(n), (n, 1.0, 2.0, nan, huge, 5.0))),
        lambda n: (Kind.ROS_IN, "/twist", TwistStamped(header(n), (n, 1.0, 2.0, 3.0, 4.0, 5.0))),
        lambda n: (Kind.ROS_IN, "/joy", Joy(header(n), np.array([0.1 * n], np.float32), np.array([n], np.int32))),
        lambda n: (Kind.ROS_IN, "/text", String(f"step {n}")),
        lambda n: (Kind.LINK, "", Note(Level.INFO, "link_up", "connected")),
        lambda n: (Kind.NOTE, "", Note(Level.WARN, "queue_drop", "dropped", data={"count": 2})),
    ]  # fmt: skip
    odds = np.array([8, 4, 8, 4, 4, 8, 1, 6, 6, 6, 6, 4, 4, 4, 1, 0.3, 0.3])
    now = 0
    for number in range(1500):
        kind, topic, message = makes[int(chance.choice(len(makes), p=odds / odds.sum()))](number)
        now += int(chance.integers(0, 12)) + 2000 * (number % 700 == 699)
        yield now, kind, topic, message
        if number == 900:
            yield now, Kind.ROS_IN, "", 5
            yield now, Kind.ROS_IN, "/arm/robot_description", String(URDF)
        if number > 900 and number % 6 == 0:
            yield (
                now,
                Kind.ROS_IN,
                "/arm/joint_states",
                JointState(header(number), ("elbow",), np.array([number / 2000])),
            )
        if number > 1200 and number % 6 == 0:
            yield now, Kind.ROS_IN, "/late", tool(number, "a", "b")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sessions_of_all_sorts_look_the_same(seed: int, tmp_path: Path, alone: list[Entry]) -> None:
    many, _ = check(recorded(tmp_path / "a.mcap", varied(seed)), tmp_path, plain=seed == 2)
    total = sum(many.view.counts.messages.values())
    assert len(alone) - total < 0.9 * total
    assert many.view.counts.refused == {}


def test_names_without_end_look_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway.addons.view.pen.MAX_ENTITIES", 12)
    said = [
        (each, Kind.ROS_IN, f"/tool{each % 3}", tool(each, child=f"t{each // 100}" if each % 3 else "t"))
        for each in range(900)
    ]
    many, _ = check(recorded(tmp_path / "a.mcap", said), tmp_path)
    assert many.view.counts.refused


def test_a_file_that_changes_all_the_time_is_drawn_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = []
    segment = session.SessionView._segment

    def counted(*given: Any) -> object:
        blocks.append(given)
        return segment(*given)

    monkeypatch.setattr(SessionView, "_segment", counted)
    check(recorded(tmp_path / "a.mcap", ((n, Kind.ROS_IN, "/tool", tool(n, f"f{n}")) for n in range(800))), tmp_path)
    assert len(blocks) < 200  # work that is in vain has an end


def test_what_is_not_written_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[bool] = []
    monkeypatch.setattr(session, "_UNWRITTEN", 20_000)
    path = recorded(tmp_path / "a.mcap", ((n, Kind.ROS_IN, "/text", String("x" * 1000)) for n in range(100)))
    recording = stream.to_file(tmp_path / "out.rrd", "test")
    view = SessionView(recording)
    monkeypatch.setattr(recording, "flush", lambda: waits.append(True))
    with SessionFile.open(path) as file:
        for columns in file.columns():
            for begin in range(0, len(columns), 10):
                part = columns.where(slice(begin, begin + 10))
                first, last = int(part.begins.min()), int(part.ends.max())
                begins, ends = part.begins - first, part.ends - first
                view.take_columns(replace(part, data=part.data[first:last], begins=begins, ends=ends))
    monkeypatch.undo()
    view.finish()
    stream.close(recording)
    assert 3 <= len(waits) <= 6


@pytest.mark.slow
def test_mutants_end_at_the_same_entry(tmp_path: Path) -> None:
    """Damage that gets past checksums: what is before it is drawn, and the sentence is the same."""
    damaged = 0
    for _, data in islice(mcap_mutations.cases(SEED), MUTANTS):
        path = tmp_path / "mutant.mcap"
        path.write_bytes(data)
        try:
            with SessionFile.open(path) as file:
                file.columns()
        except (GatewayError, Unfit):
            continue
        damaged += bool(check(path, tmp_path)[1])
    assert damaged > MUTANTS // 20
