"""Planes and volumes lie at the place that their geometry gives, and pictures of them are the right way up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.volumes import square
from igtl_gateway.convert.geometry import IDENTITY
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.rosmsg import Header

from .conftest import Draw

HEADER = Header(0, "patient")
TURNED = (0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0)  # i along y, j along z, k along x
SPACING, ORIGIN = (0.001, 0.002, 0.003), (0.1, 0.2, 0.3)


def volume(voxels: np.ndarray[Any, Any], direction: tuple[float, ...] = IDENTITY, *, big: bool = False) -> Volume:
    """Of an array (slices, rows, columns, components)."""
    codes = {"i1": 2, "u1": 3, "i2": 4, "u2": 5, "i4": 6, "u4": 7, "f4": 10, "f8": 11}
    depth, height, width, components = voxels.shape
    data = voxels.astype(voxels.dtype.newbyteorder(">" if big else "<")).tobytes()
    code = codes[voxels.dtype.str[1:]]
    return Volume(HEADER, (width, height, depth), code, components, big, 1, direction, SPACING, ORIGIN, data)


def test_a_slice_lies_as_a_plane_with_its_picture(draw: Draw) -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(1, 3, 4, 1)
    drawn = draw(volume(pixels, TURNED))
    plane = drawn.one("topic/plane")
    half = np.array(SPACING) / 2
    first = np.array(ORIGIN) - (0, half[0], half[1])
    across, down = np.array([0, 0.004, 0]), np.array([0, 0, 0.006])
    # corners: first pixel, end of the first row, last pixel, end of the first column
    np.testing.assert_allclose(
        plane["Mesh3D:vertex_positions"],
        [first, first + across, first + across + down, first + down],
        atol=1e-6,
    )
    assert plane["Mesh3D:vertex_texcoords"] == [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    assert plane["CoordinateFrame:frame"] == ["patient"]
    assert list(plane["Mesh3D:albedo_texture_buffer"][0]) == list(np.repeat(np.arange(12), 3))
    assert list(drawn.one("topic")["Image:buffer"][0]) == list(range(12))
    assert drawn.view.seen.shown["/topic"].what is EntityKind.PLANE


@pytest.mark.parametrize("big", [False, True], ids=["little", "big"])
@pytest.mark.parametrize("kind", ["u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"])
def test_a_volume_is_a_tensor_and_three_planes(kind: str, big: bool, draw: Draw) -> None:
    voxels = np.arange(24).reshape(2, 3, 4, 1).astype(kind)
    drawn = draw(volume(voxels, big=big))
    assert drawn.view.seen.shown["/topic"].what is EntityKind.VOLUME
    (tensor,) = drawn.one("topic")["Tensor:data"]
    assert [*tensor["shape"]] == [2, 3, 4]
    textures = {axis: drawn.one(f"topic/plane/{axis}")["Mesh3D:albedo_texture_format"][0] for axis in "ijk"}
    sizes = {axis: (form["height"], form["width"]) for axis, form in textures.items()}
    assert sizes == {"i": (2, 3), "j": (2, 4), "k": (3, 4)}
    corners = np.array(drawn.one("topic/plane/k")["Mesh3D:vertex_positions"])
    np.testing.assert_allclose(corners[:, 2], ORIGIN[2] + SPACING[2], atol=1e-6)  # through the middle of slice 1


@pytest.mark.parametrize(
    ("direction", "turned"),
    [
        ((-1.0, 0, 0, 0, -1, 0, 0, 0, 1), lambda slice_: slice_),  # left and back, as DICOM has it
        (IDENTITY, lambda slice_: slice_[::-1, ::-1]),  # to the right and to the front
        ((0.0, -1, 0, 0, 0, -1, 1, 0, 0), lambda slice_: slice_),  # sagittal: to the back, downwards
        ((0.0, -1, 0, 0, 0, 1, 1, 0, 0), lambda slice_: slice_[::-1]),  # upwards
    ],
)
def test_the_picture_of_a_slice_has_left_at_the_right_and_front_or_head_up(
    direction: tuple[float, ...], turned: Any, draw: Draw
) -> None:
    voxels = np.arange(24, dtype=np.uint8).reshape(2, 3, 4, 1)
    row = draw(volume(voxels, direction)).one("topic/slice")
    shown = np.array(row["Image:buffer"][0]).reshape(6, 4)  # rows are twice as far apart as columns
    np.testing.assert_array_equal(shown, turned(voxels[1, :, :, 0]).repeat(2, axis=0))


def test_colours_of_a_plane(draw: Draw) -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(1, 2, 3, 4)
    texture = draw(volume(pixels)).one("topic/plane")["Mesh3D:albedo_texture_buffer"][0]
    np.testing.assert_array_equal(np.array(texture).reshape(2, 3, 3), pixels[0, ..., :3])


def test_the_brightest_of_sixteen_bits_is_white(draw: Draw) -> None:
    voxels = np.linspace(-1000, 3000, 24).astype(np.int16).reshape(1, 4, 6, 1)
    texture = np.array(draw(volume(voxels)).one("topic/plane")["Mesh3D:albedo_texture_buffer"][0])
    assert (texture[0], texture[-1]) == (0, 255)


def test_a_volume_without_its_voxels_costs_itself(draw: Draw) -> None:
    whole = volume(np.zeros((1, 2, 2, 1), np.uint8))
    cut = Volume(HEADER, (9, 9, 9), 3, 1, False, 1, IDENTITY, SPACING, ORIGIN, b"xx")
    drawn = draw(whole, cut)
    assert (drawn.count("topic"), drawn.view.counts.refused) == (2, {"/topic": 1})


@pytest.mark.parametrize(
    ("across", "down", "shape"),
    [(1.0, 1.0, (3, 4)), (2.0, 1.0, (3, 8)), (1.0, 1.5, (4, 4)), (1.0, 1000.0, (3, 4)), (0.0, 1.0, (3, 4))],
)
def test_pixels_become_square(across: float, down: float, shape: tuple[int, int]) -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    made = square(pixels, across, down)
    assert made.shape == shape
    assert (made[0, 0], made[-1, -1]) == (0, 11)
    assert set(made.reshape(-1)) == set(range(12))
