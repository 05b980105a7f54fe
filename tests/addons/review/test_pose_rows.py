"""Poses of many messages at once are those of the messages one by one."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.review.material import Material
from igtl_gateway.convert.common_msgs import FrameTransform, PoseStamped, TFMessage
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.rows import Heads, rows_of
from tests.places import FIXTURES
from tests.tables import table

UNIT_M = 0.001


def pose(rng: random.Random) -> tuple[float, ...]:
    numbers = [rng.uniform(-1, 1) for _ in range(7)]
    if rng.random() < 0.03:
        numbers[rng.randrange(7)] = rng.choice([float("nan"), float("inf"), -0.0])
    return (*numbers[:3], 0.0, 0.0, 0.0, 0.0) if rng.random() < 0.02 else tuple(numbers)


def message(rng: random.Random, odd: float) -> tuple[str, str, bytes]:
    def name(usual: str, *others: str) -> str:
        return rng.choice(others) if rng.random() < odd else usual

    header = Header(rng.choice([0, rng.randrange(1 << 31) * 1_000_000_000]), name("base", "/base", "map", ""))
    moved: Any = pose(rng)
    made: Any
    match rng.randrange(4):
        case 0:
            made = TransformStamped(header, name("tool", "/tool", "other", "base", ""), moved[:3], moved[3:])
            topic = rng.choice(["/tool", "/second"])
        case 1:
            topic, made = rng.choice(["/pose", "/needle"]), PoseStamped(header, moved)
        case _:
            children = ("tool", "needle", "camera")[: rng.choice([1, 1, 3])]
            poses: Any = [pose(rng) for _ in children]
            made = TFMessage(
                tuple(
                    FrameTransform(header, name(child, "tool"), each)
                    for child, each in zip(children, poses, strict=True)
                )
            )
            topic = rng.choice(["/tf", "/tf", "/tf_static"])
    data = made.pack()
    return topic, made.TYPE, data[: rng.randrange(len(data))] if rng.random() < odd / 40 else data


def facts(material: Material) -> Any:
    edges = material.frames._edges
    return [
        (child, each.parent, each.source, each.stamps.tobytes(), each.arrivals.tobytes(), each.poses.tobytes())
        for child, each in edges.items()
    ], material.notes


def both(path: Path) -> int:
    """Compare both ways; return the number of entries that were read one by one by the quick one."""
    alone, plain, quick = 0, Material(unit_m=UNIT_M), Material(unit_m=UNIT_M)
    taken = quick.take

    def counted(entry: Entry) -> None:
        nonlocal alone
        alone += 1
        taken(entry)

    with SessionFile.open(path) as file, pytest.MonkeyPatch.context() as patch:
        for entry in file.entries():
            plain.take(entry)
        patch.setattr(quick, "take", counted)
        heads = Heads()
        for rows in rows_of(file, heads):
            quick.take_rows(rows, heads)
    assert facts(quick) == facts(plain)
    return alone


@table("seed", range(12))
def test_a_random_session(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    odd, count = (0.0, 0.02, 0.3)[seed % 3], 400
    writer = SessionWriter(tmp_path / "a.mcap", {}, chunk_bytes=rng.choice((3_000, 20_000, 1 << 20)))
    for number in range(1, count + 1):
        topic, ros_type, data = message(rng, odd)
        kind = rng.choice([Kind.ROS_IN, Kind.ROS_OUT])
        writer.write(Entry(number, number * 1_000, kind, topic, ros_type, (data,)))
    writer.close({})
    assert both(tmp_path / "a.mcap") == 0 or odd


@table("path", [path for path in sorted(FIXTURES.glob("*.mcap")) if path.stem != "brain"])
def test_a_fixture(path: Path) -> None:
    both(path)


def test_poses_are_read_many_at_once(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "a.mcap", {})
    for number in range(1, 100):
        made = TransformStamped(Header(number, "base"), "tool", (float(number), 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        writer.write(Entry(number, number, Kind.ROS_IN, "/tool", made.TYPE, (made.pack(),)))
    writer.close({})
    assert both(tmp_path / "a.mcap") == 0
