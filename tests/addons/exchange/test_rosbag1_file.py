"""ROS 1 bags whose chunks are bombs, whose index lies, and that were cut off: a sentence each, at once."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
from rosbags.rosbag1 import Reader

from igtl_gateway.addons.exchange.rosbag1 import Rosbag1
from igtl_gateway.addons.exchange.rosbag1_file import BagFile
from igtl_gateway.base.errors import DamagedRecording, RecordingError
from igtl_gateway.base.untrusted import limits
from tests.foreign_bags import grid_map, humanoid, turtles
from tests.timing import quick

MIB = 1 << 20
PACK: dict[str, Callable[[bytes], bytes]] = {
    "none": bytes,
    "bz2": cache(bz2.compress),
    "lz4": cache(lz4.frame.compress),
}
DEFINITION = "string data\n"


def fields(**values: bytes) -> bytes:
    return b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in values.items())


def record(data: bytes, **head: bytes) -> bytes:
    packed = fields(**head)
    return struct.pack("<I", len(packed)) + packed + struct.pack("<I", len(data)) + data


def u32(value: int) -> bytes:
    return struct.pack("<I", value)


def connection(definition: str = DEFINITION, ros1_type: str = "std_msgs/String") -> bytes:
    facts = fields(topic=b"/t", type=ros1_type.encode(), md5sum=b"*", message_definition=definition.encode())
    return record(facts, op=b"\7", conn=u32(0), topic=b"/t")


def message(stamp: int, text: bytes = b"abc") -> bytes:
    return record(u32(len(text)) + text, op=b"\2", conn=u32(0), time=struct.pack("<II", stamp, 5))


def chunk(inner: bytes, how: str = "none", size: int | None = None) -> bytes:
    told = u32(len(inner) if size is None else size)
    return record(PACK[how](inner), op=b"\5", compression=how.encode(), size=told)


def info(at: int, start: int, count: int) -> bytes:
    stamp = struct.pack("<II", start, 0)
    head = {"ver": u32(1), "chunk_pos": struct.pack("<Q", at), "start_time": stamp, "end_time": stamp}
    return record(u32(0) + u32(count), op=b"\6", count=u32(1), **head)


def bag(path: Path, chunks: list[tuple[bytes, int, int]], repeats: int = 1, **definition: str) -> Path:
    """Chunks with the second of their start and the number of their messages; each indexed ``repeats`` times."""
    out = bytearray(b"#ROSBAG V2.0\n" + bytes(4113))
    infos = []
    for data, start, count in chunks:
        infos += [info(len(out), start, count)] * repeats
        out += data
    head = fields(op=b"\3", index_pos=struct.pack("<Q", len(out)), conn_count=u32(1), chunk_count=u32(len(infos)))
    out[13 : 17 + len(head)] = u32(len(head)) + head
    out[17 + len(head) : 21 + len(head)] = u32(4113 - 8 - len(head))
    path.write_bytes(out + connection(**definition) + b"".join(infos))
    return path


def test_chunks_that_overlap_are_merged_by_time(tmp_path: Path) -> None:
    one, two = (b"".join(message(stamp) for stamp in stamps) for stamps in ((1, 9, 4), (3, 5)))
    path = bag(tmp_path / "x.bag", [(chunk(one, "lz4"), 1, 3), (chunk(two, "bz2"), 3, 2)])
    with closing(BagFile(path)) as file:
        assert [found.time_ns // 10**9 for found in file.messages()] == [1, 3, 4, 5, 9]


def test_what_rosbags_writes_is_read_alike(tmp_path: Path) -> None:
    for write in (turtles, humanoid, grid_map):
        path = write(tmp_path / f"{write.__name__}.bag")
        with Reader(path) as reader, closing(BagFile(path)) as file:
            expected = sorted((stamp, one.id, bytes(data)) for one, stamp, data in reader.messages())
            assert sorted((one.time_ns, one.connection, one.data) for one in file.messages()) == expected


@pytest.mark.slow
@pytest.mark.parametrize("how", ["bz2", "lz4"])
@pytest.mark.parametrize("lie", [None, 100, 2**32 - 1])
def test_bombs_are_refused_before_they_are_unpacked(tmp_path: Path, how: str, lie: int | None) -> None:
    path = bag(tmp_path / "x.bag", [(chunk(bytes(100 * MIB), how, lie), 1, 1)])
    assert path.stat().st_size < 4 * MIB
    with (
        quick(),
        closing(BagFile(path)) as file,
        pytest.raises(DamagedRecording, match=r"chunk 1 of 1 at byte \d+: .*found"),
    ):
        list(file.messages())


def test_an_index_that_repeats_chunks_is_refused(tmp_path: Path) -> None:
    path = bag(tmp_path / "x.bag", [(chunk(message(1)), 1, 1)], repeats=1000)
    with pytest.raises(DamagedRecording, match="found a chunk twice"):
        BagFile(path)


def test_a_chunk_of_very_many_empty_records(tmp_path: Path) -> None:
    path = bag(tmp_path / "x.bag", [(chunk(bytes(60 * MIB), "lz4"), 1, 1)])
    with quick(), closing(BagFile(path)) as file, pytest.raises(DamagedRecording, match="records: found 200001"):
        list(file.messages())


def test_a_chunk_of_very_many_messages(tmp_path: Path) -> None:
    path = bag(tmp_path / "x.bag", [(chunk(message(1, b"") * 2500, "lz4"), 1, 2500)])
    with (
        limits.limits_in_force(limits.FileLimits(count=2000)),
        closing(BagFile(path)) as file,
        pytest.raises(DamagedRecording, match="records: found 2001"),
    ):
        list(file.messages())


def test_wherever_a_bag_was_cut_off_a_sentence_says_so(tmp_path: Path) -> None:
    whole = bag(tmp_path / "x.bag", [(chunk(message(1) * 20), 1, 20)]).read_bytes()
    path = tmp_path / "y.bag"
    for size in [*range(0, len(whole), 37), len(whole) - 1]:
        path.write_bytes(whole[:size])
        with pytest.raises(RecordingError) as found:
            BagFile(path)
        assert str(found.value).startswith(f"{path}: ")
        assert "cut off" in str(found.value) or size < 14


def test_an_unindexed_bag_says_what_makes_an_index(tmp_path: Path) -> None:
    path = bag(tmp_path / "x.bag", [(chunk(message(1)), 1, 1)])
    data = path.read_bytes()
    at = data.index(b"index_pos=") + 10
    path.write_bytes(data[:at] + bytes(8) + data[at + 8 :])
    with pytest.raises(DamagedRecording, match="found no index, expected one; run: rosbag reindex"):
        BagFile(path)


@pytest.mark.parametrize(
    ("definition", "why"),
    [
        ("std_msgs/String s\n", "found std_msgs/msg/String inside itself"),
        ("string[100000000] s\n", "found 100000001, expected at most 3000"),
        ("".join(f"string s{i}\n" for i in range(5000)), "lines: found 5000"),
        ("\x1b[2J\xff", "expected ros2msg"),
        ("string a;import os\n", "expected ros2msg"),
    ],
)
def test_a_hostile_definition_costs_its_own_topics(tmp_path: Path, definition: str, why: str) -> None:
    path = bag(tmp_path / "x.bag", [(chunk(message(1) * 3), 1, 3)], definition=definition)
    with closing(Rosbag1(path)) as source:
        assert list(source.items()) == []
        (row,) = source.rows
    assert (row.declared, row.left_out, row.good) == (3, 3, True)
    assert row.why.startswith("its definition cannot be used: ")
    assert why in row.why
