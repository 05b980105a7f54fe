"""A file with state from before it: each way to read has first what is from before, then what is in the file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.with_state import SessionWithState
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.record import samples

STRING = "std_msgs/msg/String"


def message(seq: int, stamp_ns: int, topic: str) -> Entry:
    return Entry(seq, stamp_ns, Kind.ROS_IN, topic, STRING, (samples.string_cdr(f"{topic} {seq}"),), (), 0)


#: The beginning of time is a time, too.
BEFORE = [message(1, 0, "/state"), message(2, 7, "/state"), message(3, 8, "/both")]
ITSELF = [message(11, 100, "/both"), message(12, 101, "/own"), message(13, 102, "/both")]


def opened(path: Path, entries: list[Entry]) -> SessionFile:
    writer = SessionWriter(path, samples.SESSION)
    for entry in entries:
        writer.write(entry)
    writer.close({})
    return SessionFile.open(path)


@pytest.fixture
def files(tmp_path: Path) -> Iterator[SessionWithState]:
    with opened(tmp_path / "a.mcap", ITSELF) as itself, opened(tmp_path / "b.mcap", BEFORE) as before:
        yield SessionWithState(itself, before)


def test_entries_come_with_what_is_from_before(files: SessionWithState) -> None:
    every = [entry.seq for entry in (*BEFORE, *ITSELF)]
    assert [entry.seq for entry in files.entries()] == every
    assert [entry.seq for entry in files.entries_of_kinds({Kind.ROS_IN})] == every
    assert not [entry for entry in files.entries_of_kinds({Kind.ROS_OUT}) if entry.seq]
    assert [entry.seq for entry in files.entries_starting_at(8)] == [3, 11, 12, 13]
    assert (files.entry_count, files.start_ns, files.end_ns) == (6, 100, 102)


@pytest.mark.parametrize(("topic", "numbers"), [("/state", [1, 2]), ("/both", [3, 11, 13]), ("/own", [12])])
def test_blocks_columns_and_times_of_each_stream(topic: str, numbers: list[int], files: SessionWithState) -> None:
    (channel,) = [each for each in files.channels if each.topic == topic]
    stamps = {entry.seq: entry.stamp_ns for entry in (*BEFORE, *ITSELF)}
    times = [stamps[number] for number in numbers]
    assert [number for block in files.blocks(channel) for number in block.numbers.tolist()] == numbers
    assert [time for block in files.blocks(channel) for time in block.times.tolist()] == times
    assert [
        number
        for columns in files.columns(wanted=lambda stream: stream.channel == topic)
        for number in columns.numbers.tolist()
    ] == numbers
    assert channel.count == len(numbers)
    if topic != "/state":  # 0 means unset
        assert files.span(channel) == (times[0], times[-1])
    later = [number for block in files.blocks(channel, 8, 102) for number in block.numbers.tolist()]
    assert later == [number for number in numbers if 8 <= stamps[number] < 102]
