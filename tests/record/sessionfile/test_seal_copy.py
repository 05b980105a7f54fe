"""Sealing a file whose index lies: refused in one line, before there is a copy."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import pytest
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk

from igtl_gateway.base.errors import UnsupportedRecording
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.seal.statement import UnitRow
from igtl_gateway.record.sessionfile.layout import SEAL_METADATA
from igtl_gateway.record.sessionfile.seal_check import SEALED, check_seal
from igtl_gateway.record.sessionfile.seal_copy import seal_copy
from igtl_gateway.record.sessionfile.sealing import Sealer, SealSeries
from tests.places import FIXTURES
from tests.tables import table
from tools import mcap_build as build

_PARTS = [
    (build.HEADER, build.header()),
    (build.SCHEMA, build.schema(1, "Example", "c", b"\4\5\6")),
    (build.CHANNEL, build.channel(1, 1, "example", "a", {"foo": "bar"})),
    (build.MESSAGE, build.message(1, 1, 1, 1, b"\1\2\3")),
]
#: Content of the statistics → part of the reason; "": sealed.
_STATISTICS = {
    "as it is": (build.statistics(1, 1, 1, 0, 0, 0, 1, 1, {1: 1}), ""),
    "another number of messages": (build.statistics(2**64 - 1, 9, 9, 9, 9, 9, 5, 1, {7: 2**64 - 1}), ""),
    "room for the two seals": (build.statistics(1, 1, 1, 0, 2**32 - 3, 0, 1, 1, {1: 1}), ""),
    "no room for them": (build.statistics(1, 1, 1, 0, 2**32 - 2, 0, 1, 1, {1: 1}), "metadata records"),
    "nothing": (b"", "statistics: found 0 bytes"),
    "cut off in a number": (bytes(45), "statistics: found 3 bytes at byte 42"),
    "counts beyond the end": (bytes(42) + b"\xff\xff\xff\xff", "expected 4294967295"),
    "half a count": (bytes(42) + b"\x05\0\0\0" + bytes(5), "expected a multiple of 10"),
}


@table("name", _STATISTICS)
def test_statistics_of_a_file_are_read_before_the_copy_is_written(name: str, tmp_path: Path) -> None:
    content, reason = _STATISTICS[name]
    made = build.assemble(_PARTS)
    made.summary = [(opcode, content if opcode == build.STATISTICS else data) for opcode, data in made.summary]
    source, output = tmp_path / "a.mcap", tmp_path / "sealed.mcap"
    source.write_bytes(made.finish())
    sealer = SealSeries(SigningKey.generate(), lambda: 5).next_file(output)
    if not reason:
        assert seal_copy(source, output, sealer) == output.stat().st_size
        assert check_seal(output).state == SEALED
        return
    with pytest.raises(UnsupportedRecording, match=f"a.mcap: .*{reason}"):
        seal_copy(source, output, sealer)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


@table("path", sorted(FIXTURES.glob("*.mcap")), ids=lambda path: str(path.stem))
def test_a_seal_has_the_first_and_the_last_entry_of_each_chunk(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "sealed.mcap"
    sealer = SealSeries(SigningKey.generate(), lambda: 1).next_file(out)
    rows: list[UnitRow] = []

    def add(unit: UnitRow) -> None:
        rows.append(unit)
        Sealer.add(sealer, unit)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sealer, "add", add)
        seal_copy(path, out, sealer)
    found = [(row.first, row.last) for row in rows if row.kind == "chunk"]
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes  # type: ignore[union-attr]
        expected = []
        for chunk in sorted(chunks, key=lambda each: each.chunk_start_offset):
            stream.seek(chunk.chunk_start_offset + 9)
            records = breakup_chunk(Chunk.read(ReadDataStream(stream)))
            numbers = [record.sequence for record in records if isinstance(record, Message)]
            expected.append((min(numbers), max(numbers)))
    assert found == expected


@pytest.mark.parametrize("names", [(), ("m",), ("m", "n")])
def test_the_index_of_a_sealed_copy_names_each_metadata_record_once(names: tuple[str, ...], tmp_path: Path) -> None:
    """Those of the file and the two seals, read by the library of MCAP."""
    rows = [(build.METADATA, build.metadata(name, {"a": "b"})) for name in names]
    source, output = tmp_path / "a.mcap", tmp_path / "sealed.mcap"
    source.write_bytes(build.assemble([*_PARTS, *rows]).finish())
    seal_copy(source, output, SealSeries(SigningKey.generate(), lambda: 5).next_file(output))
    summary = make_reader(BytesIO(output.read_bytes())).get_summary()
    assert summary and summary.statistics
    assert [each.name for each in summary.metadata_indexes] == [*names, SEAL_METADATA, SEAL_METADATA]
    assert summary.statistics.metadata_count == len(names) + 2
    offsets = [each.offset for each in summary.metadata_indexes]
    assert offsets == sorted(set(offsets))
    assert check_seal(output).state == SEALED
