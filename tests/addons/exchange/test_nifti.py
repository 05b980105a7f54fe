"""NIfTI volumes: nibabel writes them, nibabel and SimpleITK give their position."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.nifti import read_nifti
from igtl_gateway.addons.exchange.sequence import DEFAULT_EPOCH_NS, Sequence
from igtl_gateway.base.errors import DamagedRecording, Unavailable, UnsupportedRecording
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.wire.image import SCALARS
from tests.addons.exchange.itk import (
    MICROMETRE,
    OBLIQUE,
    corners,
    images_of,
    itk_corners,
    orientations,
    orthonormal,
    read,
    sitk,
)
from tests.tables import table

nib: Any = pytest.importorskip("nibabel", reason="nibabel writes the files")
SIZE = (5, 4, 3)


def affine_of(direction: Any) -> Any:
    affine = np.eye(4)
    affine[:3, :3] = direction * (0.7, 1.3, 2.9)
    affine[:3, 3] = (-87.25, 133.5, 41.125)
    return affine


def saved(path: Path, data: Any, affine: Any, **header: Any) -> Path:
    image = nib.Nifti1Image(data, affine)
    for key, value in header.items():
        image.header[key] = value
    nib.save(image, path)
    return path


def notes_of(path: Path) -> list[str]:
    with closing(open_source(path)) as source:
        return source.notes


def test_every_orientation_is_that_of_itk(tmp_path: Path) -> None:
    data = np.arange(60, dtype=np.int16).reshape(SIZE)
    for direction in [*orientations(), *(orthonormal(OBLIQUE @ matrix) for matrix in orientations()[::8])]:
        path = saved(tmp_path / "some.nii", data, affine_of(direction))
        (image,) = images_of(path)
        assert np.abs(corners(image) - itk_corners(read(path), SIZE)).max() < 5 * MICROMETRE  # qform is float32
        assert np.array_equal(image.array[..., 0].transpose(2, 1, 0), data)
        first = (np.array(image.wire_matrix[9:]) - affine_of(direction) @ [2, 1.5, 1, 1] @ np.eye(4, 3))[:3]
        assert np.abs(first).max() < MICROMETRE


def test_qform_counts_without_sform_and_a_difference_is_noted(tmp_path: Path) -> None:
    data, one, other = np.zeros(SIZE, np.uint8), affine_of(np.eye(3)), affine_of(np.diag([-1.0, -1.0, 1.0]))
    image = nib.Nifti1Image(data, one)
    image.set_sform(one, 2)
    image.set_qform(other, 1)
    nib.save(image, tmp_path / "both.nii.gz")
    assert images_of(tmp_path / "both.nii.gz")[0].wire_matrix[0] == pytest.approx(0.7)
    assert any("sform and qform differ" in note for note in notes_of(tmp_path / "both.nii.gz"))
    image.set_sform(one, 0)
    nib.save(image, tmp_path / "one.nii.gz")
    assert images_of(tmp_path / "one.nii.gz")[0].wire_matrix[0] == pytest.approx(-0.7)
    assert notes_of(tmp_path / "one.nii.gz") == []


def test_without_both_it_lies_where_itk_puts_it(tmp_path: Path) -> None:
    image = nib.Nifti1Image(np.zeros(SIZE, np.uint8), None)
    image.header["pixdim"][1:4] = (1, 2, 3)
    nib.save(image, tmp_path / "some.nii")
    found = images_of(tmp_path / "some.nii")[0]
    assert np.abs(corners(found) - itk_corners(read(tmp_path / "some.nii"), SIZE)).max() < MICROMETRE
    assert any("neither sform nor qform" in note for note in notes_of(tmp_path / "some.nii"))


@table("scalar", SCALARS.values())
@table("version", [1, 2])
@table("order", ["<", ">"])
def test_every_type_of_both_versions_and_orders(tmp_path: Path, scalar: str, version: int, order: str) -> None:
    kind = nib.Nifti1Image if version == 1 else nib.Nifti2Image
    values = np.arange(60).reshape(SIZE).astype(order + scalar)
    image = kind(values, affine_of(np.eye(3)), kind.header_class(endianness="little" if order == "<" else "big"))
    image.set_data_dtype(values.dtype)
    nib.save(image, tmp_path / "some.nii.gz")
    (found,) = images_of(tmp_path / "some.nii.gz")
    assert np.array_equal(found.array[..., 0].transpose(2, 1, 0), values)


def test_volumes_over_time_and_their_units(tmp_path: Path) -> None:
    image = nib.Nifti1Image(np.arange(120, dtype=np.int16).reshape(*SIZE, 2), affine_of(np.eye(3)))
    image.header.set_zooms((0.7, 1.3, 2.9, 250.0))
    image.header.set_xyzt_units("micron", "msec")
    nib.save(image, tmp_path / "some.nii.gz")
    with closing(open_source(tmp_path / "some.nii.gz")) as source:
        items = [item for item in source.items() if item.kind is Kind.IGTL_IN]
    assert [item.source_ns - DEFAULT_EPOCH_NS for item in items] == [0, 250_000_000]
    first, second = images_of(tmp_path / "some.nii.gz")
    assert first.wire_matrix[0] == pytest.approx(0.7e-3)
    assert np.array_equal(second.array[..., 0].transpose(2, 1, 0), np.arange(120).reshape(*SIZE, 2)[..., 1])


def test_vectors_and_colours_of_itk(tmp_path: Path) -> None:
    itk = sitk()
    values = np.arange(180, dtype=np.float32).reshape(3, 4, 5, 3)
    itk.WriteImage(itk.GetImageFromArray(values, isVector=True), str(tmp_path / "vector.nii.gz"))
    assert np.array_equal(images_of(tmp_path / "vector.nii.gz")[0].array, values)
    rgb = np.zeros(SIZE, np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")]))
    rgb["G"] = np.arange(60).reshape(SIZE)
    saved(tmp_path / "rgb.nii", rgb, affine_of(np.eye(3)))
    (found,) = images_of(tmp_path / "rgb.nii")
    assert np.array_equal(found.array[..., 1].transpose(2, 1, 0), rgb["G"])
    saved(tmp_path / "complex.nii", np.full(SIZE, 1 + 2j, np.complex64), affine_of(np.eye(3)))
    assert images_of(tmp_path / "complex.nii")[0].array[0, 0, 0].tolist() == [1.0, 2.0]


def test_scaling_is_noted(tmp_path: Path) -> None:
    image = nib.Nifti1Image(np.zeros(SIZE, np.int16), affine_of(np.eye(3)))
    image.header.set_slope_inter(2.0, 5.0)
    nib.save(image, tmp_path / "some.nii")
    assert any("scl_slope 2 and scl_inter 5" in note for note in notes_of(tmp_path / "some.nii"))


def test_without_nibabel_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path / "some.nii.gz", np.zeros(SIZE, np.uint8), affine_of(np.eye(3)))
    monkeypatch.setitem(sys.modules, "nibabel.nifti1", None)
    with pytest.raises(Unavailable, match=r'pip install "igtl-gateway\[nifti\]"'):
        open_source(path)


@table(
    ("offset", "value", "text"),
    [(256, np.inf, r"quatern inf 0 0 and pixdim\[0\] 1"), (76, 3, r"quatern 0 0 0 and pixdim\[0\] 3")],
)
def test_a_qform_that_is_no_rotation_is_named(tmp_path: Path, offset: int, value: float, text: str) -> None:
    image = nib.Nifti1Image(np.zeros(SIZE, np.uint8), affine_of(np.eye(3)))
    image.set_sform(None, 0)
    image.set_qform(affine_of(np.eye(3)), 1)
    nib.save(image, tmp_path / "some.nii")
    bent = bytearray((tmp_path / "some.nii").read_bytes())
    bent[offset : offset + 4] = np.float32(value).tobytes()
    (tmp_path / "some.nii").write_bytes(bent)
    with pytest.raises(DamagedRecording, match=f"qform: found {text}, expected a rotation, and 1, -1 or 0"):
        open_source(tmp_path / "some.nii")


def test_a_qfac_of_0_means_1(tmp_path: Path) -> None:
    """nifti1.h; ITK agrees."""
    data = np.arange(60, dtype=np.int16).reshape(SIZE)
    image = nib.Nifti1Image(data, affine_of(orthonormal(OBLIQUE)))
    image.set_sform(None, 0)
    image.set_qform(affine_of(orthonormal(OBLIQUE)), 1)
    nib.save(image, tmp_path / "some.nii")
    bent = bytearray((tmp_path / "some.nii").read_bytes())
    assert np.frombuffer(bent[76:80], np.float32) == 1
    bent[76:80] = bytes(4)
    (tmp_path / "some.nii").write_bytes(bent)
    (one,) = images_of(tmp_path / "some.nii")
    assert np.abs(corners(one) - itk_corners(read(tmp_path / "some.nii"), SIZE)).max() < 5 * MICROMETRE


@pytest.mark.parametrize(("code", "seconds"), [(8, 3000.0), (16, 3.0), (24, 0.003)])
def test_the_first_frame_has_the_time_of_toffset(tmp_path: Path, code: int, seconds: float) -> None:
    path = saved(tmp_path / "some.nii", np.zeros((2, 3, 1, 4), np.uint8), np.eye(4), toffset=3000, xyzt_units=2 | code)
    bent = bytearray(path.read_bytes())
    bent[92:96] = np.float32(2000 if code == 16 else 2).tobytes()
    path.write_bytes(bent)
    with closing(open_source(path)) as source:
        first = next(item.time_ns for item in source.items() if item.kind is Kind.IGTL_IN)
    assert first - DEFAULT_EPOCH_NS == round(seconds * 1e9)


@table(
    ("offset", "data", "text"),
    [
        (40, b"\x00\x00", "expected 2 … 7"),
        (40, b"\x09\x00", "expected 2 … 7"),
        (42, b"\xff\xff", "expected 0 or more"),
        (70, b"\x01\x00", "datatype: found 1"),
        (70, b"\xff\x7f", "datatype"),
        (108, np.float32(np.nan).tobytes(), "vox_offset"),
        (108, np.float32(1e30).tobytes(), "vox_offset"),
        (280, np.float32(np.nan).tobytes(), "finite"),
        (0, b"\x00\x00\x00\x00", "sizeof_hdr"),
        (344, b"ni1\0", "a pair"),
        (42, b"\xff\x7f", "found 240 bytes of pixels|bytes of pixels"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, offset: int, data: bytes, text: str) -> None:
    path = saved(tmp_path / "some.nii", np.zeros(SIZE, np.uint8), affine_of(np.eye(3)))
    bent = bytearray(path.read_bytes())
    bent[offset : offset + len(data)] = data
    path.write_bytes(bent)
    with pytest.raises((DamagedRecording, UnsupportedRecording), match=text):
        list(Sequence(path, None, read_nifti).items())
