"""Salvage: from a file cut or damaged anywhere comes what is right and a report of the rest, and no error."""

from __future__ import annotations

import os
import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded, UnsupportedRecording
from igtl_gateway.base.untrusted import limits
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout, salvage_report
from igtl_gateway.record.sessionfile.compression import Compression
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.record.sessionfile.salvage_report import SalvageReport
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.files import RefusingStream, write_anew
from tests.record import samples
from tests.record.sessionfile.test_index import DEFINITIONS, bag, messages
from tools import mcap_build as build
from tools.mcap_build import Chunk

OLD = Path(__file__).parent / "old" / "v1-paper-types.mcap"
STRING = "std_msgs/msg/String"
LEDGER = {"a": {"b": 1}}
SESSION = {**samples.SESSION, layout.FORMAT_VERSION_KEY: "1"}


@dataclass(frozen=True)
class Sound:
    """A sound file: bytes, entries, and (offset, end, messages) of its chunks."""

    data: bytes
    entries: list[Entry]
    chunks: list[tuple[int, int, int]]


def _sound(path: Path, compression: Compression, entries: list[Entry]) -> Sound:
    writer = SessionWriter(path, samples.SESSION, chunk_bytes=1000, compression=compression)
    for entry in entries:
        writer.write(entry)
    writer.close(LEDGER)
    data = path.read_bytes()
    summary = make_reader(BytesIO(data)).get_summary()
    assert summary is not None and summary.statistics is not None
    stamps = [entry.stamp_ns for entry in entries]
    chunks = [
        (
            chunk.chunk_start_offset,
            chunk.chunk_start_offset + chunk.chunk_length,
            sum(chunk.message_start_time <= stamp <= chunk.message_end_time for stamp in stamps),
        )
        for chunk in summary.chunk_indexes
    ]
    assert len(chunks) > 2 and sum(count for _, _, count in chunks) == len(entries)
    return Sound(data, [samples.flat(entry) for entry in entries], chunks)


@pytest.fixture(scope="module", params=["lz4", "zstd", "none"])
def sound(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Sound:
    return _sound(tmp_path_factory.mktemp("salvage") / "sound.mcap", request.param, samples.every_kind(4))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Sound:
    """A sound file so small that every place in it can be tried."""
    entries = [
        samples.igtl(seq, body=bytes(300)) if seq % 3 else samples.ros(seq, text="x" * 300) for seq in range(1, 10)
    ]
    return _sound(tmp_path_factory.mktemp("salvage") / "small.mcap", "none", entries)


@dataclass(frozen=True)
class Outcome:
    """What salvage gives."""

    entries: list[Entry]
    report: SalvageReport
    session: dict[str, str]


def read(path: Path, data: bytes | None = None) -> Outcome:
    if data is not None:
        write_anew(path, data)
    with Salvage.open(path) as file:
        entries = list(file.entries())
        return Outcome(entries, file.report, file.session)


def offsets(size: int, step: int) -> Iterator[int]:
    return iter([*range(0, size, step), *range(max(0, size - 30), size)])


# --- the writer's files ----------------------------------------------------------------------------------------


def test_a_sound_file_is_whole(tmp_path: Path, sound: Sound) -> None:
    found = read(tmp_path / "a", sound.data)
    assert found.entries == sound.entries
    assert found.session == SESSION
    assert found.report.whole and found.report.indexed and found.report.missing == 0
    assert found.report.messages == len(sound.entries)
    assert (found.report.start_ns, found.report.end_ns) == (sound.entries[0].stamp_ns, sound.entries[-1].stamp_ns)


#: Every byte is tried with EVERY_BYTE=1 (two minutes), a sample of them otherwise; of larger files always.
STEP = 1 if os.environ.get("EVERY_BYTE") else 31
LARGE_STEP = 199


@pytest.mark.slow
def test_a_cut_loses_nothing_before_its_last_whole_chunk(tmp_path: Path, sound: Sound) -> None:
    check_cuts(tmp_path / "a", sound, LARGE_STEP)


@pytest.mark.slow
def test_a_cut_at_any_byte(tmp_path: Path, small: Sound) -> None:
    check_cuts(tmp_path / "a", small, STEP)


def check_cuts(path: Path, sound: Sound, step: int) -> None:
    for size in offsets(len(sound.data), step):
        if not size:
            continue
        found = read(path, sound.data[:size])
        whole = sum(count for _, end, count in sound.chunks if end <= size)
        assert found.entries == sound.entries[:whole], size
        assert not found.report.indexed
        whats = {loss.what for loss in found.report.lost}
        assert found.report.whole or whats & {salvage_report.CUT_OFF, salvage_report.LEDGER}
        if whole < len(sound.entries):
            assert not found.report.whole
            (loss,) = (loss for loss in found.report.lost if loss.what == salvage_report.CUT_OFF)
            assert loss.at + loss.size == size
            assert loss.start_ns == found.report.end_ns


@pytest.mark.slow
def test_a_flipped_bit_costs_one_chunk_at_most_and_never_gives_anything_wrong(tmp_path: Path, sound: Sound) -> None:
    check_flips(tmp_path / "a", sound, LARGE_STEP)


@pytest.mark.slow
def test_a_flipped_bit_in_any_byte(tmp_path: Path, small: Sound) -> None:
    check_flips(tmp_path / "a", small, STEP)


def check_flips(path: Path, sound: Sound, step: int) -> None:
    chance = random.Random(step)
    largest = max(count for _, _, count in sound.chunks)
    cost = 0
    for at in offsets(len(sound.data), step):
        broken = bytearray(sound.data)
        broken[at] ^= 1 << chance.randrange(8)
        found = read(path, bytes(broken))
        numbers = {entry.seq for entry in found.entries}
        assert found.entries == [entry for entry in sound.entries if entry.seq in numbers], at
        missing = len(sound.entries) - len(found.entries)
        assert missing <= largest, at
        assert found.session == SESSION, at
        cost += missing
        if missing:
            assert found.report.missing == missing
            (loss,) = (loss for loss in found.report.lost if loss.what in (salvage_report.CHUNK, salvage_report.BYTES))
            gone = [entry.stamp_ns for entry in sound.entries if entry.seq not in numbers]
            assert loss.at <= at < loss.at + loss.size
            assert loss.start_ns <= gone[0] and gone[-1] <= loss.end_ns
    assert cost


@pytest.mark.slow
def test_a_flipped_bit_in_a_file_that_was_cut_costs_one_chunk_at_most(tmp_path: Path, sound: Sound) -> None:
    check_flips_of_a_cut_file(tmp_path / "a", sound, LARGE_STEP)


@pytest.mark.slow
def test_a_flipped_bit_in_any_byte_of_a_file_that_was_cut(tmp_path: Path, small: Sound) -> None:
    check_flips_of_a_cut_file(tmp_path / "a", small, STEP)


def check_flips_of_a_cut_file(path: Path, sound: Sound, step: int) -> None:
    chance = random.Random(step)
    data = sound.data[: sound.chunks[-1][1] + 60]
    largest = max(count for _, _, count in sound.chunks)
    for at in offsets(sound.chunks[-1][0], step):
        broken = bytearray(data)
        broken[at] ^= 1 << chance.randrange(8)
        found = read(path, bytes(broken))
        numbers = {entry.seq for entry in found.entries}
        assert found.entries == [entry for entry in sound.entries if entry.seq in numbers], at
        assert len(sound.entries) - len(found.entries) <= largest, at
        assert not found.report.whole


@pytest.mark.slow
def test_a_damaged_run_of_bytes_costs_the_chunks_it_touches(tmp_path: Path, sound: Sound) -> None:
    chance = random.Random(7)
    size = 200
    for _ in range(120):
        at = chance.randrange(len(sound.data))
        run = chance.choice([bytes(size), b"\xff" * size, chance.randbytes(size), b"", chance.randbytes(2 * size)])
        end = min(len(sound.data), at + size)
        found = read(tmp_path / "a", sound.data[:at] + run + sound.data[end:])
        numbers = {entry.seq for entry in found.entries}
        assert found.entries == [entry for entry in sound.entries if entry.seq in numbers]
        touched = sum(count for start, stop, count in sound.chunks if start < end and at < stop)
        # a record whose length is gone may take the one behind it along
        assert len(sound.entries) - len(found.entries) <= touched + max(count for _, _, count in sound.chunks)
        if len(found.entries) < len(sound.entries):
            assert not found.report.whole


def test_a_lost_chunk_loses_no_channel(tmp_path: Path, sound: Sound) -> None:
    """Without an index too: all that the first chunk introduced is known from elsewhere."""
    start, end, count = sound.chunks[0]
    data = bytearray(sound.data[: sound.chunks[-1][1]])
    data[start + 60 : end] = bytes(end - start - 60)
    found = read(tmp_path / "a", bytes(data))
    assert found.entries == sound.entries[count:]
    assert [loss.what for loss in found.report.lost] == [salvage_report.CHUNK, salvage_report.CUT_OFF]
    assert found.report.missing_numbers == count
    lost = found.report.lost[0]
    assert (lost.start_ns, lost.end_ns) == (sound.entries[0].stamp_ns, sound.entries[count - 1].stamp_ns)


def test_channels_of_a_lost_chunk_come_from_the_index_where_they_are_nowhere_else(tmp_path: Path) -> None:
    data = bytearray(_bag(chunk_size=100))
    at = data.index(b"hello 0")
    data[at] ^= 1
    found = read(tmp_path / "a", bytes(data))
    assert 0 < len(found.entries) < 20
    assert [loss.what for loss in found.report.lost] == [salvage_report.CHUNK]
    # and without the index the rest has no description
    blind = read(tmp_path / "a", bytes(data[: data.rindex(b"hello 19") + 7]))
    assert blind.entries == []
    (chunk, channel, cut) = blind.report.lost
    assert (chunk.what, channel.what, cut.what) == (
        salvage_report.CHUNK,
        salvage_report.CHANNEL,
        salvage_report.CUT_OFF,
    )
    assert "messages of a channel" in channel.text


def test_a_damaged_attachment_gives_no_entries(tmp_path: Path) -> None:
    """The prologue of a part is a recording in an attachment: what is in it is not of the session."""
    path = tmp_path / "a"
    before = [samples.igtl(seq) for seq in range(1, 5)]
    writer = SessionWriter(path, samples.SESSION, prologue=before)
    entries = [samples.igtl(seq) for seq in range(10, 15)]
    for entry in entries:
        writer.write(entry)
    writer.close(LEDGER)
    data = path.read_bytes()
    start = data.index(layout.PROLOGUE_ATTACHMENT.encode()) - 4 - 16 - 9
    assert data[start] == 9  # opcode of an attachment
    for at in range(start, start + 60):
        broken = bytearray(data)
        broken[at] ^= 4
        found = read(path, bytes(broken))
        assert found.entries == [samples.flat(entry) for entry in entries], at - start
        assert not found.report.whole or at < start + 9  # its length is there twice


def test_the_first_version_s_files_are_salvaged(tmp_path: Path) -> None:
    with SessionFile.open(OLD) as file:
        entries, session = list(file.entries()), file.session
    found = read(OLD)
    assert (found.entries, found.session, found.report.whole) == (entries, session, True)
    cut = read(tmp_path / "a", OLD.read_bytes()[:60_000])
    assert cut.entries == entries


def test_entries_whose_numbers_do_not_increase_are_told(tmp_path: Path) -> None:
    session = {layout.SESSION_METADATA: layout.seal({layout.FORMAT_VERSION_KEY: "1"})}
    found = read(tmp_path / "a", _bag(numbers=[1, 2, 2, 5, 4, 6], metadata=session))
    assert [entry.seq for entry in found.entries] == [1, 2, 5, 6]
    assert [loss.what for loss in found.report.lost if loss.what != salvage_report.LEDGER] == [
        salvage_report.NUMBER
    ] * 2


def test_losses_are_bounded(tmp_path: Path, sound: Sound, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(salvage_report, "MAX_LOSSES", 2)
    data = bytearray(sound.data)
    for _, end, _ in sound.chunks:
        data[end - 3] ^= 1
    found = read(tmp_path / "a", bytes(data))
    assert found.entries == []
    assert len(found.report.lost) == 2
    assert found.report.more_lost == len(sound.chunks) - 2
    assert found.report.missing == len(sound.entries)


# --- files of others -------------------------------------------------------------------------------------------


def _bag(
    *,
    numbers: list[int] | None = None,
    metadata: dict[str, dict[str, str]] | None = None,
    **options: object,
) -> bytes:
    """An MCAP file of another program."""
    stream = BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE, **options)  # type: ignore[arg-type]
    writer.start("ros2", "another program")
    for name, items in (metadata or {}).items():
        writer.add_metadata(name, items)
    schema = writer.register_schema(STRING, "ros2msg", b"string data")
    channel = writer.register_channel("/chatter", "cdr", schema, {layout.KIND_KEY: "ros_in"} if metadata else {})
    for index, number in enumerate(numbers or range(20)):
        writer.add_message(channel, index + 1, samples.string_cdr(f"hello {index}"), index + 1, number)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunk_size": 100},
        {"index_types": IndexType.NONE},
        {"use_chunking": False},
        {"enable_crcs": False},
        {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
    ],
)
def test_files_of_others_are_read_with_and_without_an_index(tmp_path: Path, options: dict[str, object]) -> None:
    data = _bag(**options)  # type: ignore[arg-type]
    expected = [
        Entry(number, number, Kind.ROS_IN, "/chatter", STRING, (samples.string_cdr(f"hello {number - 1}"),))
        for number in range(1, 21)
    ]
    found = read(tmp_path / "a", data)
    assert (found.entries, found.report.whole) == (expected, True)
    cut = read(tmp_path / "a", data[: data.index(b"hello 19") + 2])
    assert cut.entries == expected[: len(cut.entries)]
    assert not cut.report.whole


def test_messages_outside_of_chunks_are_found_again_behind_a_damaged_length(tmp_path: Path) -> None:
    data = bytearray(_bag(use_chunking=False))
    at = data.index(b"hello 7") - 8 - 22 - 8
    assert struct.unpack_from("<Q", data, at) == (22 + 8 + 8,)
    data[at + 5] ^= 1
    found = read(tmp_path / "a", bytes(data))
    # only the next record shows whether a message's own length is right
    assert [entry.stamp_ns for entry in found.entries] == [*range(1, 7), *range(9, 21)]
    assert {loss.what for loss in found.report.lost} == {salvage_report.BYTES}
    assert found.report.missing == 2


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "the file is empty"),
        (b"This is no recording.\n" * 100, "not an MCAP file"),
        (bytes(100_000), "not an MCAP file"),
        (b"SQLite format 3\0" + bytes(4096), "not an MCAP file"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path: Path, data: bytes, words: str) -> None:
    (tmp_path / "a").write_bytes(data)
    with pytest.raises(UnsupportedRecording, match=words):
        Salvage.open(tmp_path / "a")


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedRecording, match="No such file"):
        Salvage.open(tmp_path / "a")
    with pytest.raises(UnsupportedRecording, match="folder"):
        Salvage.open(tmp_path)


def test_a_newer_version_is_refused(tmp_path: Path) -> None:
    newer = layout.seal({layout.FORMAT_VERSION_KEY: str(max(layout.PRESENT_VERSIONS) + 1)})
    (tmp_path / "a").write_bytes(_bag(metadata={layout.SESSION_METADATA: newer})[:-40])
    with pytest.raises(UnsupportedRecording, match="newer igtl-gateway"):
        Salvage.open(tmp_path / "a")


def test_a_hole_behind_a_recording_costs_no_time(tmp_path: Path, small: Sound) -> None:
    path = tmp_path / "sparse.mcap"
    end = small.chunks[1][1]
    write_anew(path, small.data[:end])
    os.truncate(path, 1 << 36)  # 64 GiB, of which next to nothing is stored
    found = read(path).entries
    assert found == small.entries[: len(found)]
    assert len(found) == small.chunks[0][2] + small.chunks[1][2]


def test_random_bytes_behind_the_magic_give_nothing(tmp_path: Path) -> None:
    for seed in range(100):
        data = b"\x89MCAP0\r\n" + random.Random(seed).randbytes(3000)
        found = read(tmp_path / "a", data)
        assert found.entries == []
        assert not found.report.whole


def test_a_disk_that_refuses_to_read(tmp_path: Path, small: Sound, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "session.mcap"
    stream = RefusingStream(small.data, len(small.data) + 1)
    with Salvage(path, stream) as file:
        stream.refuses_from = 100
        with pytest.raises(DamagedRecording, match="cannot be read: Input/output error"):
            list(file.read())
    monkeypatch.setattr("igtl_gateway.base.untrusted.files.open_file", lambda _path: RefusingStream(small.data, 8))
    with pytest.raises(DamagedRecording, match="cannot be read: Input/output error"):
        Salvage.open(path)


def test_a_message_that_is_shorter_than_its_head_costs_itself(tmp_path: Path) -> None:
    whole = messages(5, 6)
    made = bag(Chunk((*DEFINITIONS, whole[0], (build.MESSAGE, whole[1][1][:21]), messages(5, 6, 7)[2])))
    counted = build.statistics(3, 1, 1, 0, 0, 1, 5, 7, {1: 3})
    summary = [(opcode, counted if opcode == build.STATISTICS else content) for opcode, content in made.summary]
    found = read(tmp_path / "bag.mcap", build.finish(made.data, summary))
    assert [entry.stamp_ns for entry in found.entries] == [5, 7]
    assert (found.report.missing, [loss.text for loss in found.report.lost]) == (1, ["a message shorter than its head"])


def test_a_summary_that_ends_within_a_record_loses_nothing(tmp_path: Path) -> None:
    made = bag(Chunk((*DEFINITIONS, *messages(5, 6))))
    cut = (build.STATISTICS, b"")
    summary = b"".join(build.record(*each) for each in made.summary) + build.record(*cut, length=99)
    data = build.finish(made.data, [(summary[0], summary[9:])], offsets=False)
    assert [entry.stamp_ns for entry in read(tmp_path / "bag.mcap", data).entries] == [5, 6]


def test_the_number_of_attachments_is_bounded() -> None:
    rows = [(build.ATTACHMENT, build.attachment(f"a{number}", "text/plain", b"abc")) for number in range(30)]
    data = bag(Chunk((*DEFINITIONS, *messages(5, 6))), *rows).data
    with limits.limits_in_force(replace(limits.current_limits(), count=30)):
        assert sum(1 for _ in Salvage(Path("a"), BytesIO(data)).attachments()) == 30
    with (
        limits.limits_in_force(replace(limits.current_limits(), count=29)),
        pytest.raises(LimitExceeded, match="a: attachments"),
    ):
        Salvage(Path("a"), BytesIO(data))


def test_a_session_without_its_metadata_is_named_as_a_loss(tmp_path: Path) -> None:
    """Its entries are there, but not with which configuration they were made."""
    path = tmp_path / "a.mcap"
    writer = SessionWriter(path, samples.SESSION)
    for entry in samples.every_kind(2):
        writer.write(entry)
    writer.close(LEDGER)
    data = path.read_bytes()
    places = {each.name: each for each in make_reader(BytesIO(data)).get_summary().metadata_indexes}  # type: ignore[union-attr]
    damaged = data
    for name in layout.SESSION_RECORDS:
        place = places[name]
        damaged = damaged[: place.offset] + b"\xff" * place.length + damaged[place.offset + place.length :]
    whole, without = Salvage(path, BytesIO(data)), Salvage(path, BytesIO(damaged))
    assert [len(list(each.entries())) for each in (whole, without)] == [len(samples.every_kind(2))] * 2
    assert whole.report.whole and not any(loss.what == salvage_report.METADATA for loss in whole.report.lost)
    texts = [loss.text for loss in without.report.lost if loss.what == salvage_report.METADATA]
    assert texts == ["the session metadata, such as the configuration"]
