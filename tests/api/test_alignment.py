"""Streams at the times of one of them, against a search over all messages."""

from __future__ import annotations

import math
import random
import struct
from datetime import timedelta
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
import pytest
from mcap.writer import Writer

import igtl_gateway
from igtl_gateway.api.recording import Recording
from igtl_gateway.base.errors import ClockWarning, ConfigError
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire.message import Message, encode
from igtl_gateway.wire.transform import Transform
from tests.places import FIXTURES

MS = 1_000_000
POSE, NUMBER = "TRANSFORM/AToB", "/number"


#: The rule is tested, on times that are made so.
_NO_MATTER = pytest.mark.filterwarnings("ignore::igtl_gateway.base.errors.ClockWarning")


def transform(angle: float, x: float) -> bytes:
    c, s = math.cos(angle), math.sin(angle)
    content = Transform((c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0, x, 0.0, 0.0))
    return b"".join(bytes(part) for part in encode(Message("TRANSFORM", "AToB", content)))


def session(path: Path, rows: list[tuple[int, str, bytes, int]]) -> Recording:
    """Messages (time in ms, stream, payload, source time in ms)."""
    writer = SessionWriter(path, {})
    for number, (time, name, data, source) in enumerate(sorted(rows), 1):
        kind = (Kind.IGTL_IN, "TRANSFORM") if name == POSE else (Kind.ROS_IN, "std_msgs/msg/Float64")
        stamp = 10**18 + time * MS + number
        source_ns = max(10**18 + source * MS, 0)
        writer.write(Entry(number, stamp, kind[0], name, kind[1], (data,), (1,) if name == POSE else (), source_ns))
    writer.close({})
    return igtl_gateway.open(path)


def number(value: float) -> bytes:
    return struct.pack("<4Bd", 0, 1, 0, 0, value)


@_NO_MATTER
def test_the_nearest_message_within_the_tolerance_is_found(tmp_path: Path) -> None:
    turn = random.Random(3)
    rows = [(turn.randrange(2000), NUMBER, number(each), turn.randrange(2000)) for each in range(60)]
    rows += [(turn.randrange(2000), POSE, transform(0.0, each), turn.randrange(2000)) for each in range(40)]
    with session(tmp_path / "a.mcap", rows) as recording:
        values, poses = recording[NUMBER], recording[POSE]
        for clock, samples, wanted in (
            ("gateway", values.times, poses.times),
            ("source", values.source_times, poses.source_times),
        ):
            found = igtl_gateway.align([values, poses], POSE, 0.02, clock=clock)  # type: ignore[arg-type]
            assert found.times.tolist() == wanted.tolist()
            for row, time in enumerate(wanted.tolist()):
                distances = [abs(time - sample) for sample in samples.tolist()]
                best = min(distances)
                own = int(found[NUMBER].rows[row])
                if best > 20 * MS:
                    assert (own, found[NUMBER].offsets[row]) == (-1, 0)
                else:
                    assert distances[own] == best
                    assert found[NUMBER].offsets[row] == samples[own] - time
            kept = igtl_gateway.align([values], poses, timedelta(milliseconds=20), clock=clock, missing="drop")  # type: ignore[arg-type]
            assert kept.times.tolist() == wanted[found[NUMBER].rows >= 0].tolist()
            assert kept.poses(POSE).matrices.shape == (len(kept), 4, 4)
            frame = found.to_pandas()
            cells = [None if math.isnan(cell) else cell for cell in frame["/number.data"]]
            content = [message.content.data for message in values.messages()]
            assert cells == [content[each] if each >= 0 else None for each in found[NUMBER].rows.tolist()]
            assert len(kept.to_arrow()) == len(kept)


@_NO_MATTER
def test_poses_are_interpolated_and_not_extrapolated(tmp_path: Path) -> None:
    rows: list[tuple[int, str, bytes, int]] = [
        (0, POSE, transform(0.0, 0.0), 0),
        (100, POSE, transform(1.0, 10.0), 100),
        (500, POSE, transform(2.0, 50.0), 500),
    ]
    rows += [(time, NUMBER, number(time), time) for time in (-10, 0, 50, 100, 300, 500, 510)]
    with session(tmp_path / "a.mcap", rows) as recording:
        arguments: dict[str, Any] = {"method": "interpolate", "clock": "source"}
        found = igtl_gateway.align([recording[POSE]], recording[NUMBER], None, **arguments)
        poses = found.poses(POSE)
        assert np.allclose(poses.positions[1:6, 0], [0, 5, 10, 30, 50], atol=1e-6)
        assert np.allclose(poses.quaternions[1:6, 2], np.sin(np.array([0, 0.5, 1.0, 1.5, 2.0]) / 2), atol=1e-6)
        assert found[POSE].rows.tolist() == [-1, 0, 0, 1, 1, 2, -1]
        near = igtl_gateway.align([recording[POSE]], recording[NUMBER], 0.1, **arguments)
        # at 300 ms no message is within 100 ms; a message itself is
        assert near[POSE].rows.tolist() == [-1, 0, 0, 1, -1, 2, -1]
        assert np.isnan(near.poses(POSE).matrices[[0, 4, 6]]).all()
        table = near.to_arrow()
        assert table["TRANSFORM/AToB.x_mm"].null_count == 0 and table.schema.field("TRANSFORM/AToB.x_mm").metadata
        assert table["TRANSFORM/AToB.offset_ns"].null_count == 3
        assert table["/number.data"].to_pylist() == [-10, 0, 50, 100, 300, 500, 510]


@_NO_MATTER
def test_damaged_messages_are_not_used(tmp_path: Path) -> None:
    bad = bytearray(transform(0.0, 5.0))
    bad[70] ^= 1
    rows = [(0, POSE, transform(0.0, 1.0), 0), (10, POSE, bytes(bad), 10), (20, POSE, transform(0.0, 3.0), 20)]
    with session(tmp_path / "a.mcap", [*rows, (10, NUMBER, number(1.0), 10)]) as recording:
        found = igtl_gateway.align([recording[POSE]], recording[NUMBER], method="interpolate", clock="source")
        assert found.poses(POSE).positions[0, 0] == 2.0
        own = igtl_gateway.align([], recording[POSE])
        assert own.poses(POSE).positions[:, 0].tolist()[::2] == [1.0, 3.0]
        assert np.isnan(own.poses(POSE).matrices[1]).all()
        assert own.to_arrow()[f"{POSE}.entry"].null_count <= 1


@_NO_MATTER
def test_the_tool_of_star_at_the_times_of_the_clouds() -> None:
    with igtl_gateway.open(FIXTURES / "star.mcap") as recording:
        tool, cloud, text = recording["TRANSFORM/ToolToBase"], recording["/star/cloud"], recording["STRING/StarStatus"]
        table = igtl_gateway.align([tool, cloud, text], on=cloud, tolerance=0.02, method="interpolate")
        assert len(table) == 12
        assert table.poses(tool.key).matrices.shape == (12, 4, 4)
        assert abs(table[tool.key].offsets).max() < 20 * MS
        with pytest.raises(ConfigError, match="STRING/StarStatus: found type STRING"):
            table.poses(text.key)
        with pytest.raises(KeyError, match="expected one of"):
            table["nothing"]


def test_a_stream_without_messages_has_none_at_all_times() -> None:
    with igtl_gateway.open(FIXTURES / "star.mcap") as recording:
        cloud, nothing = recording["/star/cloud"], recording["TRANSFORM/ToolToBase"].between(100.0)
        assert (nothing.count, nothing.first_time, len(nothing.poses()), len(nothing.to_pandas())) == (0, 0, 0, 0)
        assert recording.between(100.0).tf.frames == ()
        for method in ("nearest", "interpolate"):
            table = igtl_gateway.align([nothing], on=cloud, method=method)
            assert np.isnan(table.poses(nothing.key).matrices).all()
            assert table.to_arrow()[f"{nothing.key}.offset_ns"].null_count == 12
            assert len(igtl_gateway.align([nothing], on=cloud, missing="drop")) == 0


def test_wrong_arguments_are_errors_in_one_line() -> None:
    with igtl_gateway.open(FIXTURES / "star.mcap") as recording:
        tool = recording["TRANSFORM/ToolToBase"]
        wrong: list[tuple[list[Any], Any, dict[str, Any], str]] = [
            ([tool], "nothing", {}, "on: found 'nothing', expected one of TRANSFORM/ToolToBase"),
            ([tool], tool, {"tolerance": -1}, "tolerance: found -1, expected 0 or more seconds"),
            ([tool], tool, {"method": "cubic"}, "method: found 'cubic', expected one of nearest, interpolate"),
            ([tool], tool, {"clock": "wall"}, "clock: found 'wall'"),
            ([tool], tool, {"missing": "zero"}, "missing: found 'zero'"),
            ([tool, tool.between(1.0)], tool, {}, "streams: found two streams"),
        ]
        for streams, on, more, text in wrong:
            with pytest.raises(ConfigError, match=text):
                igtl_gateway.align(streams, on, **more)


def test_messages_of_one_time_are_told_apart(tmp_path: Path) -> None:
    """A file of another program may have several messages of a topic at one time; here two, and some are damaged."""
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "other")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in ("/a", "/b")}
        for row in range(60):
            for topic, channel in channels.items():
                data = number(row)[:7] if topic == "/b" and row % 7 == 3 else number(row)
                log, publish = 10**18 + row // 2 * 40 * MS, 10**18 + row * 20 * MS + 1000
                writer.add_message(channel, log, data, publish, row)
        writer.finish()  # type: ignore[no-untyped-call]
    with igtl_gateway.open(path) as recording:
        one, two = recording["/a"], recording["/b"]
        found = igtl_gateway.align([one, two], on=one)
        assert (found.clock, found["/b"].rows.tolist()) == ("source", list(range(60)))
        table = found.to_arrow()
        expected = [None if row % 7 == 3 else row for row in range(60)]
        assert (table["/a.data"].to_pylist(), table["/b.data"].to_pylist()) == (list(range(60)), expected)
        assert two.arrow_and_rows()[1].tolist() == [row for row in range(60) if row % 7 != 3]


TRUE_MM_S = 150.0


@pytest.mark.parametrize("seed", range(30))
def test_each_pose_is_that_of_its_moment_or_none_or_it_is_reported(tmp_path: Path, seed: int) -> None:
    """A tool of a peer and numbers of ROS, each with latency, jitter, an offset of its clock, and a gap."""
    turn = random.Random(seed)
    late, ahead = (turn.uniform(0, 20), turn.choice([1, 100, 300])), (turn.choice([0, 0, 3000, -3000]), 0)
    stamped, jitter, gap = turn.random() < 0.8, turn.choice([0, 20]), turn.uniform(500, 2000)
    rows: list[tuple[float, str, bytes, float]] = []
    for each in range(151):
        at = 20.0 * each
        if not gap < at < gap + 500:
            rows.append((at, POSE, transform(0.0, TRUE_MM_S * at / 1000), at + ahead[0]))
    rows += [(50.0 * each, NUMBER, number(50 * each), 50.0 * each) for each in range(60)]
    sent = []
    for at, name, data, stamp in rows:
        arrival = int(10 + at + late[name == NUMBER] + turn.uniform(0, jitter))
        sent.append((arrival, name, data, int(stamp) if stamped or name == POSE else -(10**12)))
    with session(tmp_path / "a.mcap", sent) as recording, catch_warnings(record=True) as warned:
        simplefilter("always")
        for method in ("nearest", "interpolate"):
            found = igtl_gateway.align([recording[POSE]], on=recording[NUMBER], method=method)
            values = [message.content.data for message in recording[NUMBER].messages()]
            away = np.abs(found.poses(POSE).positions[:, 0] - TRUE_MM_S * np.array(values) / 1000)
            good = np.isfinite(away)
            assert good.sum() > 30
            # a nearest pose is as far away as is stated
            exact = 0.0 if method == "interpolate" else TRUE_MM_S * np.abs(found[POSE].offsets[good]) / 1e9
            said = [str(each.message) for each in warned if issubclass(each.category, ClockWarning)]
            if found.clock == "gateway":
                assert any("times of receipt" in each for each in said)
            else:
                latency = TRUE_MM_S * 0.031 if ahead[0] else 0.0
                assert (not ahead[0]) or any("corrected by" in each for each in said)
                assert (away[good] <= exact + latency + 1e-4).all()
