"""Streams at the times of one of them, against a search over all messages."""

from __future__ import annotations

import math
import random
import struct
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.api.recording import Recording
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire.message import Message, encode
from igtl_gateway.wire.transform import Transform
from tests.places import FIXTURES

MS = 1_000_000
POSE, NUMBER = "TRANSFORM/AToB", "/number"


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
        writer.write(
            Entry(number, stamp, kind[0], name, kind[1], (data,), (1,) if name == POSE else (), 10**18 + source * MS)
        )
    writer.close({})
    return igtl_gateway.open(path)


def number(value: float) -> bytes:
    return struct.pack("<4Bd", 0, 1, 0, 0, value)


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


def test_poses_are_interpolated_and_not_extrapolated(tmp_path: Path) -> None:
    rows: list[tuple[int, str, bytes, int]] = [
        (0, POSE, transform(0.0, 0.0), 0),
        (100, POSE, transform(1.0, 10.0), 100),
        (500, POSE, transform(2.0, 50.0), 500),
    ]
    rows += [(time, NUMBER, number(time), time) for time in (-10, 0, 50, 100, 300, 500, 510)]
    with session(tmp_path / "a.mcap", rows) as recording:
        arguments: dict[str, Any] = {"method": "interpolate", "clock": "source"}
        found = igtl_gateway.align([recording[POSE]], recording[NUMBER], **arguments)
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
            ([tool], tool, {"method": "cubic"}, "method: found 'cubic', expected 'nearest' or 'interpolate'"),
            ([tool], tool, {"clock": "wall"}, "clock: found 'wall'"),
            ([tool], tool, {"missing": "zero"}, "missing: found 'zero'"),
            ([tool, tool.between(1.0)], tool, {}, "streams: found two streams"),
        ]
        for streams, on, more, text in wrong:
            with pytest.raises(ConfigError, match=text):
                igtl_gateway.align(streams, on, **more)
