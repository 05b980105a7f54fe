"""Beginning in the middle: what is looked up gives what reading from the beginning gives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.qos import Qos
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay import latched
from igtl_gateway.replay.source import first_form_only
from tests.files import write_anew
from tests.places import FIXTURES
from tests.record import samples

LATCHED = {"/plan", "/tf_static"}


def is_latched(topic: str, _type: str) -> bool:
    return topic in LATCHED


def write(path: Path, entries: Sequence[Entry], chunk_bytes: int = 400, **facts: str) -> Path:
    path.unlink(missing_ok=True)
    writer = SessionWriter(path, {**samples.SESSION, **facts}, chunk_bytes=chunk_bytes)
    for entry in entries:
        writer.write(entry)
    writer.close({})
    return path


def scanned(file: SessionFile, start_ns: int) -> list[Entry]:
    return played(chain(file.prologue(), file.entries()), file, start_ns)


def found(file: SessionFile, start_ns: int) -> list[Entry]:
    return played(
        chain(file.prologue(), file.entries_with_state(start_ns, latched.latched_state_rule(told(file)))),
        file,
        start_ns,
    )


def told(file: SessionFile) -> latched.IsLatched:
    topics = {channel.topic for channel in file.channels if channel.qos and channel.qos.latched} | LATCHED
    return lambda topic, _type: topic in topics


def played(entries: Iterator[Entry], file: SessionFile, start_ns: int) -> list[Entry]:
    return [
        samples.flat(entry) for entry in latched.part_of_session(first_form_only(entries), start_ns, None, told(file))
    ]


def before(path: Path, start_ns: int) -> int:
    """How many entries before the moment are read at all."""
    with SessionFile.open(path) as file:
        return sum(
            entry.stamp_ns < start_ns
            for entry in file.entries_with_state(start_ns, latched.latched_state_rule(told(file)))
        )


def state(seq: int, kind: Kind, channel: str, type_name: str, size: int = 40) -> Entry:
    data = samples.igtl_bytes(type_name, channel.partition("/")[2], body=bytes(size))
    if kind in layout.ROS_KINDS:
        data = samples.string_cdr(f"{seq:0{size}}")
    return Entry(seq, samples.START_NS + 10 * seq, kind, channel, type_name, (data,))


_STREAMS = [
    (Kind.ROS_IN, "/plan", "std_msgs/msg/String"),
    (Kind.ROS_IN, "/pose", "std_msgs/msg/String"),
    (Kind.ROS_OUT, "/plan", "std_msgs/msg/String"),
    (Kind.ROS_OUT, "/igtl/in/Device/status", "std_msgs/msg/String"),
    (Kind.ROS_OUT, "/igtl/in/Tool/transform", "std_msgs/msg/String"),
    (Kind.IGTL_IN, "STATUS/Device", "STATUS"),
    (Kind.IGTL_IN, "TRANSFORM/Tool", "TRANSFORM"),
    (Kind.IGTL_OUT, "POLYDATA/Plan", "POLYDATA"),
    (Kind.IGTL_OUT, "STRING/Plan", "STRING"),
    (Kind.IGTL_OUT, "TRANSFORM/Pose", "TRANSFORM"),
    (Kind.LINK, "", ""),
    (Kind.NOTE, "", ""),
]


@st.composite
def sessions(draw: st.DrawFn) -> list[Entry]:
    """Groups of any inputs and outputs, of which some are latched, some caused by latched ones, some several times."""
    entries: list[Entry] = []
    rare = draw(st.booleans())
    for at in range(draw(st.integers(1, 40))):
        seq = at + 1 + draw(st.integers(0, 3)) * 100 * (at + 1)
        seq = max(seq, entries[-1].seq + 1 if entries else 1)
        common = [stream for stream in _STREAMS if stream[1] in ("TRANSFORM/Tool", "/igtl/in/Tool/transform", "/pose")]
        kind, channel, type_name = draw(st.sampled_from(common * 6 * rare + _STREAMS))
        if channel:
            entries.append(state(seq, kind, channel, type_name, draw(st.sampled_from([1, 60, 300]))))
        else:
            stamp_ns = samples.START_NS + 10 * seq
            entries.append(Entry(seq, stamp_ns, kind, payload=samples.note(seq, kind).payload, links=(1,)))
    return entries


@pytest.mark.slow
@given(
    entries=sessions(),
    chunk_bytes=st.sampled_from([1, 200, 700, 5_000]),
    cuts=st.lists(st.integers(0, 40), max_size=3),
    picks=st.lists(st.integers(0, 39), min_size=1, max_size=4),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_any_session_from_any_moment(
    tmp_path: Path, entries: list[Entry], chunk_bytes: int, cuts: list[int], picks: list[int]
) -> None:
    path = write(tmp_path / "a.mcap", entries, chunk_bytes)
    folder = tmp_path / "split"
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    ends = sorted({*(cut for cut in cuts if cut < len(entries)), len(entries)})
    for number, (first, last) in enumerate(zip([0, *ends], ends, strict=False)):
        write(folder / f"split_{number}.mcap", entries[first:last], chunk_bytes, part=str(number))
    picked = [entries[pick % len(entries)].stamp_ns for pick in picks]
    with SessionFile.open(path) as file, SessionFile.open(folder) as parts:
        for start_ns in {*picked, *(one + 1 for one in picked), 0, 1 << 63}:
            expected = played(iter(entries), file, start_ns)
            assert found(file, start_ns) == expected
            assert found(parts, start_ns) == expected


@pytest.mark.parametrize("name", ["star", "paper-types", "every-type"])
def test_the_fixtures_from_many_moments(name: str, tmp_path: Path) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        entries = list(file.entries())
        qos = {(one.topic, one.type): one.qos for one in file.channels}
    path = tmp_path / "small.mcap"
    writer = SessionWriter(path, {}, qos_of=lambda topic, kind: qos.get((topic, kind)), chunk_bytes=30_000)
    for entry in entries:
        writer.write(entry)
    writer.close({})
    with SessionFile.open(path) as file:
        for entry in entries[:: max(1, len(entries) // 12)]:
            assert found(file, entry.stamp_ns) == played(iter(entries), file, entry.stamp_ns)


def long_session(count: int = 2_000) -> list[Entry]:
    """A plan and its outputs in two versions at the beginning, then poses."""
    entries = [
        state(1, Kind.ROS_IN, "/plan", "std_msgs/msg/String"),
        state(2, Kind.IGTL_OUT, "STRING/Plan", "STRING"),
        state(3, Kind.IGTL_OUT, "STRING/Plan", "STRING", 50),
    ]
    for seq in range(4, count, 2):
        entries.append(state(seq, Kind.ROS_IN, "/pose", "std_msgs/msg/String"))
        entries.append(state(seq + 1, Kind.IGTL_OUT, "TRANSFORM/Pose", "TRANSFORM"))
    return entries


def test_what_is_between_is_not_read(tmp_path: Path) -> None:
    entries = long_session()
    path = write(tmp_path / "a.mcap", entries, 4_000)
    start_ns = entries[-100].stamp_ns
    # the plan and its outputs, the last group before the chunk, and the chunk that the moment is in
    assert 5 <= before(path, start_ns) < 5 + 40
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary
    chunk = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    data[chunk.chunk_start_offset + chunk.chunk_length - 5] ^= 1
    path.write_bytes(data)
    with SessionFile.open(path) as file:
        played = found(file, start_ns)
        assert [entry.seq for entry in played[:3]] == [1, 2, 1900]
        with pytest.raises(DamagedRecording):
            scanned(file, start_ns)


@pytest.mark.slow
def test_a_damaged_index_makes_no_difference(tmp_path: Path) -> None:
    entries = [
        entry
        for seq in range(1, 49, 4)
        for entry in (
            state(seq, Kind.ROS_IN, "/plan", "std_msgs/msg/String"),
            state(seq + 1, Kind.IGTL_OUT, "STRING/Plan", "STRING"),
            state(seq + 2, Kind.ROS_IN, "/pose", "std_msgs/msg/String"),
            state(seq + 3, Kind.IGTL_OUT, "TRANSFORM/Pose", "TRANSFORM"),
        )
    ]
    path = write(tmp_path / "a.mcap", entries, 600)
    start_ns = entries[-6].stamp_ns
    sound = path.read_bytes()
    with SessionFile.open(path) as file:
        expected = scanned(file, start_ns)
        assert before(path, start_ns) < entries[-6].seq - 1
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary and len(summary.chunk_indexes) > 4
    for index in summary.chunk_indexes:
        first = index.chunk_start_offset + index.chunk_length
        for at in range(first, first + index.message_index_length, 3):
            damaged = bytearray(sound)
            damaged[at] ^= 1 << at % 8
            write_anew(path, damaged)
            with SessionFile.open(path) as file:
                assert found(file, start_ns) == expected


def bag(path: Path, times: Sequence[int], index_types: IndexType = IndexType.ALL) -> Path:
    """A recording of another program: a latched plan, then poses."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=600, compression=CompressionType.NONE, index_types=index_types)
        writer.start("ros2", "rosbag2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        facts = {layout.QOS_KEY: layout.qos_yaml(Qos(latched=True))}
        plan = writer.register_channel("/plan", "cdr", schema, facts)
        poses = writer.register_channel("/pose", "cdr", schema, {})
        other = writer.register_channel("/other", "json", schema, {})
        for number, at in enumerate(times):
            channel = plan if number in (1, 4) else other if number % 5 == 0 else poses
            writer.add_message(channel, at, samples.string_cdr(f"{number:050}"), at, 0)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize(
    ("times", "looked_up"),
    [
        (range(1_000, 1_060), True),
        ([1_000 + at // 2 for at in range(60)], False),  # chunks that touch
        ([*range(1_000, 1_030), *range(1_010, 1_040)], False),  # and such that overlap
        ([*range(1_000, 1_003), 1_004, 1_003, *range(1_005, 1_060)], False),  # order inside a chunk
    ],
)
def test_recordings_of_other_programs(tmp_path: Path, times: Sequence[int], looked_up: bool) -> None:
    path = bag(tmp_path / "bag.mcap", times)
    with SessionFile.open(path) as file:
        for start_ns in range(995, 1_065):
            assert found(file, start_ns) == scanned(file, start_ns)
        total = sum(entry.stamp_ns < 1_025 for entry in file.entries())
    assert (before(path, 1_025) < total) is looked_up


def test_without_an_index_it_is_read(tmp_path: Path) -> None:
    path = bag(tmp_path / "bag.mcap", range(1_000, 1_060), IndexType.ALL & ~IndexType.MESSAGE)
    with SessionFile.open(path) as file:
        assert [found(file, at) for at in (1_000, 1_030)] == [scanned(file, at) for at in (1_000, 1_030)]
        assert found(file, 1_030)[0].stamp_ns == 1_004


def test_streams_that_share_a_channel_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "MAX_WIRE_STREAMS", 2)
    entries = [state(seq, Kind.IGTL_IN, f"STATUS/D{seq % 7}", "STATUS") for seq in range(1, 60)]
    path = write(tmp_path / "a.mcap", entries)
    with SessionFile.open(path) as file:
        assert any(not channel.stream for channel in file.channels)
        assert found(file, entries[40].stamp_ns) == scanned(file, entries[40].stamp_ns)


def test_a_type_name_with_a_slash_is_no_state(tmp_path: Path) -> None:
    odd = samples.igtl(1, message_type="STATUS/X", device="D")
    entries = [state(1, Kind.IGTL_IN, "STATUS/D", "STATUS"), state(2, Kind.ROS_OUT, "/a", "std_msgs/msg/String")]
    for seq in range(3, 40):
        stamp_ns = samples.START_NS + 10 * seq
        entries.append(Entry(seq, stamp_ns, odd.kind, odd.channel, odd.type, odd.payload, odd.links))
    path = write(tmp_path / "a.mcap", entries)
    with SessionFile.open(path) as file:
        assert found(file, entries[30].stamp_ns) == scanned(file, entries[30].stamp_ns)
        assert found(file, entries[30].stamp_ns)[0].type == "STATUS"


def test_each_publisher_of_static_transforms_counts(tmp_path: Path) -> None:
    def static(seq: int, frame: str) -> Entry:
        data = TFMessage((FrameTransform(Header(0, "base"), frame, (0, 0, 0, 0, 0, 0, 1)),)).pack()
        return Entry(seq, samples.START_NS + 10 * seq, Kind.ROS_IN, "/tf_static", TFMessage.TYPE, (data,))

    entries = [static(1, "camera"), static(2, "tool"), static(3, "camera")]
    entries += [state(seq, Kind.ROS_IN, "/pose", "std_msgs/msg/String") for seq in range(4, 60)]
    path = write(tmp_path / "a.mcap", entries)
    start_ns = entries[50].stamp_ns
    with SessionFile.open(path) as file:
        assert [entry.seq for entry in found(file, start_ns)[:3]] == [2, 3, 51]
    assert before(path, start_ns) < 12


def test_an_output_in_another_chunk_than_its_cause(tmp_path: Path) -> None:
    """The plan is sent again because of a pose, first in one version, then in another: the first counts."""
    entries = long_session(60)
    at = next(i for i, entry in enumerate(entries) if entry.seq == 30)
    entries[at + 1] = state(31, Kind.IGTL_OUT, "POLYDATA/Plan", "POLYDATA")
    entries[1] = state(2, Kind.IGTL_OUT, "POLYDATA/Plan", "POLYDATA")
    path = write(tmp_path / "a.mcap", entries, 1)
    start_ns = entries[-1].stamp_ns
    with SessionFile.open(path) as file:
        assert [entry.seq for entry in found(file, start_ns)][:3] == [1, 3, 31]
        assert found(file, start_ns) == scanned(file, start_ns)
    assert before(path, start_ns) < 10
