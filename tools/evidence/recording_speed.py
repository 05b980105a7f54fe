"""How fast Python reads recordings: a million poses, all of star, the last second of 2 GB; against rosbags and pandas.

    .venv/bin/python tools/evidence/recording_speed.py [FOLDER]    needs 2.3 GB in FOLDER (default: a temporary folder)

Prints seconds of wall clock and of CPU.  Numbers of both sides are compared with each other.
"""

from __future__ import annotations

import struct
import sys
import tempfile
import time
from collections.abc import Callable
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import igtl_gateway
from igtl_gateway.base.untrusted import files
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire.header import crc64
from igtl_gateway.wire.message import Message, encode
from igtl_gateway.wire.transform import Transform

START_NS = 1_767_225_600_000_000_000
POSES = 1_000_000
STAR = Path(__file__).parents[2] / "fixtures" / "star.mcap"
#: Header (stamp, "base"), child frame ("tool"), seven numbers: geometry_msgs/msg/TransformStamped in CDR.
_STAMPED = struct.Struct("<4BiII5s3xI5s3x7d")


def write_poses(path: Path) -> None:
    """A million TRANSFORM messages."""
    identity = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    message = b"".join(bytes(part) for part in encode(Message("TRANSFORM", "AToB", identity)))
    writer = SessionWriter(path, {})
    for number in range(POSES):
        body = message[58:94] + struct.pack(">3f", number, 0.0, 0.0)
        data = message[:50] + struct.pack(">Q", crc64(body)) + body
        writer.write(
            Entry(number + 1, START_NS + number * 1000, Kind.IGTL_IN, "TRANSFORM/AToB", "TRANSFORM", (data,), (1,))
        )
    writer.close({})


def write_ros_poses(path: Path) -> None:
    """A million TransformStamped messages."""
    writer = SessionWriter(path, {})
    for number in range(POSES):
        data = _STAMPED.pack(0, 1, 0, 0, 0, number, 5, b"base", 5, b"tool", number, 0, 0, 0, 0, 0, 1)
        stamp_ns = START_NS + number * 1000
        writer.write(Entry(number + 1, stamp_ns, Kind.ROS_IN, "/tool", "geometry_msgs/msg/TransformStamped", (data,)))
    writer.close({})


def write_large(path: Path) -> None:
    """2,000 messages of 1 MiB in 200 s, with ten poses each."""
    writer = SessionWriter(path, {}, compression="none")
    pixels, seq = bytes(1 << 20), 0
    for number in range(2000):
        rows = [("/image", "std_msgs/msg/String", pixels)]
        pose = struct.pack("<4B7d", 0, 1, 0, 0, number, 0, 0, 0, 0, 0, 1)
        rows += [("/pose", "geometry_msgs/msg/Pose", pose)] * 10
        for place, (topic, ros_type, data) in enumerate(rows):
            seq += 1
            stamp_ns = START_NS + number * 100_000_000 + place * 9_000_000
            writer.write(Entry(seq, stamp_ns, Kind.ROS_IN, topic, ros_type, (data,)))
    writer.close({})


def measured(title: str, call: Callable[[], Any]) -> tuple[Any, float]:
    """The result of a call, and its CPU seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    found = call()
    used = time.process_time() - cpu
    print(f"{title:60} {time.perf_counter() - wall:7.2f} s  {used:7.2f} s of CPU", flush=True)
    return found, used


def poses_of(path: Path, key: str) -> Any:
    with igtl_gateway.open(path) as recording:
        return recording[key].poses()


def tables_of(path: Path) -> Any:
    with igtl_gateway.open(path) as recording:
        return recording.to_arrow()


def by_hand(path: Path, ros_type: str = "geometry_msgs/msg/TransformStamped") -> pandas.DataFrame:
    """What a script does with rosbags and pandas."""
    rows = []
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, stamp_ns, data in reader.messages([c for c in reader.connections if c.msgtype == ros_type]):
            transform: Any = reader.deserialize(data, connection.msgtype)
            place, turn = transform.transform.translation, transform.transform.rotation
            rows.append((stamp_ns, place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))
    return pandas.DataFrame(rows, columns="t x y z qx qy qz qw".split())


class _Counted(FileIO):
    """Counts the bytes that are read."""

    count = 0

    def readinto(self, buffer: Any) -> int | None:
        size = super().readinto(buffer)
        _Counted.count += size or 0
        return size


def last_second(path: Path) -> int:
    with igtl_gateway.open(path) as recording:
        return len(recording["/pose"].between(-1.0).poses())


def main(folder: Path) -> None:
    tables_of(STAR)  # imports
    poses, ros, large = folder / "poses.mcap", folder / "ros.mcap", folder / "large.mcap"
    write_poses(poses)
    write_ros_poses(ros)
    measured(f"{POSES:,} TRANSFORM messages to matrices", lambda: poses_of(poses, "TRANSFORM/AToB"))
    found, own = measured(f"{POSES:,} TransformStamped messages to matrices", lambda: poses_of(ros, "/tool"))
    frame, other = measured("the same with rosbags and pandas", lambda: by_hand(ros))
    assert np.array_equal(found.positions[:, 0], frame["x"])
    print(f"ratio of CPU: {other / own:.1f}")
    measured("all of star to Arrow", lambda: tables_of(STAR))
    write_large(large)
    vars(files)["open_file"] = lambda path: BufferedReader(_Counted(path))
    measured(f"last second of {large.stat().st_size:,} bytes", lambda: last_second(large))
    print(f"bytes read: {_Counted.count:,}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as name:
            main(Path(name))
