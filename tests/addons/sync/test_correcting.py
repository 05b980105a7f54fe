"""``sync --apply`` on streams without stamps: corrected so that ``sync`` confirms it, or refused without a file."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

import igtl_gateway
from igtl_gateway.addons.sync.correcting import together
from igtl_gateway.addons.sync.lag import Verdict
from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.convert.common_msgs import FrameTransform, JointState, PoseStamped, TFMessage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.corrections import StampCorrection
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.transform import Transform

BEGIN_NS = 1_700_000_000 * NS_PER_S
SECONDS, LATE_S = 12, 0.0473
IMPORT = {"imported_format": "a test", "igtl_gateway_version": igtl_gateway.__version__}


def height(at: float) -> float:
    """A movement that does not repeat itself."""
    return math.sin(2.1 * at) + 0.7 * math.sin(3.7 * at + 1) + 0.4 * math.sin(0.21 * at * at)


def ros1_bag(path: Path) -> Path:
    """A camera at 30 Hz of a type without a header, and joints at 50 Hz whose times are late; both headers empty."""
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    header = types["std_msgs/msg/Header"](seq=0, stamp=types["builtin_interfaces/msg/Time"](0, 0), frame_id="")
    events: list[tuple[float, int, Any]] = []
    for at in np.arange(0, SECONDS, 1 / 30).tolist():
        events.append((at, 0, types["std_msgs/msg/Float64"](height(at))))
    for at in np.arange(0, SECONDS, 1 / 50).tolist():
        places = np.array([2 * height(at)])
        joints = types["sensor_msgs/msg/JointState"](header, ["insertion"], places, np.zeros(0), np.zeros(0))
        events.append((at + LATE_S, 1, joints))
    with Writer(path) as writer:
        channels = [
            writer.add_connection(topic, ros_type, typestore=store)
            for topic, ros_type in (("/height", "std_msgs/msg/Float64"), ("/joints", "sensor_msgs/msg/JointState"))
        ]
        for at, channel, message in sorted(events, key=lambda event: event[:2]):
            raw = store.serialize_ros1(message, channels[channel].msgtype)
            writer.write(channels[channel], BEGIN_NS + round(at * NS_PER_S), raw)
    return path


def session(path: Path, source_of: Callable[[int, int], int], facts: dict[str, str] | None = None) -> Path:
    """Joints in two topics; ``source_of`` gives the stamp of message N of ``/late`` from its exact one."""
    writer = SessionWriter(path, IMPORT if facts is None else facts)
    for seq in range(1, 2 * SECONDS * 40, 2):
        at = (seq // 2) / 40
        now_ns = BEGIN_NS + round(at * NS_PER_S)
        for number, topic, value in ((seq, "/on_time", height(at)), (seq + 1, "/late", height(at - LATE_S))):
            source_ns = now_ns if number == seq else source_of(seq // 2, now_ns)
            joints = JointState(Header(0, ""), ("joint",), np.array([value]), np.array([]), np.array([])).pack()
            writer.write(
                Entry(number, now_ns + number - seq, Kind.ROS_IN, topic, JointState.TYPE, (joints,), (), source_ns)
            )
    writer.close({})
    return path


def lag_ms(path: Path, *streams: str) -> float:
    with igtl_gateway.open(path) as recording:
        lag = igtl_gateway.lag(*(recording[name] for name in streams))
    assert lag.verdict is Verdict.MEASURED
    return lag.lag_s * 1e3


@pytest.mark.parametrize("streams", [("/height", "/joints"), ("/joints", "/height")])
def test_a_bag_of_ros_1(tmp_path: Path, streams: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    """Neither stream has a stamp.  The lag of the one that is corrected is gone, and its bytes are as before."""
    assert main(["import", str(ros1_bag(tmp_path / "a.bag")), "-o", str(tmp_path / "a.mcap")]) == 0
    before, out = tmp_path / "a.mcap", tmp_path / "out.mcap"
    sign = 1 if streams[1] == "/joints" else -1
    assert lag_ms(before, *streams) == pytest.approx(sign * LATE_S * 1e3, abs=1)
    capsys.readouterr()
    assert main(["sync", str(before), *streams, "--apply", "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert f"the gateway times of {streams[1]}, as its stamps, are corrected; measured again, the lag is " in text
    assert "no stamps in " in text
    assert lag_ms(out, *streams) == pytest.approx(0, abs=0.5)
    with igtl_gateway.open(before) as old, igtl_gateway.open(out) as new:
        assert np.array_equal(old[streams[1]].times, new[streams[1]].times)
        moved_ms = (new[streams[1]].source_times - old[streams[1]].times) / 1e6
        assert moved_ms == pytest.approx(-sign * LATE_S * 1e3, abs=1)
        assert not new[streams[0]].source_times.any()
        assert new.notes[-1].text.startswith(f"gateway times, now the source stamps, of {streams[1]}")
        table = igtl_gateway.align([new[name] for name in streams], on=streams[0], tolerance=0.5)
        picked = table[streams[1]].rows
        assert np.all(np.abs(new[streams[1]].source_times[picked[picked >= 0]] - table.times[picked >= 0]) < 2e7)


SOURCES: list[tuple[str, Callable[[int, int], int]]] = [
    ("none", lambda index, now_ns: 0),
    ("one message without", lambda index, now_ns: 0 if index == 7 else now_ns),
    ("every second", lambda index, now_ns: now_ns * (index % 2)),
    ("all", lambda index, now_ns: now_ns + 3 * NS_PER_S // 100),
]


@pytest.mark.parametrize("source_of", [row[1] for row in SOURCES], ids=[row[0] for row in SOURCES])
def test_some_messages_without_a_stamp(
    tmp_path: Path, source_of: Callable[[int, int], int], capsys: pytest.CaptureFixture[str]
) -> None:
    before, out = session(tmp_path / "a.mcap", source_of), tmp_path / "out.mcap"
    words = ["sync", str(before), "/on_time", "/late", "--apply", "-o", str(out), "--json"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert abs(found["lags"][0]["lag_s"]) > 0.04
    assert abs(found["applied"]["lag"]["lag_s"]) < 5e-4
    assert lag_ms(out, "/on_time", "/late") == pytest.approx(0, abs=0.5)


def test_a_topic_in_both_directions(tmp_path: Path) -> None:
    """Its key is not its name."""
    path, out = tmp_path / "a.mcap", tmp_path / "out.mcap"
    writer = SessionWriter(path, IMPORT)
    seq = 0
    for index in range(SECONDS * 40):
        at = index / 40
        now_ns = BEGIN_NS + round(at * NS_PER_S)
        for kind, topic, value in (
            (Kind.ROS_IN, "/on_time", height(at)),
            (Kind.ROS_IN, "/late", height(at - LATE_S)),
            (Kind.ROS_OUT, "/late", 0.0),
        ):
            seq += 1
            joints = JointState(Header(0, ""), ("joint",), np.array([value]), np.array([]), np.array([])).pack()
            writer.write(Entry(seq, now_ns + seq, kind, topic, JointState.TYPE, (joints,), (), 0))
    writer.close({})
    assert main(["sync", str(path), "/on_time", "in:/late", "--apply", "-o", str(out)]) == 0
    assert lag_ms(out, "/on_time", "in:/late") == pytest.approx(0, abs=0.5)


def test_what_the_output_does_not_confirm_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A correction that does not change what is measured leaves no file."""
    path, out = session(tmp_path / "a.mcap", lambda index, now_ns: 0), tmp_path / "out.mcap"
    monkeypatch.setattr("igtl_gateway.addons.sync.correcting.corrected", lambda entries, *_: entries)
    assert main(["sync", str(path), "/on_time", "/late", "--apply", "-o", str(out)]) == 1
    told = capsys.readouterr()
    assert "/late: after the correction by +47." in told.err and "found +47." in told.err
    assert "corrected" not in told.out
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.mcap"]


def test_stamps_that_would_be_before_1970(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Senders that count from 0."""
    path, counted, out = (
        session(tmp_path / "a.mcap", lambda index, now_ns: 0),
        tmp_path / "b.mcap",
        tmp_path / "out.mcap",
    )
    writer = SessionWriter(counted, IMPORT)
    with SessionFile.open(path) as file:
        for entry in file.entries():
            writer.write(replace(entry, source_ns=1 + entry.stamp_ns - BEGIN_NS))
    writer.close({})
    assert main(["sync", str(counted), "/on_time", "/late", "--apply", "-o", str(out)]) == 1
    assert "expected a stamp after 1970" in capsys.readouterr().err
    assert not out.exists()


def posed(path: Path, late_s: float = LATE_S) -> Path:
    """Poses of a peer, and the same poses of ROS, late in both stamps; a frame of /tf beside one that is not late."""
    writer = SessionWriter(path, IMPORT)
    entries = []
    for number in range(SECONDS * 40):
        at = number / 40
        now_ns = BEGIN_NS + round(at * NS_PER_S)
        late_ns = now_ns + round(late_s * NS_PER_S)
        x = height(at)
        content = Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 1000 * x, 0, 0))
        entries.append((now_ns + 10**6, Kind.IGTL_IN, "TRANSFORM/Probe", "TRANSFORM",
                        join(encode(Message("TRANSFORM", "Probe", content, ns_to_ticks(now_ns)))), now_ns))  # fmt: skip
        pose = PoseStamped(Header(late_ns, "base"), (x, 0, 0, 0, 0, 0, 1)).pack()
        entries.append((late_ns + 10**6, Kind.ROS_IN, "/pose", PoseStamped.TYPE, pose, late_ns))
        frames = [FrameTransform(Header(late_ns, "base"), "tip", (x, 0, 0, 0, 0, 0, 1))]
        frames.append(FrameTransform(Header(late_ns, "base"), "exact", (height(at + late_s), 0, 0, 0, 0, 0, 1)))
        entries.append(
            (late_ns + 2 * 10**6, Kind.ROS_IN, "/tf", TFMessage.TYPE, TFMessage(tuple(frames)).pack(), late_ns)
        )
    for seq, (at_ns, kind, channel, name, data, source_ns) in enumerate(sorted(entries, key=lambda each: each[0]), 1):
        links = (1,) if kind is Kind.IGTL_IN else ()
        writer.write(Entry(seq, at_ns + seq, kind, channel, name, (data,), links, source_ns))
    writer.close({})
    return path


def test_what_readers_read_is_corrected_and_the_bytes_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """header.stamp in an export, ``Poses.stamps``, ``align`` and ``tf.lookup``, each judged by the movement itself."""
    before, out, bag = posed(tmp_path / "a.mcap"), tmp_path / "b.mcap", tmp_path / "bag"
    assert main(["sync", str(before), "TRANSFORM/Probe", "/pose", "--apply", "-o", str(out)]) == 0
    assert "header.stamp is corrected where it is read" in capsys.readouterr().out
    with SessionFile.open(before) as one, SessionFile.open(out) as two:
        assert [e.data() for e in one.entries()] == [e.data() for e in two.entries() if e.kind is not Kind.EDGE_NOTE]
    assert main(["export", str(out), "--to", "rosbag2", "-o", str(bag), "--streams", "/pose"]) == 0
    assert "source stamps of /pose are corrected by a lag" in capsys.readouterr().out
    store = get_typestore(Stores.ROS2_JAZZY)

    def away(x: float, stamp_ns: int) -> float:
        return abs(x - height((stamp_ns - BEGIN_NS) / NS_PER_S))

    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            message: Any = store.deserialize_cdr(data, connection.msgtype)
            stamp = message.header.stamp
            assert away(message.pose.position.x, stamp.sec * NS_PER_S + stamp.nanosec) < 1e-3
    with igtl_gateway.open(out) as recording:
        poses = recording["/pose"].poses()
        for stamps in (poses.stamps, poses.source_times, recording["/pose"].stamps):
            assert max(map(away, poses.positions[:, 0].tolist(), stamps.tolist())) < 1e-3
        table = recording["/pose"].to_arrow()
        assert table["header.stamp_ns"].to_pylist() == poses.stamps.tolist()
        found = igtl_gateway.align([recording["TRANSFORM/Probe"]], on=recording["/pose"], method="interpolate")
        off = found.poses("TRANSFORM/Probe").positions[:, 0] / 1000 - poses.positions[:, 0]
        assert np.nanmax(np.abs(off)) < 1e-3


def test_of_a_topic_with_several_frames_one_is_corrected(tmp_path: Path) -> None:
    before, out = posed(tmp_path / "a.mcap"), tmp_path / "b.mcap"
    words = ["sync", str(before), "TRANSFORM/Probe", "in:/tf", "--frame", "tip", "--apply", "-o", str(out)]
    assert main(words) == 0
    with igtl_gateway.open(before) as old, igtl_gateway.open(out) as new:
        late = old["/tf"].poses("tip").stamps - new["/tf"].poses("tip").stamps
        assert late / 1e6 == pytest.approx(LATE_S * 1e3, abs=1)
        assert np.array_equal(old["/tf"].poses("exact").stamps, new["/tf"].poses("exact").stamps)
        assert np.array_equal(old["/tf"].source_times, new["/tf"].source_times)
        times = BEGIN_NS + np.arange(2, 30) * NS_PER_S // 3
        for frame in ("tip", "exact"):
            x = new.tf.lookup("base", frame, times, clock="source")[:, 0, 3]
            assert np.abs(x - [height((at - BEGIN_NS) / NS_PER_S) for at in times.tolist()]).max() < 2e-3


def test_a_second_correction_adds_to_the_first(tmp_path: Path) -> None:
    paths = [posed(tmp_path / "a.mcap"), tmp_path / "b.mcap", tmp_path / "c.mcap"]
    for one, two in pairwise(paths):
        assert main(["sync", str(one), "TRANSFORM/Probe", "/pose", "--apply", "-o", str(two)]) == 0
    stamps = []
    for path in paths:
        with igtl_gateway.open(path) as recording:
            stamps.append(recording["/pose"].poses().stamps)
    assert (stamps[0] - stamps[2]) / 1e6 == pytest.approx(LATE_S * 1e3, abs=1)
    skewed = StampCorrection("/pose", "x", 1, 1, 1, 5.0, 0, True, "/pose", "t")
    with pytest.raises(GatewayError, match="corrected already"):
        together({("/pose", "t"): skewed}, {("/pose", "t"): skewed})
