"""Export to CSV at once against the plain way, message by message: equal files and an equal account of any session."""

from __future__ import annotations

import random
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.addons.exchange import csv_out
from igtl_gateway.base.buffers import join
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.header import CRC_AT, HEADER_SIZE, U64, crc64
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Position, Transform
from tests.addons.exchange import plain_csv
from tests.addons.exchange.exported import exported
from tests.places import FIXTURES, is_light
from tests.record import samples
from tests.tables import table

ROS2 = get_typestore(Stores.ROS2_JAZZY)
ANY = "a/msg/Any"
TEXT = """bool yes
byte b
char c
int8 i8
uint8 u8
int16 i16
uint16 u16
int32 i32
uint32 u32
int64 i64
uint64 u64
float32 f32
float64 f64
string text
builtin_interfaces/Time when
builtin_interfaces/Duration lasts
geometry_msgs/Vector3 v
float64[3] three
float32[2] two
uint8[4] bytes
bool[2] both
string entry
int32 item
"""
for name, each in get_types_from_msg(TEXT, ANY).items():
    ROS2.register({name: each})


def definition_of(ros_type: str) -> Definition | None:
    return Definition(ROS2.generate_msgdef(ANY)[0].encode()) if ros_type == ANY else None


def rotation(rng: random.Random) -> tuple[float, ...]:
    x, y, z, w = (rng.gauss(0, 1) for _ in range(4))
    scale = 2 / (x * x + y * y + z * z + w * w)
    return (
        1 - scale * (y * y + z * z), scale * (x * y + z * w), scale * (x * z - y * w),
        scale * (x * y - z * w), 1 - scale * (x * x + z * z), scale * (y * z + x * w),
        scale * (x * z + y * w), scale * (y * z - x * w), 1 - scale * (x * x + y * y),
    )  # fmt: skip


def pose(rng: random.Random) -> Transform:
    kind = rng.randrange(12)
    axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0) if kind < 2 else rotation(rng)
    if kind == 2:
        axes = tuple(rng.uniform(-2, 2) for _ in range(9))
    place = [
        rng.choice((0.0, -0.0, rng.uniform(-1e3, 1e3), rng.gauss(0, 1) * 10 ** rng.randrange(-40, 38)))
        for _ in range(3)
    ]
    if kind == 3:
        place[0] = rng.choice((float("nan"), float("inf"), -float("inf")))
    return Transform((*axes, *place))


def peer_message(rng: random.Random, damage: int) -> tuple[str, str, bytes]:
    version = rng.choice((1, 1, 1, 2))
    match rng.randrange(6):
        case 0 | 1 | 2:
            kind, content = "TRANSFORM", pose(rng)
        case 3:
            numbers = [rng.gauss(0, 10) for _ in range(7)]
            kind, content = rng.choice(("POSITION", "QTRANS")), Position(tuple(numbers[:3]), tuple(numbers[3:]))  # type: ignore[assignment]
        case 4:
            kind, content = "STRING", String.of(rng.choice(("a", "=1", "ü,\n", "")))  # type: ignore[assignment]
        case _:
            kind, content = "TRANSFORM", pose(rng)
    device = rng.choice(("A", "B/C", "b_c"))
    data = bytearray(join(encode(Message(kind, device, content, header_version=version))))
    match rng.randrange(damage):
        case 0:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case 1:  # other content, with the right CRC
            data[HEADER_SIZE + rng.randrange(len(data) - HEADER_SIZE)] ^= 0x40
            U64.pack_into(data, CRC_AT, crc64(bytes(data[HEADER_SIZE:])))
        case 2:
            del data[-1]
        case 3:
            data[2:14] = b"POSITION\0\0\0\0"
        case 4 | 5 if kind == "POSITION":
            body = bytes(data[HEADER_SIZE : HEADER_SIZE + rng.choice((12, 24))])
            data[HEADER_SIZE - 16 : HEADER_SIZE] = struct.pack(">QQ", len(body), crc64(body))
            data = data[:HEADER_SIZE] + body
    return kind, device, bytes(data)


def ros_message(rng: random.Random, damage: int) -> tuple[str, str, bytes]:
    types = ROS2.types
    stamp = types["builtin_interfaces/msg/Time"](sec=rng.randrange(-(1 << 31), 1 << 31), nanosec=rng.randrange(1 << 32))
    vector = types["geometry_msgs/msg/Vector3"](*(rng.gauss(0, 1) for _ in range(3)))
    text = rng.choice(("", "a", "ü", '"quoted", \r\n', "=1+1", "\0", str(rng.randrange(5))))
    match rng.randrange(5):
        case 0:
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=text)
            turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8)
            moved = types["geometry_msgs/msg/Transform"](translation=vector, rotation=turn)
            ros_type, topic = "geometry_msgs/msg/TransformStamped", "/pose"
            message = types[ros_type](header=header, child_frame_id="tool", transform=moved)
        case 1:
            ros_type, topic = "std_msgs/msg/Float64MultiArray", "/numbers"
            layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
            message = types[ros_type](layout=layout, data=np.arange(rng.choice((0, 2, 2, 65)), dtype=float))
        case 2:
            ros_type, topic = "std_msgs/msg/String", "/text"
            message = types[ros_type](data=text)
        case 3:
            return "no/msg/Definition", "/undefined", b"\0\1\0\0"
        case _:
            ros_type, topic = ANY, "/any"
            whole = [rng.randrange(1 << bits) for bits in (7, 7, 15, 31, 63)]
            message = types[ANY](
                bool(rng.randrange(2)), whole[0], whole[1], -whole[0], whole[0], -whole[2], whole[2], -whole[3],
                whole[3], -whole[4], 2 * whole[4] + 1, float(np.float32(rng.gauss(0, 1))), rng.gauss(0, 1), text, stamp,
                types["builtin_interfaces/msg/Duration"](sec=-1, nanosec=5), vector, np.array([1.5, -0.0, np.nan]),
                np.array([0.1, 2e9], np.float32), np.array([0, 1, 2, 255], np.uint8), np.array([True, False]), "in", 7,
            )  # fmt: skip
    data = bytearray(ROS2.serialize_cdr(message, ros_type))
    match rng.randrange(damage):
        case 0:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case 1:
            del data[rng.randrange(len(data)) :]
        case 2:
            data += bytes(rng.randrange(1, 6))
    return ros_type, topic, bytes(data)


def session(rng: random.Random, count: int) -> list[Entry]:
    entries: list[Entry] = []
    now, twice = samples.START_NS, rng.random() < 0.3
    damage = rng.choice((40, 500, 100_000))  # about one of how many messages is not as it should be
    for _ in range(count):
        now += rng.choice((1, 1_000_000))
        source_ns = rng.choice((0, now - 5))
        draw = rng.randrange(10)
        if draw == 0:
            entries.append(replace(samples.note(1, rng.choice((Kind.NOTE, Kind.EDGE_NOTE, Kind.LINK))), stamp_ns=now))
        elif draw < 6:
            kind, device, data = peer_message(rng, damage)
            way, links = rng.choice(
                ((Kind.IGTL_IN, (1,)), (Kind.IGTL_IN, (rng.choice((1, 2, 2)),)), (Kind.IGTL_OUT, (1, 2)))
            )
            entry = Entry(1, now, way, f"{kind}/{device}", kind, (data,), links, source_ns)
            entries.append(entry)
            if twice and way is Kind.IGTL_OUT:
                entries.append(replace(entry, stamp_ns=now))
        else:
            ros_type, topic, data = ros_message(rng, damage)
            way = rng.choice((Kind.ROS_IN, Kind.ROS_OUT, Kind.ROS_OUT))
            entries.append(Entry(1, now, way, topic, ros_type, (data,), (), source_ns))
    # runs of one stream, which are long enough to be written at once
    if rng.random() < 0.7:
        entries.sort(key=lambda entry: (entry.channel, entry.kind.value))
    return [replace(entry, seq=seq, stamp_ns=samples.START_NS + seq * 1_000) for seq, entry in enumerate(entries, 1)]


def check(path: Path, folder: Path, globs: Sequence[str] = ()) -> None:
    plain = exported(plain_csv.export_csv, path, folder / "plain", globs)
    found = exported(csv_out.export_csv, path, folder / "found", globs)
    assert found == plain


def check_random(folder: Path, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = random.Random(seed)
    if rng.random() < 0.1:
        for module in (csv_out, plain_csv):
            monkeypatch.setattr(module, "_MAX_FILES", 5)
    writer = SessionWriter(
        folder / "a.mcap",
        {},
        definition_of=definition_of,
        chunk_bytes=rng.choice((3_000, 20_000, 1 << 20)),
        overwrite=True,
    )
    for entry in session(rng, rng.choice((5, 100, 400))):
        writer.write(entry)
    writer.close({})
    out = folder / str(seed)
    out.mkdir()
    check(folder / "a.mcap", out, rng.choice(((), (), ("TRANSFORM/*",), ("in:TRANSFORM/A@1", "/any"), ("/pose",))))
    monkeypatch.undo()


@table("seed", range(30), gate=lambda seed: seed < 12)
def test_a_random_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    check_random(tmp_path, seed, monkeypatch)


@pytest.mark.slow
def test_many_random_sessions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(1_000, 1_300):
        check_random(tmp_path, seed, monkeypatch)


@table("path", [path for path in sorted(FIXTURES.glob("*.mcap")) if path.stem != "brain"], gate=is_light)
def test_a_fixture(tmp_path: Path, path: Path) -> None:
    (tmp_path / path.stem).mkdir()
    check(path, tmp_path / path.stem)


def test_poses_and_numbers_are_written_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No message of these streams is decoded alone."""
    kept = csv_out._Export._write_one
    alone: set[str] = set()

    def write_one(self: Any, stream: Any, at: int) -> None:
        alone.add(stream.type)
        kept(self, stream, at)

    monkeypatch.setattr(csv_out._Export, "_write_one", write_one)
    rng = random.Random(1)
    writer = SessionWriter(tmp_path / "a.mcap", {}, definition_of=definition_of)
    poses = [
        join(encode(Message("TRANSFORM", "A", pose(random.Random(seed + 5)), header_version=1))) for seed in range(50)
    ]
    entries = [Entry(1, 1, Kind.IGTL_IN, "TRANSFORM/A", "TRANSFORM", (data,), (1,)) for data in poses]
    while len(entries) < 100:
        ros_type, topic, data = ros_message(rng, 1 << 30)
        if ros_type in (ANY, "geometry_msgs/msg/TransformStamped"):
            entries.append(Entry(1, 1, Kind.ROS_IN, topic, ros_type, (data,)))
    for seq, entry in enumerate(entries, 1):
        writer.write(replace(entry, seq=seq, stamp_ns=seq))
    writer.close({})
    with SessionFile.open(tmp_path / "a.mcap") as file:
        account = csv_out.export_csv(file, tmp_path / "out", ())
    assert sum(row.taken for row in account.rows) == 100
    assert "TRANSFORM" not in alone
