"""A file with the digests of large outputs reads as one with all bytes, by every path of the reader."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader

from igtl_gateway.app.sealing import verify_seal
from igtl_gateway.app.verification import verify_segment_of, verify_session
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import GatewayError, UnsupportedRecording
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.base.version import __version__
from igtl_gateway.config.configuration import Config, ToRosRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.common_msgs import MultiArrayLayout
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.gateway import LINKS_TOPIC
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.reports import RecordingSummary
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.columns import END_NS, EntryColumns
from igtl_gateway.record.sessionfile.derived import DerivedOutputs
from igtl_gateway.record.sessionfile.large_outputs import (
    LARGE_BYTES,
    DigestedOutput,
    LargeOutputs,
    NotComputed,
    Outputs,
)
from igtl_gateway.record.sessionfile.lookup import LatchedStateRule
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.recovery import Recovery, copy_readable, recover
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.record.sessionfile.salvage_report import SalvageReport
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.record.shared_queue import QueueReader
from igtl_gateway.replay.content_figures import summary_of
from igtl_gateway.replay.segments import Segment
from igtl_gateway.replay.verify import DIGEST
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway.wire.transform import Transform
from tests.tables import table

_HEADER = rosmsg.Header(0, "camera")
CONFIG = Config(to_ros=(ToRosRow(device="Sliced*", kinds=("+slices",)),))


def picture(number: int, size: tuple[int, int, int] = (320, 240, 1)) -> Image:
    pixels = np.random.default_rng(number).integers(0, 256, size[0] * size[1] * size[2], np.uint8)
    return Image(size, 3, pixels.tobytes())


def part(number: int, first: int) -> Image:
    """The lower or the upper half of a volume."""
    pixels = np.random.default_rng(number).integers(0, 256, 64 * 64 * 16, np.uint8).tobytes()
    return Image((64, 64, 32), 3, pixels, subvol_offset=(0, 0, first), subvol_size=(64, 64, 16))


def values(number: int, count: int) -> npt.NDArray[np.float64]:
    return np.random.default_rng(number).normal(0, 100, (count, 3))


def cloud(number: int) -> rosmsg.PointCloud2:
    points = values(number, 6_000).astype("<f4")
    fields = tuple(rosmsg.PointField(name, 4 * at, 7) for at, name in enumerate("xyz"))
    return rosmsg.PointCloud2(_HEADER, 1, len(points), fields, False, 12, 12 * len(points), points.tobytes(), True)


def from_peer(number: int) -> Iterator[bytes]:
    """Large messages of each type that has some, and a small one."""
    yield encoded("IMAGE", "Probe", picture(number))
    yield encoded("IMAGE", "Head", picture(number, (64, 64, 32)))
    yield encoded("IMAGE", "Sliced", picture(number, (64, 64, 32)))
    for first in (0, 16):
        yield encoded("IMAGE", "InParts", part(number, first))
    yield encoded("POINT", "Points", Points.of(values(number, 2_000)))
    triangles = Cells.of([[at, at + 1, at + 2] for at in range(0, 6_000, 3)])
    yield encoded("POLYDATA", "Surface", PolyData(values(number, 6_000).astype(">f4"), polygons=triangles))
    yield encoded("NDARRAY", "Field", NdArray(11, (3, 10_000), values(number, 10_000).astype("<f8").tobytes()))
    yield encoded("TRANSFORM", "Tool", Transform((1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, float(number), 0, 0)))


def from_ros(number: int) -> Iterator[tuple[str, rosmsg.RosMessage]]:
    pixels = np.random.default_rng(1000 + number).integers(0, 256, 3 * 300 * 200, np.uint8)
    yield "/igtl/out/Picture/camera", rosmsg.Image(_HEADER, 200, 300, "rgb8", 0, 900, pixels.tobytes())
    yield "/igtl/out/Cloud", cloud(number)
    yield "/igtl/out/Array/float64", MULTI_ARRAYS["f8"](MultiArrayLayout(), values(number, 5_000).reshape(-1))


def encoded(igtl_type: str, device: str, body: Body) -> bytes:
    return join(encode(Message(igtl_type, device, body)))


def session(count: int = 3) -> ManualGateway:
    """Large messages of each type from a peer and from ROS, and small ones in between."""
    gateway = ManualGateway(CONFIG)
    link = gateway.connect()
    for number in range(count):
        for message in from_peer(number):
            gateway.from_peer(message, link)
            gateway.advance(0.01)
        for topic, published in from_ros(number):
            gateway.from_ros(topic, published)
            gateway.advance(0.01)
    return gateway


def written(
    path: Path, entries: Sequence[Entry], mode: Outputs, *, compression: str = "lz4", version: str = __version__
) -> SessionWriter:
    facts = {"igtl_gateway_version": version, "config": json.dumps(CONFIG.to_dict(), sort_keys=True)}
    outputs = LargeOutputs(mode)
    writer = SessionWriter(path, facts, compression=compression, counted=True, outputs=outputs)  # type: ignore[arg-type]
    for entry in entries:
        writer.write(entry)
    writer.close({"recorder": {"left_out": dict(outputs.left_out), "left_out_entries": outputs.left_out.total()}})
    return writer


def plain(entries: Iterable[Entry]) -> list[tuple[object, ...]]:
    return [
        (each.seq, each.stamp_ns, each.kind, each.channel, each.type, each.data(), each.links, each.source_ns)
        for each in entries
    ]


@pytest.fixture(scope="module")
def log() -> list[Entry]:
    return session().log


@pytest.fixture(scope="module", params=["none", "lz4", "zstd"])
def both(request: pytest.FixtureRequest, log: list[Entry], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A file with all bytes, and one with digests."""
    folder = tmp_path_factory.mktemp("both")
    for mode in ("full", "digest"):
        written(folder / f"{mode}.mcap", log, mode, compression=request.param)
    with SessionFile.open(folder / "full.mcap") as full, SessionFile.open(folder / "digest.mcap") as digest:
        yield full, digest


def large(log: Iterable[Entry], *, outputs: bool) -> list[Entry]:
    return [entry for entry in log if entry.size >= LARGE_BYTES and entry.kind.is_input != outputs]


Read = Callable[[SessionFile], object]


def payloads(file: SessionFile, start_ns: int = 0) -> list[tuple[str, bytes]]:
    streams = [each for each in file.channels if each.kind not in layout.NOTE_KINDS]
    return [
        (stream.topic, bytes(block.payload(row)))
        for stream in sorted(streams, key=str)
        for block in file.blocks(stream, start_ns)
        for row in range(len(block))
    ]


def messages(file: SessionFile) -> list[object]:
    return [
        (schema, channel.topic, channel.metadata, row[1:4], bytes(memoryview(row[6])[row[4] : row[5]]))
        for schema, channel, row in file.messages()
    ]


def schemas(found: list[Any]) -> list[object]:
    return [(schema.name, bytes(schema.data), *rest) for schema, *rest in found]


def midway(file: SessionFile) -> int:
    return (file.start_ns + file.end_ns) // 2


def of_all_columns(file: SessionFile) -> list[object]:
    return [
        (definitions[int(columns.channels[row])][1].topic, data[int(columns.begins[row]) : int(columns.ends[row])])
        for definitions, data, columns in file.all_columns()
        for row in range(len(columns.times))
    ]


STATE = LatchedStateRule(lambda kind, channel, _type: "Picture" in channel or "Probe" in channel, lambda _topic: False)
READS: dict[str, Read] = {
    "entries": lambda file: plain(file.entries()),
    "entries from the middle on": lambda file: plain(file.entries_starting_at(midway(file))),
    "entries of kinds": lambda file: plain(e for e in file.entries_of_kinds({Kind.ROS_OUT}) if e.kind is Kind.ROS_OUT),
    "columns": lambda file: plain(e for columns in file.columns() for e in columns.entries()),
    "columns of one stream": lambda file: plain(
        e for columns in file.columns(wanted=lambda each: each.kind is Kind.IGTL_OUT) for e in columns.entries()
    ),
    "columns from the middle on": lambda file: plain(e for some in file.columns(midway(file)) for e in some.entries()),
    "columns of OpenIGTLink": lambda file: [
        some.data[int(begin) : int(end)] for some in file.columns() for begin, end in zip(*places(some), strict=True)
    ],
    "blocks": payloads,
    "blocks from the middle on": lambda file: payloads(file, midway(file)),
    "messages": lambda file: schemas(messages(file)),
    "all columns": of_all_columns,
    "channels": lambda file: sorted(map(str, file.channels)),
    "first links": lambda file: [file.first_links(each) for each in sorted(file.channels, key=str)],
    "spans": lambda file: [file.span(each) for each in sorted(file.channels, key=str)],
    "counts": lambda file: (file.entry_count, file.start_ns, file.end_ns, file.damaged_indexes(), file.skipped),
    "summary": lambda file: [str(summary_of(file)[0].streams), summary_of(file)[1]],
    "summary of all entries": lambda file: str(summary_of(file, full=True)[0].streams),
    "verification": lambda file: replace(verify_session(file), file=Path(), compiled=0),
    "full verification": lambda file: replace(verify_session(file, reference=True), file=Path(), compiled=0),
}


def places(columns: EntryColumns) -> tuple[list[int], list[int]]:
    wire = columns.wire()
    return wire.begins.tolist(), wire.ends.tolist()


@table("name, read", READS.items())
def test_every_path_of_the_reader_gives_all_bytes(both: Any, name: str, read: Read) -> None:
    full, digest = both
    assert read(digest) == read(full), name


def test_the_state_before_a_time_has_all_bytes(both: Any, log: list[Entry]) -> None:
    _, digest = both
    found = plain(digest.entries_with_state(midway(digest), STATE))
    every = {each[0]: each for each in plain(log)}
    assert found == [every[each[0]] for each in found]
    before = [each for each in found if each[1] < midway(digest) and each[3] == "/igtl/in/Probe/image"]  # type: ignore[operator]
    assert before


def test_entries_are_those_that_were_written(both: Any, log: list[Entry]) -> None:
    full, digest = both
    assert plain(digest.entries()) == plain(log)
    saved = full.size - digest.size
    assert saved > 0.2 * sum(entry.size for entry in large(log, outputs=True)), "zstd finds some of it alone"


def test_other_programs_find_digests_on_topics_of_their_own(both: Any, log: list[Entry]) -> None:
    _, digest = both
    names = {entry.channel for entry in large(log, outputs=True) if entry.kind is Kind.ROS_OUT}
    with digest.path.open("rb") as stream:
        found = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert names.isdisjoint(found)
    assert {f"{layout.DIGEST_TOPIC}{name}" for name in names} <= {*found}
    assert set(found) >= {entry.channel for entry in log if entry.kind is Kind.ROS_IN}


def test_the_version_of_the_format_says_whether_it_may_have_digests(both: Any) -> None:
    full, digest = both
    assert (full.format_version, digest.format_version) == (1, 2)


def test_without_outputs_verification_counts_them(log: list[Entry], tmp_path: Path) -> None:
    written(tmp_path / "none.mcap", log, "none")
    with SessionFile.open(tmp_path / "none.mcap") as file:
        found = verify_session(file)
        assert file.format_version == 1
    expected = sum("video" not in entry.type for entry in large(log, outputs=True))
    assert found.good and found.lost == expected
    assert found.equal == sum(not entry.kind.is_input for entry in log) - expected


# -- what cannot be computed ---------------------------------------------------------------------------------


def changed(path: Path, chosen: Callable[[Entry], bool], change: Callable[[bytes], bytes], log: list[Entry]) -> Entry:
    """Write digests of the log, and an entry that is not the one that they follow from; return it."""
    found = next(entry for entry in log if chosen(entry))
    facts = {"igtl_gateway_version": __version__, "config": json.dumps(CONFIG.to_dict(), sort_keys=True)}
    writer = SessionWriter(path, facts, outputs=LargeOutputs("digest"), compression="none")
    for entry in log:
        writer.write(replace(entry, payload=(change(entry.data()),)) if entry is found else entry)
    writer.close({})
    return found


def flipped(data: bytes) -> bytes:
    return data[:-5] + bytes([data[-5] ^ 1]) + data[-4:]


def is_picture(kind: Kind) -> Callable[[Entry], bool]:
    return lambda entry: entry.kind is kind and "camera" in entry.channel


@table("kind", [Kind.ROS_IN, Kind.IGTL_OUT])
def test_a_digest_that_is_not_of_the_input_is_found_with_its_place(
    log: list[Entry], tmp_path_factory: pytest.TempPathFactory, kind: Kind
) -> None:
    path = tmp_path_factory.mktemp("changed") / "changed.mcap"
    changed(path, is_picture(kind), flipped, log)
    output = next(entry for entry in log if is_picture(Kind.IGTL_OUT)(entry))
    words = rf"entry {output.seq} \(caused by entry {output.seq - 1}\), {output.channel}: the file has its digest"
    with SessionFile.open(path) as file:
        before = []
        with pytest.raises(NotComputed, match=words):
            for entry in file.entries():
                before.append(entry.seq)
        assert before[-1] >= output.seq - 20, "what is before it in the file is read"
        found = verify_session(file)
    assert [(each.seq, each.field) for each in found.differences] == [(output.seq, DIGEST)] and not found.advice


def with_other_pictures(log: list[Entry]) -> list[Entry]:
    """The log, with other pictures from ROS than those that its outputs follow from."""
    is_other = is_picture(Kind.ROS_IN)
    return [replace(each, payload=(flipped(each.data()),)) if is_other(each) else each for each in log]


@table("version", ["9.8.7", ""])
def test_another_version_says_which_one_can_compute_it(
    log: list[Entry], tmp_path_factory: pytest.TempPathFactory, version: str
) -> None:
    path = tmp_path_factory.mktemp("versions") / "other.mcap"
    written(path, with_other_pictures(log), "digest", version=version)
    who = f"igtl-gateway {version}, which" if version else "the igtl-gateway, of a version that it lacks, that"
    words = f"{who} recorded it, can compute them"
    with SessionFile.open(path) as file:
        with pytest.raises(UnsupportedRecording, match=f"igtl-gateway {__version__} computes other bytes; {words}"):
            list(file.entries())
        assert verify_session(file).advice == words


@table("reference", [False, True])
def test_verification_finds_what_it_finds_with_all_bytes(
    log: list[Entry], tmp_path_factory: pytest.TempPathFactory, reference: bool
) -> None:
    folder, found = tmp_path_factory.mktemp("differences"), []
    for mode in ("full", "digest"):
        written(folder / mode, with_other_pictures(log), mode)
        with SessionFile.open(folder / mode) as file:
            report = verify_session(file, reference=reference)
        found.append(([(each.seq, each.cause, each.stream) for each in report.differences], report.by_stream))
    assert found[0] == found[1]
    pictures = [entry for entry in log if is_picture(Kind.IGTL_OUT)(entry)]
    assert len(found[0][0]) == len(pictures) > 1


def test_verification_computes_each_output_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = session(6).log
    written(tmp_path / "digest.mcap", log, "digest")
    monkeypatch.delattr(DerivedOutputs, "_computed")
    with SessionFile.open(tmp_path / "digest.mcap") as file:
        found = [verify_session(file, reference=each) for each in (False, True)]
        segment = Segment(0, END_NS, {})
        part = verify_segment_of(file, segment)
    assert [each.good for each in (*found, part)] == [True] * 3  # type: ignore[union-attr]
    assert found[0].equal == sum(not entry.kind.is_input for entry in log)


def test_a_reader_of_the_version_before_refuses_the_file(
    log: list[Entry], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path / "digest.mcap", log, "digest")
    monkeypatch.setattr(layout, "PRESENT_VERSIONS", (1,))
    with pytest.raises(UnsupportedRecording, match="found format version 2, expected at most 1; read it with a newer"):
        SessionFile.open(tmp_path / "digest.mcap")


def test_another_digest_is_refused(log: list[Entry], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway.record.sessionfile.writer.DIGEST_NAME", "md5")
    written(tmp_path / "digest.mcap", log[:10], "digest")
    with pytest.raises(UnsupportedRecording, match="found digests 'md5', expected 'sha256'"):
        SessionFile.open(tmp_path / "digest.mcap")


def test_no_digest_is_larger_than_the_limit_of_memory(log: list[Entry], tmp_path: Path) -> None:
    written(tmp_path / "digest.mcap", log, "digest")
    with (
        limits_in_force(FileLimits(memory=1 << 17)),
        SessionFile.open(tmp_path / "digest.mcap") as file,
        pytest.raises(GatewayError),
    ):
        for columns in file.columns():
            columns.wire()


# -- what is left of a damaged file ------------------------------------------------------------------------------


def damaged(path: Path, payload: bytes) -> None:
    """Change one byte of a payload in a file without compression."""
    data = bytearray(path.read_bytes())
    at = data.index(payload)
    data[at + len(payload) // 2] ^= 1
    path.write_bytes(data)


@table("kind, recovers", [(Kind.ROS_IN, recover), (Kind.ROS_IN, copy_readable)])
def test_an_output_whose_input_is_damaged_is_named_as_lost(
    log: list[Entry], tmp_path: Path, kind: Kind, recovers: Callable[[Path, Path], Recovery | SalvageReport]
) -> None:
    source, place = tmp_path / "damaged.mcap", tmp_path / "recovered.mcap"
    written(source, log, "digest", compression="none")
    lost = [entry for entry in log if is_picture(kind)(entry)][1]
    damaged(source, lost.data())
    found = recovers(source, place)
    report = found if isinstance(found, SalvageReport) else found.report
    with SessionFile.open(place) as file:
        kept = plain(file.entries())
        assert verify_session(file).good
    assert kept == [each for each in plain(log) if each in kept]
    assert lost.seq not in {each[0] for each in kept}
    # the chunk ends with an input whose outputs are in the next one
    named = [loss.text for loss in report.lost if "what is left of its input does not give its digest" in loss.text]
    numbers = {int(text.split()[1].rstrip(",")) for text in named}
    assert numbers and numbers.isdisjoint(each[0] for each in kept)
    assert numbers <= {entry.seq for entry in large(log, outputs=True)}


def test_where_a_link_is_lost_what_still_follows_is_kept(log: list[Entry], tmp_path: Path) -> None:
    source, place = tmp_path / "damaged.mcap", tmp_path / "recovered.mcap"
    written(source, log, "digest", compression="none")
    damaged(source, b"127.0.0.1:50001")
    report = recover(source, place).report
    with SessionFile.open(place) as file:
        kept = plain(file.entries())
    assert kept == [each for each in plain(log) if each in kept]
    assert Kind.ROS_OUT in {each[2] for each in kept[-40:]}
    # nothing is sent without a link
    sent = [entry for entry in large(log, outputs=True) if entry.kind is Kind.IGTL_OUT and entry.seq > kept[0][0]]  # type: ignore[operator]
    for entry in sent:
        assert any(loss.text.startswith(f"entry {entry.seq}, {entry.channel}: ") for loss in report.lost)


def test_of_a_file_that_was_cut_off_all_outputs_before_are_there(log: list[Entry], tmp_path: Path) -> None:
    source, place = tmp_path / "cut.mcap", tmp_path / "recovered.mcap"
    written(source, log, "digest", compression="none")
    source.write_bytes(source.read_bytes()[: source.stat().st_size * 2 // 3])
    recover(source, place)
    with SessionFile.open(place) as file:
        kept = plain(file.entries())
        assert len(kept) > len(log) // 2 and kept == plain(log)[: len(kept)]
        assert verify_session(file).good


def test_a_damaged_file_shows_the_streams_and_sizes_of_its_outputs(log: list[Entry], tmp_path: Path) -> None:
    source = tmp_path / "cut.mcap"
    written(source, log, "digest", compression="none")
    source.write_bytes(source.read_bytes()[: source.stat().st_size - 40])
    with Salvage.open(source) as file:
        found = list(file.entries())
    assert [(each.seq, each.kind, each.channel, each.type, each.size, each.links) for each in found] == [
        (each.seq, each.kind, each.channel, each.type, each.size, each.links) for each in log
    ]
    unread = {each.seq for each in found if isinstance(each, DigestedOutput)}
    assert unread and unread <= {each.seq for each in large(log, outputs=True)}


# -- recorded ------------------------------------------------------------------------------------------------------


def options_of(path: Path, **options: Any) -> dict[str, Any]:
    """The arguments of a recorder, but the clock."""
    facts = {"igtl_gateway_version": __version__, "config": json.dumps(CONFIG.to_dict(), sort_keys=True)}
    return {
        "path": path,
        "session": facts,
        "qos_of": lambda _topic, _type: None,
        "on_note": lambda _note: None,
        "options": RecordOptions(outputs="digest", **options),
        "rule": StateInputRule(frozenset({LINKS_TOPIC}), frozenset({"CAPABILITY", "CLIENTINFO"})),
    }


def recorded(
    path: Path,
    entries: Sequence[Entry],
    before_close: Callable[[Recorder], object] = lambda _recorder: None,
    **options: Any,
) -> RecordingSummary:
    recorder = Recorder(**options_of(path, **options), clock=ManualClock(), host=in_thread)
    for entry in entries:
        recorder(entry)
    before_close(recorder)
    return recorder.close({"streams": {}})


def test_each_part_of_a_split_recording_has_what_its_outputs_follow_from(log: list[Entry], tmp_path: Path) -> None:
    recorded(tmp_path / "long.mcap", log, split_bytes=1 << 20, compression="none")
    folder = tmp_path / "long"
    with SessionFile.open(folder) as whole:
        assert len(whole.parts) > 2 and whole.has_digests
        assert plain(whole.entries()) == plain(log)
        assert verify_session(whole).good
        paths = [part.path for part in whole.parts]
    every = {each[0]: each for each in plain(log)}
    for path in paths:
        alone = tmp_path / f"alone-{path.name}"
        alone.write_bytes(path.read_bytes())
        with SessionFile.open(alone) as part:
            assert all(each == every[each[0]] for each in plain(part.entries()))
            assert part.has_digests


def test_a_sealed_recording_has_digests_under_its_seal(log: list[Entry], tmp_path: Path) -> None:
    pytest.importorskip("cryptography")
    pytest.importorskip("blake3")
    key = tmp_path / "key"
    key.touch(0o600)
    key.write_bytes(SigningKey.generate().private_pem())
    recorded(tmp_path / "sealed.mcap", log, seal=key)
    with SessionFile.open(tmp_path / "sealed.mcap") as file:
        assert file.is_sealed and file.has_digests
        assert plain(file.entries()) == plain(log)
        assert verify_session(file).good
    assert verify_seal(tmp_path / "sealed.mcap").good


@table("name, value", [("refused", 1), ("lost", {"IMAGE/Probe": 1})])
def test_after_the_queue_has_lost_an_entry_outputs_are_written_in_full(
    log: list[Entry], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: object
) -> None:
    initialised = QueueReader.__init__

    def init(self: QueueReader, *arguments: Any) -> None:
        initialised(self, *arguments)
        if name == "lost":
            self.lost.update(value)  # type: ignore[call-overload]

    monkeypatch.setattr(QueueReader, "__init__", init)
    if name == "refused":
        monkeypatch.setattr(QueueReader, "refused", value)
    recorded(tmp_path / "lossy.mcap", log)
    with SessionFile.open(tmp_path / "lossy.mcap") as file:
        assert plain(file.entries()) == plain(log) and not file.has_digests


def test_an_output_whose_input_was_left_out_is_written_in_full(log: list[Entry], tmp_path: Path) -> None:
    kept = [entry for entry in log if not is_picture(Kind.ROS_IN)(entry)]
    written(tmp_path / "less.mcap", kept, "digest")
    with SessionFile.open(tmp_path / "less.mcap") as file:
        assert plain(file.entries()) == plain(kept)
    written(tmp_path / "none.mcap", kept, "none")
    with SessionFile.open(tmp_path / "none.mcap") as file:
        assert [each for each in plain(file.entries()) if each[3] == "IMAGE/Picture_camera"]
