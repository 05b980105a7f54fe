"""HDF5 files of ITK: what SimpleITK writes is read, number by number; damage anywhere is one error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addon import DamagedRecording, GatewayError, UnsupportedRecording
from igtl_gateway.addons.exchange.itk_hdf5 import HDF5, read_hdf5
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from tests.tables import table

SimpleITK = pytest.importorskip("SimpleITK", reason="SimpleITK writes the files")


def affine(numbers: list[float], centre: list[float]) -> Any:
    transform = SimpleITK.AffineTransform(3)
    transform.SetParameters(numbers)
    transform.SetFixedParameters(centre)
    return transform


def written(path: Path, transform: Any) -> Path:
    SimpleITK.WriteTransform(transform, str(path))
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A composite transform of two."""
    both = SimpleITK.CompositeTransform(3)
    both.AddTransform(affine([1, 0, 0, 0, 1, 0, 0, 0, 1, 10, 20, 30], [0, 0, 0]))
    both.AddTransform(SimpleITK.TranslationTransform(3, (1.0, 2.0, 3.0)))
    return written(tmp_path_factory.mktemp("itk") / "a.h5", both).read_bytes()


_numbers = st.floats(-1e6, 1e6, allow_subnormal=False)


@given(st.lists(_numbers, min_size=12, max_size=12), st.lists(_numbers, min_size=3, max_size=3))
def test_numbers_are_read_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, numbers: list[float], centre: list[float]
) -> None:
    path = tmp_path_factory.mktemp("itk") / "a.h5"
    ((name, parameters, fixed),) = read_hdf5(written(path, affine(numbers, centre)))
    assert name == "AffineTransform_double_3_3"
    assert (parameters, fixed) == (numbers, centre)


def test_transforms_are_in_the_order_of_their_numbers(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(data)
    found = read_hdf5(tmp_path / "a.h5")
    assert [name.split("_")[0] for name, _, _ in found] == [
        "CompositeTransform", "AffineTransform", "TranslationTransform",
    ]  # fmt: skip
    assert found[1][1][9:] == [10.0, 20.0, 30.0] and found[2][1] == [1.0, 2.0, 3.0]


def test_long_lists_are_not_read(tmp_path: Path) -> None:
    """A grid is refused by its name: its numbers do not matter."""
    grid = SimpleITK.DisplacementFieldTransform(SimpleITK.Image([6, 6, 6], SimpleITK.sitkVectorFloat64, 3))
    found = read_hdf5(written(tmp_path / "a.h5", grid))
    assert [(name.split("_")[0], parameters) for name, parameters, _ in found] == [("DisplacementFieldTransform", [])]


def test_what_else_is_in_a_file_is_passed_over(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(data + bytes(1000))
    assert len(read_hdf5(tmp_path / "a.h5")) == 3


@table(
    ("old", "new", "error", "reason"),
    [
        (
            b"TransformGroup",
            b"TransformGroop",
            UnsupportedRecording,
            "expected transforms of ITK; kinematics need a recipe",
        ),
        (b"TransformType", b"TransformTipe", DamagedRecording, "transform 0: found no TransformType, expected one"),
        (b"GCOL\x01", b"GCOL\x02", DamagedRecording, "found no global heap, expected one"),
        (b"OHDR\x02", b"OHDR\x01", UnsupportedRecording, "expected an object header of version 2 as of ITK"),
    ],
)
def test_what_is_not_of_itk(
    old: bytes, new: bytes, error: type[GatewayError], reason: str, data: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(data.replace(old, new))
    with pytest.raises(GatewayError) as raised:
        read_hdf5(path)
    assert type(raised.value) is error and reason in str(raised.value) and str(path) in str(raised.value)


@table("version", [0, 1, 4])
def test_other_superblocks_are_refused(version: int, data: bytes, tmp_path: Path) -> None:
    assert data.startswith(HDF5) and data[8] in (2, 3)
    (tmp_path / "a.h5").write_bytes(data[:8] + bytes([version]) + data[9:])
    with pytest.raises(UnsupportedRecording, match=f"superblock: found version {version}, expected 2 or 3 as of ITK"):
        read_hdf5(tmp_path / "a.h5")


def test_every_length_is_read_or_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    for size in range(0, len(data), 97):
        path.write_bytes(data[:size])
        with pytest.raises(GatewayError) as error:
            read_hdf5(path)
        assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_damage_anywhere_is_one_error_or_other_numbers(data: bytes, tmp_path: Path) -> None:
    path, random = tmp_path / "a.h5", np.random.default_rng(5)
    for _ in range(400):
        changed = bytearray(data)
        for place in random.integers(0, len(data), int(random.integers(1, 4))).tolist():
            changed[place] = int(random.integers(0, 256))
        path.write_bytes(changed)
        try:
            found = read_hdf5(path)
        except GatewayError as error:
            assert str(path) in str(error) and "\n" not in str(error)
        else:
            assert all(len(parameters) <= 64 for _, parameters, _ in found)


def test_transforms_are_bounded(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(data)
    with limits_in_force(FileLimits(fields=2)), pytest.raises(GatewayError):
        read_hdf5(tmp_path / "a.h5")
