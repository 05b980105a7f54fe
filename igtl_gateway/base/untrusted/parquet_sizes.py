"""The sizes that the footer and the page headers of an untrusted Parquet file state, checked before it is read.

They are read here and not by pyarrow: where its methods for metadata find a contradiction, they end the process.

https://parquet.apache.org/docs/file-format/metadata/
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted.limits import Deadline, check_limit, check_unpacked, current_limits
from igtl_gateway.base.untrusted.text import printable
from igtl_gateway.base.untrusted.thrift import Fields, Incomplete, ThriftReader, Value

_MAGIC = b"PAR1"
#: Bytes of memory for a byte of the footer: measured with columns of 3 bytes each.
_FOOTER_RATIO = 256
#: Bytes of a page header that are read first, and at most: statistics are a part of it.
_HEADER, _MAX_HEADER = 512, 1 << 20
#: Levels of the schema; pyarrow accepts 100.
_MAX_LEVELS = 100
#: Bytes of a value in memory, by its type in the file; strings have an offset, or a number in a dictionary.
_WIDTHS = {0: 1, 1: 4, 2: 8, 3: 12, 4: 4, 5: 8, 6: 8}
_BYTE_ARRAY, _FIXED_BYTES = 6, 7
_REPEATED = 2
#: Characters of the path of a column in an error.
_SHOWN = 100
#: Offsets and validity of a value in nested lists.
_NESTED = 8
_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_V2 = 0, 2, 3
#: Encodings of strings that pyarrow does not read as a dictionary; in the last one, each may repeat the one before.
_DELTA_LENGTH, _DELTA_BYTE_ARRAY = 6, 7
#: Encodings of values as numbers in a dictionary.
_NUMBERS = frozenset({2, 8})
#: Kind of a page → fields of its own header, and of the encoding in it; the number of values is field 1.
_HEADS = {_DATA_PAGE: (5, 2), _DICTIONARY_PAGE: (7, 2), _DATA_PAGE_V2: (8, 4)}


@dataclass(frozen=True, slots=True)
class _Column:
    """A column of the file: path, bytes of a value in memory, number of lists around it."""

    path: str
    type: int
    width: int
    lists: int


@dataclass(frozen=True, slots=True)
class _Page:
    """A page: its bytes in memory, its values and their encoding; whether it is a dictionary."""

    unpacked: int
    values: int
    encoding: int
    is_dictionary: bool


@dataclass(slots=True)
class _Strings:
    """The most bytes that the strings of a column in a row group unpack to.

    Strings in a dictionary count once, as they are read; but with others that pyarrow does not read as a dictionary,
    all of them are unpacked.
    """

    has_delta: bool = False
    numbers: int = 0
    dictionary: int = 0
    others: int = 0

    def add(self, page: _Page) -> int:
        """Add a page, and return the most bytes."""
        if page.is_dictionary:
            self.dictionary = max(self.dictionary, page.unpacked)
        elif page.encoding in _NUMBERS:
            self.numbers += page.values
        else:
            self.others += page.unpacked * (page.values if page.encoding == _DELTA_BYTE_ARRAY else 1)
            self.has_delta |= page.encoding in (_DELTA_LENGTH, _DELTA_BYTE_ARRAY)
        return self.most

    @property
    def most(self) -> int:
        """The most bytes so far."""
        return self.others + self.dictionary * (max(self.numbers, 1) if self.has_delta else 1)


def check_sizes(stream: BinaryIO, path: Path) -> tuple[int, int, list[str]]:
    """Check what a file unpacks to, as far as its headers state it; strings in dictionaries are not included.

    Returns:
        The numbers of rows and of bytes of the file, and the paths of the columns with strings that may be numbers in a
        dictionary.

    Raises:
        DamagedRecording: it is not valid.
        LimitExceeded: it would unpack to more than the limits allow.
    """
    size = stream.seek(0, 2)
    footer = _footer(stream, size, path)
    columns = _columns(footer, f"{path}: schema")
    groups = _structures(footer, 4, f"{path}: row groups")
    check_limit("count", len(groups) * max(len(columns), 1), f"{path}: row groups × columns")
    deadline, pages, unpacked, total, what = Deadline(size), 0, 0, 0, f"{path}: bytes of all values"
    plain = {each.path for each in columns if each.type != _BYTE_ARRAY}
    for number, group in enumerate(groups):
        chunks, rows = _structures(group, 1, f"{path}: row group {number}"), _integer(group, 3, f"{path}: rows")
        total += rows
        if len(chunks) != len(columns) or (not columns and rows):
            raise DamagedRecording(
                f"{path}: row group {number}: found {counted(len(chunks), 'column')} and {counted(rows, 'row')}, "
                f"expected {len(columns)}"
            )
        for column, chunk in zip(columns, chunks, strict=True):
            place = f"{path}: row group {number}, {_shown(column.path)}"
            facts, strings = chunk.get(3), _Strings()
            if not isinstance(facts, dict):
                raise DamagedRecording(f"{place}: found no metadata, expected them")
            values = _integer(facts, 5, place)
            if not rows <= values or (values > rows and not column.lists):
                raise DamagedRecording(
                    f"{place}: found {counted(values, 'value')} in {counted(rows, 'row')}, expected one for each"
                )
            unpacked += values * (column.width + _NESTED * column.lists)
            check_unpacked(size, unpacked, what)
            for page in _pages(facts, values, stream, size, place, deadline):
                pages += 1
                check_limit("count", pages, f"{path}: pages")
                if column.type == _BYTE_ARRAY:
                    check_unpacked(size, unpacked + strings.add(page), what)
            unpacked += strings.most
            if strings.has_delta:
                plain.add(column.path)
    return total, size, sorted({each.path for each in columns} - plain)


def _footer(stream: BinaryIO, size: int, path: Path) -> Fields:
    stream.seek(max(size - 8, 0))
    tail = stream.read(8)
    if len(tail) < 8 or tail[4:] != _MAGIC:
        raise DamagedRecording(f"{path}: is not valid Parquet: found {tail[4:]!r} at its end, expected {_MAGIC!r}")
    length = struct.unpack_from("<I", tail)[0]
    check_limit("memory", length, f"{path}: bytes of the footer", current_limits().memory // _FOOTER_RATIO)
    if length > size - 8:
        raise DamagedRecording(
            f"{path}: is not valid Parquet: found a footer of {counted(length, 'byte')} in {counted(size, 'byte')}"
        )
    stream.seek(size - 8 - length)
    try:
        return ThriftReader(stream.read(length), f"{path}: footer").struct()
    except Incomplete:
        raise DamagedRecording(f"{path}: is not valid Parquet: found the end inside of the footer") from None


def _columns(footer: Fields, place: str) -> list[_Column]:
    """The columns of the schema, which is a list in which each element states its number of children."""
    elements = _structures(footer, 2, place)
    found: list[_Column] = []
    above: list[tuple[int, str, int]] = []  # children to come, path, lists around them
    for number, each in enumerate(elements):
        children = each.get(5)
        name = each.get(4)
        text = name.decode("utf-8", "replace") if isinstance(name, bytes) else ""
        if number == 0:
            if not isinstance(children, int) or children < 0:
                raise DamagedRecording(f"{place}: found no number of columns, expected one")
            above.append((children, "", 0))
            continue
        while above and above[-1][0] == 0:
            above.pop()
        if not above:
            raise DamagedRecording(f"{place}: found more elements than it states, expected {number}")
        left, prefix, lists = above.pop()
        above.append((left - 1, prefix, lists))
        path, lists = f"{prefix}.{text}" if prefix else text, lists + (each.get(3) == _REPEATED)
        if isinstance(children, int) and children > 0:
            above.append((children, path, lists))
            check_limit("depth", len(above), f"{place}: levels", _MAX_LEVELS)
        else:
            found.append(_column(each, path, lists, place))
    return found


def _shown(path: str) -> str:
    return printable(path[:_SHOWN])


def _column(element: Fields, path: str, lists: int, place: str) -> _Column:
    kind = element.get(1)
    width = element.get(2) if kind == _FIXED_BYTES else _WIDTHS.get(kind) if isinstance(kind, int) else None
    if not isinstance(kind, int) or not isinstance(width, int) or not 0 <= width < 1 << 31:
        raise DamagedRecording(
            f"{place}: {_shown(path)}: found type {_name(kind)} with the width {_name(width)}, expected one of Parquet"
        )
    return _Column(path, kind, width, lists)


def _pages(facts: Fields, most: int, stream: BinaryIO, size: int, place: str, deadline: Deadline) -> Iterator[_Page]:
    """Yield the pages of a column in a row group, with sizes that fit the file; those of other kinds are skipped."""
    at, first = _integer(facts, 9, place), facts.get(11)
    if isinstance(first, int) and 0 < first < at:  # its dictionary
        at = first
    end = at + _integer(facts, 7, place)
    if end > size:
        raise DamagedRecording(f"{place}: found bytes {at} to {end}, expected a part of {size}")
    values = 0
    while at < end and values < most:
        deadline.check(place)
        header, length = _header(stream, at, place)
        kind, unpacked, packed = (header.get(number) for number in (1, 2, 3))
        if not isinstance(unpacked, int) or not isinstance(packed, int) or packed < 0 or unpacked < 0:
            raise DamagedRecording(
                f"{place}: byte {at}: found a page of {_name(packed)} bytes for {_name(unpacked)}, expected sizes"
            )
        at += length + packed
        if at > end:
            raise DamagedRecording(
                f"{place}: found a page of {counted(packed, 'byte')} up to {at}, expected its end by {end}"
            )
        check_unpacked(packed, unpacked, f"{place}: bytes of a page")
        if not isinstance(kind, int) or kind not in _HEADS:
            continue
        field, encoding_field = _HEADS[kind]
        inner = header.get(field)
        inner = inner if isinstance(inner, dict) else {}
        count, encoding = inner.get(1), inner.get(encoding_field)
        allowed = unpacked if kind == _DICTIONARY_PAGE else most - values
        if not isinstance(count, int) or not isinstance(encoding, int) or not 0 <= count <= allowed:
            raise DamagedRecording(f"{place}: found a page with {_name(count)} values, expected at most {allowed}")
        values += count if kind != _DICTIONARY_PAGE else 0
        yield _Page(unpacked, count, encoding, kind == _DICTIONARY_PAGE)


def _header(stream: BinaryIO, at: int, place: str) -> tuple[Fields, int]:
    """Return the header of a page, and its length."""
    size = _HEADER
    while size <= _MAX_HEADER:
        stream.seek(at)
        data = stream.read(size)
        reader = ThriftReader(data, f"{place}: page at byte {at}")
        try:
            return reader.struct(), reader.at
        except Incomplete:
            if len(data) < size:
                break
        size *= 8
    raise DamagedRecording(f"{place}: byte {at}: found no page header of at most {_MAX_HEADER} bytes")


def _structures(fields: Fields, number: int, place: str) -> list[Any]:
    found = fields.get(number)
    if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
        raise DamagedRecording(f"{place}: found no list of structures, expected one")
    return found


def _name(value: Value) -> str:
    """An integer, or the type of another value."""
    return str(value) if isinstance(value, int) else type(value).__name__


def _integer(fields: Fields, number: int, place: str) -> int:
    found = fields.get(number)
    if not isinstance(found, int) or not 0 <= found < 1 << 62:
        raise DamagedRecording(f"{place}: found {_name(found)} in field {number}, expected an integer of 0 or more")
    return found
