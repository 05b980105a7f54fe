"""Geometry in and out, with SimpleITK as referee: every orientation within a micrometre."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.addons.exchange.volume_out import nrrd_header
from igtl_gateway.api.placement import ImagePlacement, has_own_normal, normal
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.wire.image import LPS, RAS, Image
from tests.addons.exchange.itk import (
    MICROMETRE,
    OBLIQUE,
    Array,
    corners,
    images_of,
    itk_corners,
    orientations,
    orthonormal,
    read,
    sitk,
)

SIZE, SPACING, ORIGIN = (5, 4, 3), (0.7, 1.3, 2.9), (-87.25, 133.5, 41.125)
DIRECTIONS = [*orientations(), *(orthonormal(OBLIQUE @ matrix) for matrix in orientations()[::6])]


@pytest.mark.parametrize("suffix", ["mha", "mhd", "nrrd", "nhdr"])
def test_a_volume_of_itk_comes_in_where_itk_puts_it(tmp_path: Path, suffix: str) -> None:
    itk = sitk()
    for number, direction in enumerate(DIRECTIONS):
        image = itk.GetImageFromArray(np.arange(60, dtype=np.uint8).reshape(3, 4, 5))
        image.SetSpacing(SPACING)
        image.SetOrigin(ORIGIN)
        image.SetDirection(direction.ravel().tolist())
        path = tmp_path / f"{number}.{suffix}"
        itk.WriteImage(image, str(path))
        (found,) = images_of(path)
        assert found.dimensions == SIZE
        assert np.abs(corners(found) - itk_corners(image, SIZE)).max() < MICROMETRE
        assert bytes(found.pixels) == bytes(range(60))


@pytest.mark.parametrize("suffix", ["mha", "nrrd"])
def test_a_slice_of_itk_comes_in_where_itk_puts_it(tmp_path: Path, suffix: str) -> None:
    itk = sitk()
    turn = math.radians(33)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    for number, flip in enumerate((np.eye(2), np.diag([-1.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]]))):
        image = itk.GetImageFromArray(np.arange(12, dtype=np.int16).reshape(3, 4))
        image.SetSpacing(SPACING[:2])
        image.SetOrigin(ORIGIN[:2])
        image.SetDirection((rotation @ flip).ravel().tolist())
        path = tmp_path / f"{number}.{suffix}"
        itk.WriteImage(image, str(path))
        (found,) = images_of(path)
        assert found.dimensions == (4, 3, 1)
        assert np.abs(corners(found) - itk_corners(image, (4, 3, 1))).max() < MICROMETRE


@pytest.mark.parametrize("coordinate", [RAS, LPS])
def test_an_image_goes_out_to_nrrd_where_it_was(tmp_path: Path, coordinate: int) -> None:
    for direction in DIRECTIONS:
        image = placed(direction, coordinate)
        path = tmp_path / "some.nrrd"
        path.write_bytes(nrrd_header(image) + bytes(image.pixels))
        assert np.abs(corners(image) - itk_corners(read(path), SIZE)).max() < MICROMETRE
        (again,) = images_of(path)
        assert np.abs(corners(image) - corners(again)).max() < MICROMETRE


def placed(direction: Array, coordinate: int = RAS) -> Image:
    columns = (direction * SPACING).T
    numbers = np.array([*columns.ravel(), *ORIGIN], np.float32)
    return Image(SIZE, 3, bytes(range(60)), coordinate=coordinate, wire_matrix=tuple(numbers.tolist()))


@pytest.mark.parametrize("space", ["RAS", "LAS", "LPS"])
def test_a_space_turns_there_and_back(space: str) -> None:
    axes = [(1.0, 2.0, 3.0), (-2.0, 1.0, 0.0), (0.5, 0.0, 4.0)]
    place = ImagePlacement.of_file(axes, (10.0, 20.0, 30.0), space, "here")
    assert place.in_space(space) == (tuple(axes), (10.0, 20.0, 30.0))


@pytest.mark.parametrize(
    "axes",
    [
        [(1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 1.0)],
        [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)],
        [(math.nan, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)],
        [(math.inf, 0.0, 0.0), (0.0, 1.0, 0.0)],
        [(1.0, 1.0), (2.0, 2.0)],
        [(1e39, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)],
    ],
)
def test_axes_that_place_nothing_are_refused(axes: list[tuple[float, ...]]) -> None:
    with pytest.raises(DamagedRecording, match="here: found axes"):
        ImagePlacement.of_file(axes, (0.0, 0.0, 0.0), "RAS", "here")


def test_a_place_beyond_float32_is_refused() -> None:
    place = ImagePlacement.of_file([(3e38, 0.0, 0.0), (0.0, 1.0, 0.0)], (0.0, 0.0, 0.0), "RAS", "here")
    with pytest.raises(DamagedRecording, match="float32"):
        place.wire_matrix((9, 1, 1), "here")


def test_a_slice_without_a_third_axis_gets_its_normal() -> None:
    flat = Image((4, 3, 1), 3, bytes(12), wire_matrix=(2.0, 0, 0, 0, 0, 3.0, 0, 0, 0, 1, 2, 3))
    place = ImagePlacement.of_image(flat)
    assert place is not None
    assert place.axes[2] == (0.0, -1.0, 0.0) == normal(place.axes[0], place.axes[1])
    assert not has_own_normal(flat)
    assert has_own_normal(placed(np.eye(3)))


@pytest.mark.parametrize(
    ("matrix", "slices"),
    [
        ((math.nan, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0), 1),
        ((1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0), 2),
        ((1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0), 1),
        ((0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0), 1),
        ((1, 0, 0, 0, 1, 0, 0, 0, 1, math.inf, 0, 0), 1),
    ],
)
def test_a_matrix_that_is_no_place(matrix: tuple[float, ...], slices: int) -> None:
    assert ImagePlacement.of_image(Image((4, 3, slices), 3, bytes(12 * slices), wire_matrix=matrix)) is None
