"""Reads the HDF5 files in which ITK and 3D Slicer store transforms (``.h5``): names and small lists of numbers.

Only what ITK writes is read: a superblock of version 2 or 3, object headers of version 2, links in them, data in one
piece, and names in a global heap (*HDF5 File Format Specification 3.0*).  Anything else is refused with its place; a
grid is refused by the name of its transform before its numbers are looked at.  Memory: one object.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files, limits

HDF5 = b"\x89HDF\r\n\x1a\n"
_GROUP = "TransformGroup"
#: Names of the numbers; the second is that of older versions of ITK.
_PARAMETERS = ("TransformParameters", "TranformParameters")
_FIXED = ("TransformFixedParameters", "TranformFixedParameters")
_SPACE, _TYPE, _LINK, _LAYOUT, _CONTINUED = 1, 3, 6, 8, 16
_MESSAGE = struct.Struct("<BHB")
#: What other files of HDF5 need.
_BY_RECIPE = "; kinematics need a recipe (examples/kinematics.toml)"
#: Longest list of numbers that a transform with a matrix has.
_MOST = 64
_MAX_HEADER = 1 << 20

Found = tuple[str, list[float], list[float]]


def read_hdf5(path: Path) -> list[Found]:
    """Return name, parameters and fixed parameters of each transform; long lists are empty.

    Raises DamagedRecording, UnsupportedRecording or LimitExceeded.
    """
    with files.open_file(path) as stream:
        file = _Hdf5(stream, str(path), files.size_of(path))
        groups = file.links(file.root())
        if _GROUP not in groups:
            found = f"found no /{_GROUP} in this HDF5 file"
            raise UnsupportedRecording(f"{path}: {found}, expected transforms of ITK{_BY_RECIPE}")
        numbered = file.links(groups[_GROUP])
        limits.check_limit("fields", len(numbered), f"{path}: transforms")
        if sorted(numbered) != sorted(map(str, range(len(numbered)))):
            raise DamagedRecording(f"{path}: /{_GROUP}: found {', '.join(numbered)[:60]}, expected numbers from 0")
        return [file.transform(numbered[str(number)], number) for number in range(len(numbered))]


class _Hdf5:
    """An open file."""

    def __init__(self, stream: BinaryIO, where: str, size: int) -> None:
        self._stream, self._where, self._size = stream, where, size

    def root(self) -> int:
        """Return the address of the root group."""
        head = self._bytes(0, 48)
        if head[8] not in (2, 3) or head[9:11] != b"\x08\x08":
            place = f"{self._where}: superblock"
            raise UnsupportedRecording(f"{place}: found version {head[8]}, expected 2 or 3 as of ITK{_BY_RECIPE}")
        return int.from_bytes(head[36:44], "little")

    def links(self, address: int) -> dict[str, int]:
        """Return name → address of what a group contains."""
        found = {}
        for kind, data in self._messages(address):
            if kind == _LINK:
                name, target = self._link(data)
                found[name] = target
        return found

    def transform(self, address: int, number: int) -> Found:
        """Return a transform of the file."""
        parts = self.links(address)
        if "TransformType" not in parts:
            raise DamagedRecording(f"{self._where}: transform {number}: found no TransformType, expected one")
        name = self._text(parts["TransformType"])
        parameters, fixed = (
            next((self._numbers(parts[name]) for name in names if name in parts), []) for names in (_PARAMETERS, _FIXED)
        )
        return name, parameters, fixed

    def _messages(self, address: int) -> Iterator[tuple[int, bytes]]:
        """Yield the messages of an object header of version 2."""
        head = self._bytes(address, 6)
        if head[:5] != b"OHDR\x02":
            raise UnsupportedRecording(
                f"{self._where}: byte {address}: found {head[:5]!r}, expected an object header of version 2 as of ITK"
            )
        flags = head[5]
        at = address + 6 + (16 if flags & 0x20 else 0) + (4 if flags & 0x10 else 0)
        width = 1 << (flags & 3)
        blocks = [(at + width, int.from_bytes(self._bytes(at, width), "little"))]
        seen = 0
        for start, size in blocks:
            seen += size
            if seen > _MAX_HEADER or len(blocks) > limits.current_limits().fields:
                raise DamagedRecording(
                    f"{self._where}: byte {address}: found a header above 1 MiB, expected a small one"
                )
            data, place = self._bytes(start, size), 0
            while place + _MESSAGE.size <= size:
                kind, length, _ = _MESSAGE.unpack_from(data, place)
                place += _MESSAGE.size + (2 if flags & 4 else 0)
                content = data[place : place + length]
                if len(content) < length:
                    raise DamagedRecording(f"{self._where}: byte {start + place}: found the end of a header")
                place += length
                if kind == _CONTINUED:
                    to, long = struct.unpack_from("<QQ", self._whole(content, 16))
                    blocks.append((to + 4, max(0, long - 8)))  # between a signature and a checksum
                else:
                    yield kind, content

    def _link(self, data: bytes) -> tuple[str, int]:
        flags, at = self._whole(data, 2)[1], 2
        if flags & 8 and data[2]:
            raise UnsupportedRecording(f"{self._where}: found a link out of the file, expected objects of the file")
        at += bool(flags & 8) + (8 if flags & 4 else 0) + bool(flags & 16)
        width = 1 << (flags & 3)
        length = int.from_bytes(data[at : at + width], "little")
        at += width
        self._whole(data, at + length + 8)
        return data[at : at + length].decode("utf-8", "replace"), int.from_bytes(data[at + length :][:8], "little")

    def _stored(self, address: int) -> tuple[int, bytes, int, int]:
        """Return number of values, description of their type, address and bytes of a dataset."""
        count, kind, place, size, layout = 1, b"", 0, 0, -1
        for message, data in self._messages(address):
            if message == _SPACE:
                dims = self._whole(data, 4)[1]
                count = 1
                for value in struct.unpack_from(f"<{dims}Q", self._whole(data, 4 + 8 * dims), 4):
                    count *= value
            elif message == _TYPE:
                kind = data
            elif message == _LAYOUT:
                layout = self._whole(data, 2)[1]
                if layout == 1:
                    place, size = struct.unpack_from("<QQ", self._whole(data, 18), 2)
        if layout != 1 and count <= _MOST:
            raise UnsupportedRecording(
                f"{self._where}: byte {address}: found data in pieces, expected one piece as of ITK"
            )
        return count, kind, place, size

    def _numbers(self, address: int) -> list[float]:
        count, kind, place, size = self._stored(address)
        if count > _MOST or not size:
            return []
        if kind[:1] != b"\x11" or kind[1] & 1 or kind[4:8] not in (b"\x08\0\0\0", b"\x04\0\0\0"):
            raise UnsupportedRecording(
                f"{self._where}: byte {address}: found numbers of another type, expected little-endian float"
            )
        dtype = np.dtype(f"<f{kind[4]}")
        if size != count * dtype.itemsize:
            raise DamagedRecording(
                f"{self._where}: byte {address}: found {counted(size, 'byte')}, expected {counted(count, 'number')}"
            )
        return np.frombuffer(self._bytes(place, size), dtype).astype(float).tolist()

    def _text(self, address: int) -> str:
        """Return a name: of a fixed length, or in the global heap."""
        _, kind, place, size = self._stored(address)
        if kind[:1] == b"\x13":
            return self._bytes(place, min(size, 256)).split(b"\0")[0].decode("ascii", "replace")
        if kind[:1] != b"\x19":
            raise UnsupportedRecording(
                f"{self._where}: byte {address}: found no text, expected the name of a transform"
            )
        length, heap, index = struct.unpack("<IQI", self._bytes(place, 16))
        if self._bytes(heap, 5) != b"GCOL\x01":
            raise DamagedRecording(f"{self._where}: byte {heap}: found no global heap, expected one")
        at, end = heap + 16, heap + int.from_bytes(self._bytes(heap + 8, 8), "little")
        for _ in range(limits.current_limits().fields):
            if at + 16 > min(end, self._size):
                break
            number, _, _, long = struct.unpack("<HHIQ", self._bytes(at, 16))
            if number == index:
                return self._bytes(at + 16, min(length, long, 256)).split(b"\0")[0].decode("ascii", "replace")
            at += 16 + -(-long // 8) * 8
        raise DamagedRecording(f"{self._where}: byte {heap}: found no object {index} in the heap, expected a name")

    def _bytes(self, at: int, size: int) -> bytes:
        if at + size > self._size:
            raise DamagedRecording(
                f"{self._where}: byte {at}: found the end of the file at {self._size}, expected {counted(size, 'byte')}"
            )
        self._stream.seek(at)
        return self._stream.read(size)

    def _whole(self, data: bytes, size: int) -> bytes:
        if len(data) < size:
            raise DamagedRecording(
                f"{self._where}: found {counted(len(data), 'byte')} of a header message, expected {size}"
            )
        return data
