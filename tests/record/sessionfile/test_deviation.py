"""The first deviation from the sealed units: each kind of change, as a person may make it."""

from __future__ import annotations

import io
import struct

from igtl_gateway.record.seal.digest import new_digest
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.deviation import (
    ADDED,
    CHANGED,
    DROPPED,
    DUPLICATED,
    MOVED,
    SWAPPED,
    Deviation,
    ExpectedUnit,
    deviation_at,
)
from tests.tables import table

#: What each file here begins with.
BEGIN = records.MAGIC + struct.pack("<BQ", records.HEADER, 8) + bytes(8)
RECORDS = {
    name: struct.pack("<BQ", records.CHUNK, size) + name.encode() * size
    for name, size in zip("ABCDEX", (30, 40, 50, 60, 70, 40), strict=True)
}


def unit(kind: str, number: int, at: int, data: bytes) -> ExpectedUnit:
    digest = new_digest()
    digest.update(data)
    return ExpectedUnit(kind, number, at, len(data), digest.digest())


def sealed() -> list[ExpectedUnit]:
    units = [unit("header", 0, 0, BEGIN)]
    for number, name in enumerate("ABCDE", 1):
        units.append(unit("chunk", number, units[-1].end, RECORDS[name]))
    return units


def first(data: bytes, number: int) -> Deviation:
    units = sealed()
    return deviation_at(io.BytesIO(data), len(data), units, number, len(data) - units[-1].end)


@table(
    "names, number, what, chunk, text",
    [
        ("ACDE", 1, DROPPED, 2, ""),
        ("ADE", 1, DROPPED, 2, "with all to chunk 3"),
        ("AE", 1, DROPPED, 2, "with all to chunk 4"),
        ("ACBDE", 1, SWAPPED, 2, "with chunk 3"),
        ("ADCBE", 1, SWAPPED, 2, "with chunk 4"),
        ("ACDBE", 1, MOVED, 2, "to byte"),
        ("ADBCE", 1, MOVED, 4, "before chunk 2"),
        ("ABBCDE", 2, DUPLICATED, 2, ""),
        ("AABCDE", 1, DUPLICATED, 1, ""),
        ("ABACDE", 2, DUPLICATED, 1, ""),
        ("ABADE", 2, CHANGED, 3, "replaced by a copy of chunk 1"),
        ("ABAXDE", 2, DUPLICATED, 1, ""),
        ("AXCDE", 1, CHANGED, 2, ""),
        ("AXBCDE", 1, ADDED, 0, "before chunk 2"),
        ("ABCDX", 4, CHANGED, 5, ""),
    ],
)
def test_what_happened(names: str, number: int, what: str, chunk: int, text: str) -> None:
    found = first(BEGIN + b"".join(RECORDS[name] for name in names), number + 1)
    assert (found.what, found.number) == (what, chunk), found
    assert text in found.text
    assert 0 <= found.begin < found.end


def test_a_unit_without_entries_has_no_numbers() -> None:
    found = first(b"".join((BEGIN[:-1] + b"x", *RECORDS.values())), 0)
    assert (found.kind, found.first_entry, found.last_entry) == ("header", -1, -1)


@table("size, number, text", [(35, 2, "5 bytes fewer"), (45, 2, "5 bytes more")])
def test_a_unit_of_another_size(size: int, number: int, text: str) -> None:
    other = struct.pack("<BQ", records.CHUNK, size) + b"b" * size
    found = first(b"".join((BEGIN, RECORDS["A"], other, *(RECORDS[name] for name in "CDE"))), 2)
    begin = len(BEGIN) + len(RECORDS["A"])
    assert (found.what, found.number, found.begin, found.end) == (CHANGED, number, begin, begin + len(other))
    assert text in found.text
