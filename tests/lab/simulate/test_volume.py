"""NIfTI-1 as others write it, files that are broken, and the head made of formulae."""

from __future__ import annotations

import gzip
import hashlib
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.image import Image
from igtl_gateway_lab.simulate import volume
from igtl_gateway_lab.simulate.volume import (
    LESION,
    MrVolume,
    find_volume,
    head_volume,
    read_nifti_volume,
    synthetic_head,
)
from tests.tables import table

SIZE = (4, 3, 2)
SROW = (0, -2, 0, 10, 3, 0, 0, -20, 0, 0, 5, 7)


def nifti(order: str = "<", code: int = 4, dtype: str = "i2", **changes: tuple[int, str, tuple[Any, ...]]) -> bytes:
    """A file by the standard's table of offsets; ``changes``: offset, layout and values of a field."""
    header = bytearray(352)
    fields: dict[str, tuple[int, str, tuple[Any, ...]]] = {
        "sizeof_hdr": (0, "i", (348,)),
        "dim": (40, "8h", (3, *SIZE, 1, 1, 1, 1)),
        "datatype": (70, "h", (code,)),
        "pixdim": (76, "8f", (1, 3, 2, 5, 0, 0, 0, 0)),
        "vox_offset": (108, "f", (352,)),
        "codes": (252, "2h", (0, 1)),
        "srow": (280, "12f", SROW),
        "magic": (344, "4s", (b"n+1\0",)),
    }
    for offset, layout, values in (fields | changes).values():
        struct.pack_into(order + layout, header, offset, *values)
    voxels = np.zeros(24, dtype) if dtype == "V3" else np.arange(24).astype(order + dtype)
    return bytes(header) + voxels.tobytes()


def written(folder: Path, data: bytes, name: str = "head.nii") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


@table("order", "<>")
@table("packed", [False, True])
@table(("code", "dtype"), [(2, "u1"), (4, "i2"), (8, "i4"), (16, "f4"), (64, "f8"), (512, "u2")])
def test_voxels_of_every_kind_come_in_their_order(
    tmp_path: Path, order: str, packed: bool, code: int, dtype: str
) -> None:
    data = nifti(order, code, dtype)
    name = "head.nii.gz" if packed else "head.nii"
    read = read_nifti_volume(written(tmp_path, gzip.compress(data, mtime=0) if packed else data, name))
    assert read.size == SIZE and read.source == name
    assert read.voxels[1, 2, 3] == 23 and read.voxels[0, 1, 0] == 4
    assert read.affine.tolist() == [[0, -2, 0, 10], [3, 0, 0, -20], [0, 0, 5, 7]]
    image = decode(b"".join(encode(Message("IMAGE", "Head", read.image)))).content
    assert isinstance(image, Image)
    assert image.array[..., 0].tolist() == read.voxels.tolist()
    assert image.wire_matrix == (0, 3, 0, -2, 0, 0, 0, 0, 5, 8, -15.5, 9.5), "the position is that of the centre"


def test_scaling_is_applied(tmp_path: Path) -> None:
    read = read_nifti_volume(written(tmp_path, nifti(scl=(112, "2f", (0.5, 10.0)))))
    assert read.voxels[1, 2, 3] == 21.5 and read.voxels.dtype == np.float32


def test_a_quaternion_places_where_there_are_no_rows(tmp_path: Path) -> None:
    half = 0.5**0.5  # a quarter turn about z, and k goes down
    qform = nifti(
        codes=(252, "2h", (1, 0)), quatern=(256, "6f", (0, 0, half, 1, 2, 3)), pixdim=(76, "4f", (-1, 3, 2, 5))
    )
    read = read_nifti_volume(written(tmp_path, qform))
    assert read.affine == pytest.approx(np.array([[0, -2, 0, 1], [3, 0, 0, 2], [0, 0, -5, 3]]), abs=1e-6)
    bare = read_nifti_volume(written(tmp_path, nifti(codes=(252, "2h", (0, 0)))))
    assert bare.affine.tolist() == [[-3, 0, 0, 4.5], [0, 2, 0, -2], [0, 0, 5, -2.5]], "nibabel's: centred, left first"


@table(
    ("data", "told"),
    [
        (b"", "Empty file"),
        (b"hello" * 100, "Cannot work out file type"),
        (nifti(dim=(40, "8h", (4, 4, 3, 2, 9, 1, 1, 1))), "found (4, 3, 2, 9), expected one volume of 3 dimensions"),
        (nifti(dim=(40, "8h", (2, 4, 3, 1, 1, 1, 1, 1))), "expected one volume of 3 dimensions"),
        (nifti(dim=(40, "8h", (3, 4, -3, 2, 1, 1, 1, 1))), "size: found (4, -3, 2)"),
        (nifti(dim=(40, "8h", (3, 32767, 32767, 32767, 1, 1, 1, 1))), "size: found (32767, 32767, 32767)"),
        (nifti(code=128, dtype="V3"), "data type: found [("),
        (nifti(vox_offset=(108, "f", (float("nan"),))), "NaN"),
        (nifti(srow=(280, "12f", (0.0,) * 12)), "place: found"),
        (nifti()[:-1], "Expected 48 bytes, got 47 bytes"),
    ],
)
def test_a_broken_file_is_refused_in_one_sentence(tmp_path: Path, data: bytes, told: str) -> None:
    with pytest.raises(ConfigError) as error:
        read_nifti_volume(written(tmp_path, data))
    assert told in str(error.value) and "\n" not in str(error.value) and "head.nii" in str(error.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nothing\.nii: cannot be read"):
        read_nifti_volume(tmp_path / "nothing.nii")


def test_a_fifo_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "head.nii")
    with pytest.raises(ConfigError, match=r"head\.nii: cannot be read: .*found a FIFO, expected a file"):
        read_nifti_volume(tmp_path / "head.nii")


def value_at(read: MrVolume, point: Any) -> float:
    """Of the voxel nearest to a point (mm RAS)."""
    i, j, k = np.rint(np.linalg.solve(read.affine[:, :3], np.asarray(point) - read.affine[:, 3])).astype(int)
    return float(read.voxels[k, j, i])


def test_the_synthetic_head_has_its_layers_where_they_belong() -> None:
    head, brain = synthetic_head(), synthetic_head(brain_only=True)
    assert head.size == (64, 77, 64) and head.voxels.nbytes < 400_000
    right, left = value_at(head, LESION), value_at(head, LESION * (-1, 1, 1))
    assert right > 220 and left < 165, "the lesion is on the right"
    assert value_at(head, (11, -12, 18)) < 50 < value_at(head, (30, 10, 20)), "ventricle, white matter"
    assert value_at(head, (0, 78, 6)) > 150 and value_at(brain, (0, 78, 6)) == 0, "scalp"
    assert value_at(head, (0, 72, 6)) < 60, "skull"
    assert 0.1 < (brain.voxels > 60).mean() < 0.3


def test_the_synthetic_head_is_the_same_everywhere() -> None:
    digest = hashlib.sha256(synthetic_head(4.0).voxels.tobytes()).hexdigest()
    assert digest == "379f5df27766631a4d0453dba0cc8d8ded6b1f0b88151d834a9a6946d0a0a3af"


@pytest.mark.parametrize("spacing", [0.0, float("nan"), 1e-3, 50])
def test_a_spacing_that_makes_no_sense(spacing: float) -> None:
    with pytest.raises(ConfigError, match="spacing of the synthetic head"):
        synthetic_head(spacing)


def test_which_volume_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(volume.VARIABLE, raising=False)
    monkeypatch.setattr(volume, "_INSTALLED", tmp_path / "installed")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert find_volume() is None and head_volume(spacing_mm=10).source == "synthetic head, 10 mm"
    fetched = tmp_path / "cache/igtl_gateway/mri"
    for folder in (fetched, tmp_path / "installed", tmp_path / "mine"):
        folder.mkdir(parents=True)
        (folder / "ch2.nii.gz").write_bytes(gzip.compress(nifti(), mtime=0))
        monkeypatch.setenv(volume.VARIABLE, "" if folder.name != "mine" else str(folder))
        assert find_volume() == folder / "ch2.nii.gz"
    assert head_volume().source == "ch2.nii.gz"
    monkeypatch.setenv(volume.VARIABLE, str(written(tmp_path, nifti(), "other.nii")))
    assert head_volume().source == "other.nii"
    monkeypatch.setenv(volume.VARIABLE, "synthetic")
    assert find_volume() is None
    monkeypatch.setenv(volume.VARIABLE, str(tmp_path / "mine"))
    with pytest.raises(ConfigError, match=r"IGTL_GATEWAY_MRI: found .*mine, expected a folder with ch2bet"):
        find_volume("ch2bet")


def test_a_head_of_the_size_of_colin(tmp_path: Path) -> None:
    """Colin27 as Debian's mricron-data has it: 1 mm, packed, both codes of the space, a name of it, bytes."""
    size = (181, 217, 181)
    x, y, z = np.ogrid[-90:91, -125:92, -71:110]
    matter = ((x / 70) ** 2 + ((y + 18) / 90) ** 2 + ((z - 10) / 70) ** 2 < 1).astype("u1") * np.uint8(180)
    matter[np.abs(x[:, 0, 0]) < 3] //= 4  # between the hemispheres
    rows = (1, 0, 0, -90, 0, 1, 0, -125, 0, 0, 1, -71)
    header = nifti(
        code=2,
        dtype="u1",
        dim=(40, "8h", (3, *size, 1, 1, 1, 1)),
        pixdim=(76, "8f", (1, 1, 1, 1, 0, 0, 0, 0)),
        bits=(72, "h", (8,)),
        units=(123, "B", (10,)),
        description=(148, "80s", (b"Colin Holmes",)),
        codes=(252, "2h", (4, 4)),
        srow=(280, "12f", rows),
    )[:352]
    data = gzip.compress(header + matter.tobytes(order="F"), 1, mtime=0)
    head = read_nifti_volume(written(tmp_path, data, "ch2.nii.gz"))
    assert head.size == size and head.voxels.dtype == np.uint8
    assert head.affine.tolist() == [[1, 0, 0, -90], [0, 1, 0, -125], [0, 0, 1, -71]]
    assert value_at(head, (0, 0, 200 - 100)) < value_at(head, (25, -40, 30)), "white matter is bright"
