"""Pixels as IMAGE has them, from files in which axes stand in any order, of every type, packed or not."""

from __future__ import annotations

import bz2
import gzip
import itertools
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.addons.exchange.sequence import Sequence
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN
from tests.addons.exchange.itk import images_of, sitk
from tests.tables import table

NRRD = {
    **{"i1": "int8", "u1": "uchar", "i2": "short", "u2": "uint16", "i4": "int", "u4": "unsigned int"},
    **{"f4": "float", "f8": "double", "i8": "long long int", "u8": "uint64"},
}
PACK: dict[str, Callable[[bytes], bytes]] = {
    "raw": bytes,
    "gzip": gzip.compress,
    "gz": gzip.compress,
    "bzip2": bz2.compress,
}


def nrrd(path: Path, data: bytes, *lines: str, encoding: str = "raw") -> Path:
    head = ["NRRD0004", *lines, f"encoding: {encoding}", "", ""]
    path.write_bytes("\n".join(head).encode() + PACK[encoding](data))
    return path


@table("dtype", NRRD)
@table("order", ["<", ">"])
@table("suffix", ["mha", "nrrd"])
def test_every_type_and_byte_order_comes_in_as_itk_reads_it(
    tmp_path: Path, dtype: str, order: str, suffix: str
) -> None:
    values = np.arange(24).reshape(2, 3, 4).astype(order + dtype)
    path = tmp_path / f"some.{suffix}"
    if suffix == "nrrd":
        endian = "big" if order == ">" else "little"
        lines = (f"type: {NRRD[dtype]}", "dimension: 3", "sizes: 4 3 2", "kinds: domain domain domain")
        nrrd(path, values.tobytes(), *lines, f"endian: {endian}", "spacings: 1 1 1")
    else:
        itk = {**{"i1": "CHAR", "u1": "UCHAR", "i2": "SHORT", "u2": "USHORT", "i4": "INT", "u4": "UINT"}}
        name = {**itk, "f4": "FLOAT", "f8": "DOUBLE", "i8": "LONG_LONG", "u8": "ULONG_LONG"}[dtype]
        head = f"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = {order == '>'}\n"
        head += f"ElementSpacing = 1 1 1\nDimSize = 4 3 2\nElementType = MET_{name}\nElementDataFile = LOCAL\n"
        path.write_bytes(head.encode() + values.tobytes())
    (image,) = images_of(path)
    assert image.endian == (BIG_ENDIAN if order == ">" else LITTLE_ENDIAN)
    assert np.array_equal(image.array[..., 0], values)
    assert np.array_equal(sitk().GetArrayFromImage(sitk().ReadImage(str(path))), values)


KINDS = {"vector": 3, "domain x": 5, "domain y": 4, "domain z": 2, "list": 6}


@pytest.mark.parametrize("order", list(itertools.permutations(("vector", "domain", "list"))))
def test_axes_in_any_order_are_put_in_that_of_image(tmp_path: Path, order: tuple[str, ...]) -> None:
    axes = [axis for kind in order for axis in KINDS if axis.startswith(kind)]
    # values[t, z, y, x, c] of what is meant, then as the file has it, the last of the axes slowest
    meant = np.arange(6 * 2 * 4 * 5 * 3, dtype=np.uint16).reshape(6, 2, 4, 5, 3)
    where = {"list": 0, "domain z": 1, "domain y": 2, "domain x": 3, "vector": 4}
    stored = meant.transpose([where[axis] for axis in reversed(axes)])
    sizes = " ".join(str(KINDS[axis]) for axis in axes)
    kinds = " ".join(axis.split()[0] for axis in axes)
    path = nrrd(
        tmp_path / "some.nrrd",
        np.ascontiguousarray(stored).tobytes(),
        *("type: uint16", "dimension: 5", f"sizes: {sizes}", f"kinds: {kinds}", "endian: little"),
    )
    images = images_of(path)
    assert [image.dimensions for image in images] == [(5, 4, 2)] * 6
    assert np.array_equal(np.array([image.array for image in images]), meant)


@pytest.mark.parametrize("encoding", PACK)
def test_packed_pixels_come_out_whole(tmp_path: Path, encoding: str) -> None:
    data = np.random.default_rng(1).integers(0, 255, 3 * 400 * 500, np.uint8).tobytes()
    lines = ("type: uchar", "dimension: 3", "sizes: 500 400 3", "kinds: domain domain list")
    images = images_of(nrrd(tmp_path / "some.nrrd", data, *lines, encoding=encoding))
    assert b"".join(bytes(image.pixels) for image in images) == data


def test_gzip_of_several_members_is_one_stream(tmp_path: Path) -> None:
    path = nrrd(tmp_path / "some.nrrd", b"", "type: uchar", "sizes: 4 3 2", "kinds: domain domain list")
    path.write_bytes(
        path.read_bytes().replace(b"raw", b"gzip")
        + b"".join(gzip.compress(bytes(range(at, at + 8))) for at in (0, 8, 16))
    )
    assert b"".join(bytes(image.pixels) for image in images_of(path)) == bytes(range(24))


@pytest.mark.parametrize("value", [2**53, -(2**53), 2**53 + 1, 2**63 - 1])
def test_whole_numbers_of_64_bits_come_without_loss_or_not_at_all(tmp_path: Path, value: int) -> None:
    lines = ("type: int64", "sizes: 2 1", "kinds: domain domain", "endian: little")
    path = nrrd(tmp_path / "some.nrrd", np.array([value, 7], "<i8").tobytes(), *lines)
    if abs(value) > 2**53:
        with pytest.raises(DamagedRecording, match="64-bit integers"):
            images_of(path)
    else:
        assert images_of(path)[0].array.reshape(-1).tolist() == [value, 7]
        assert any("64-bit integers" in note for note in Sequence(path).notes)


def test_pixels_in_a_file_beside_may_begin_anywhere(tmp_path: Path) -> None:
    (tmp_path / "some.raw").write_bytes(b"head" + bytes(range(12)))
    lines = ("type: uchar", "sizes: 4 3", "kinds: domain domain", "data file: some.raw")
    for skip in (4, -1):
        (image,) = images_of(nrrd(tmp_path / "some.nhdr", b"", *lines, f"byte skip: {skip}"))
        assert bytes(image.pixels) == bytes(range(12))
    head = "ObjectType = Image\nDimSize = 4 3\nElementType = MET_UCHAR\nHeaderSize = {}\nElementDataFile = some.raw\n"
    for skip in (4, -1):
        (tmp_path / "some.mhd").write_text(head.format(skip))
        assert bytes(images_of(tmp_path / "some.mhd")[0].pixels) == bytes(range(12))


def test_zlib_of_another_length_is_damage(tmp_path: Path) -> None:
    head = (
        "ObjectType = Image\nDimSize = 4 3\nElementType = MET_UCHAR\nCompressedData = True\nElementDataFile = LOCAL\n"
    )
    for data in (zlib.compress(bytes(11)), b"no zlib at all", b""):
        (tmp_path / "some.mha").write_bytes(head.encode() + data)
        with pytest.raises(DamagedRecording, match=r"some\.mha"):
            images_of(tmp_path / "some.mha")
