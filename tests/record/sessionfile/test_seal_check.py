"""Sealed files: every change is found and named; a cut is distinguished from a change; other tools read them."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import pytest
from mcap.reader import make_reader

from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile.copying import CopyWriter
from igtl_gateway.record.sessionfile.layout import SEAL_METADATA
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.record.sessionfile.seal_check import CHANGED, CUT, SEALED, UNSEALED, UNTRUSTED, check_seal
from igtl_gateway.record.sessionfile.sealing import SealSeries
from igtl_gateway.record.sessionfile.units import units
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.record import samples
from tools.seal_mutations import Original, cases, sealed_file

KEY = SigningKey.generate()
TRUSTED = frozenset([KEY.public])


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Original:
    return sealed_file(tmp_path_factory.mktemp("seal") / "sealed.mcap", KEY, entries=150)


def test_every_change_is_named_rightly(original: Original, tmp_path: Path) -> None:
    path = tmp_path / "changed.mcap"
    for case in cases(original, 60, seed=5):
        path.write_bytes(case.data)
        assert case.judge(check_seal(path, TRUSTED)) == "", case.kind


def test_every_bit_of_one_seal_and_of_the_end_counts(original: Original, tmp_path: Path) -> None:
    path = tmp_path / "changed.mcap"
    last = original.seals[-1]
    for at in (*range(last.at, last.end, 61), *range(last.end, len(original.data) - 8, 997)):
        path.write_bytes(original.data[:at] + bytes([original.data[at] ^ 4]) + original.data[at + 1 :])
        assert check_seal(path, TRUSTED).state == CHANGED, at


def test_other_readers_open_a_sealed_file(original: Original, tmp_path: Path) -> None:
    reader = make_reader(BytesIO(original.data), validate_crcs=True)
    assert sum(1 for _ in reader.iter_messages()) == 150
    assert sum(each.name == SEAL_METADATA for each in reader.iter_metadata()) == len(original.seals)
    path = tmp_path / "sealed.mcap"
    path.write_bytes(original.data)
    with SessionFile.open(path) as file:
        assert file.entry_count == 150


def test_a_recovered_copy_has_no_seal_of_the_original(original: Original, tmp_path: Path) -> None:
    path = tmp_path / "sealed.mcap"
    path.write_bytes(original.data)
    with Salvage.open(path) as file:
        with CopyWriter(tmp_path / "copy.mcap", file.profile, file.library, {}, compression="none") as writer:
            for metadata in file.metadata():
                writer.add_metadata(metadata)
            writer.close({})
    assert check_seal(tmp_path / "copy.mcap", TRUSTED).state == UNSEALED


def test_seals_of_another_key_are_worth_nothing(original: Original, tmp_path: Path) -> None:
    path = tmp_path / "sealed.mcap"
    path.write_bytes(original.data)
    assert check_seal(path, TRUSTED).state == SEALED
    assert check_seal(path, frozenset([SigningKey.generate().public])).state == UNTRUSTED
    assert check_seal(path).trusted is None


def _write(path: Path, key: SigningKey, entries: list[Entry], *, flush: int = 1) -> None:
    writer = SessionWriter(path, {}, sealer=SealSeries(key, lambda: 5).next_file(path))
    for number, entry in enumerate(entries):
        writer.write(entry)
        if number % flush == 0:
            writer.flush()
    writer.close({})


def test_a_seal_of_the_same_key_from_another_recording_is_an_addition(tmp_path: Path) -> None:
    one, other = tmp_path / "one.mcap", tmp_path / "other.mcap"
    _write(one, KEY, [samples.ros(number) for number in range(1, 9)])
    _write(other, KEY, [samples.ros(number, text="other") for number in range(1, 4)])
    first, second = sealed_units(one), sealed_units(other)
    place = first.units[5].at
    part = second.data[second.units[5].at : second.units[9].end]
    one.write_bytes(first.data[:place] + part + first.data[place:])
    report = check_seal(one, TRUSTED)
    assert (report.state, report.first and report.first.what) == (CHANGED, "added")
    assert report.first is not None
    assert report.first.begin >= place  # units that both files have are no addition


def sealed_units(path: Path) -> Original:
    data = path.read_bytes()
    return Original(data, list(units(BytesIO(data), 0, len(data))), [])


def test_the_smallest_recordings(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    _write(path, KEY, [])
    report = check_seal(path, TRUSTED)
    assert (report.state, report.sealed_entry, report.seals) == (SEALED, -1, 2)
    data = path.read_bytes()
    for size in range(0, len(data), 61):
        path.write_bytes(data[:size])
        assert check_seal(path, TRUSTED).state in (UNSEALED, CUT, CHANGED), size


def test_a_chunk_is_named_with_its_entries(tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    _write(path, KEY, [samples.ros(number) for number in range(1, 31)], flush=10)
    data = bytearray(path.read_bytes())
    chunks = [unit for unit in sealed_units(path).units if unit.opcode == 6]
    data[chunks[1].end - 1] ^= 1
    path.write_bytes(data)
    first = check_seal(path, TRUSTED).first
    assert first is not None
    assert (first.what, first.kind, first.number) == ("changed", "chunk", 2)
    assert (first.begin, first.end, first.first_entry, first.last_entry) == (chunks[1].at, chunks[1].end, 2, 11)
