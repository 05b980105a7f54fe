"""Images with a pose in the patient frame: planes, and volumes as three slices through their centre."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.igtl import SCALARS
from igtl_gateway.addon.ros import Volume
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.view.arrays import ColumnOf, image_of_pixels, textured_surface
from igtl_gateway.addons.view.canvas import Canvas
from igtl_gateway.addons.view.colours import span
from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.legend import box_sides, picture_sides
from igtl_gateway.addons.view.pictures2d import grey

Array = npt.NDArray[Any]

_COLOUR = (3, 4)
_MAX_STRETCH = 16  #: pixels with a larger aspect ratio are not stretched
_AIR = 12  #: pixels up to this brightness of 255 count as air
_TILES = 64  #: a slice is drawn in this number of tiles each way; empty tiles are left out
_QUAD = np.array([(0, 1, 2), (0, 2, 3)], np.uint32)
_CORNERS = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
#: Axis of the volume → the other two axes, in the order across, down.
_ACROSS = {0: [1, 2], 1: [0, 2], 2: [0, 1]}
_NAMES = "ijk"


def draw_volume(message: Volume, canvas: Canvas) -> None:
    """igtl_msgs/Volume: a slice as image and plane, a volume as tensor, image and three planes."""
    frame = canvas.frame(message.header.frame_id)
    voxels = array_of(message)
    corners = _corner(message, np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * message.size)
    canvas.box(corners)
    canvas.shown.width, canvas.shown.height = message.size[0], message.size[1]
    if len(voxels) == 1:
        canvas.set_kind(EntityKind.PLANE)
        x, y, z, u, v, w = message.direction[:6]
        canvas.shown.right, canvas.shown.up = (x, y, z), (-u, -v, -w)
        canvas.log(_picture(voxels[0]))
        canvas.log(_plane(message, voxels, 2, 0, None), child="plane", frame=frame)
        return
    canvas.set_kind(EntityKind.VOLUME)
    canvas.log(rr.Tensor(voxels[..., 0] if voxels.shape[3] == 1 else voxels, dim_names=_dimensions(voxels)))
    window = None if voxels.shape[3] in _COLOUR else span(_sample(voxels))
    middle = len(voxels) // 2
    across, down = _turn(message, 0), _turn(message, 1)
    upright = square(voxels[middle][::down, ::across], message.spacing[0], message.spacing[1])
    canvas.log(_picture(upright), child="slice")
    directions = np.array(message.direction).reshape(3, 3)
    height, width = upright.shape[:2]
    canvas.log(picture_sides(width, height, across * directions[0], down * directions[1]), child="slice/sides")
    canvas.log(box_sides(corners, directions), child="plane/sides", frame=frame)
    for axis in range(3):
        plane = _plane(message, voxels, axis, message.size[axis] // 2, window, air=True)
        canvas.log(plane, child=f"plane/{_NAMES[axis]}", frame=frame)


def array_of(message: Volume) -> Array:
    """Return voxels (slices, rows, columns, components) in native byte order.  Raises ConversionError."""
    code = SCALARS.get(message.scalar_type)
    width, height, depth = message.size
    if code is None:
        raise ConversionError(f"{message.TYPE}: found scalar type {message.scalar_type}, expected one of {[*SCALARS]}")
    dtype = np.dtype((">" if message.is_bigendian else "<") + code)
    count = width * height * depth * message.components
    if not count or memoryview(message.data).nbytes < count * dtype.itemsize:
        found = memoryview(message.data).nbytes
        raise ConversionError(
            f"{message.TYPE}: found {counted(found, 'byte')}, expected {count * dtype.itemsize}, more than 0"
        )
    flat = np.frombuffer(message.data, dtype, count).astype(dtype.newbyteorder("="), copy=False)
    return flat.reshape(depth, height, width, message.components)


def _dimensions(voxels: Array) -> list[str]:
    names = ["slice k", "row j", "column i", "component"]
    return names if voxels.shape[3] > 1 else names[:3]


def _picture(pixels: Array) -> list[ColumnOf]:
    if pixels.shape[2] in _COLOUR:
        return image_of_pixels(eight_bits(pixels, None), rr.ColorModel.RGB)
    return grey(pixels[..., 0])


def eight_bits(pixels: Array, window: tuple[float, float] | None) -> Array:
    """Return 8-bit colours (rows, columns, 3) of pixels with one, three or four components."""
    if pixels.dtype == np.uint8 and window is None:
        scaled = pixels
    else:
        low, high = window or span(_sample(pixels))
        spread = high - low or 1.0
        unit = (pixels.astype(np.float32) - np.float32(low)) * np.float32(255.0 / spread)
        scaled = np.nan_to_num(np.clip(unit, 0, 255)).astype(np.uint8)
    if scaled.shape[2] in _COLOUR:
        return np.ascontiguousarray(scaled[..., :3])
    return np.repeat(scaled[..., :1], 3, axis=2)


def square(pixels: Array, across_m: float, down_m: float) -> Array:
    """Repeat pixels that are not square until they are, along the longer side only."""
    if across_m > 0 and down_m > 0 and max(across_m, down_m) < _MAX_STRETCH * min(across_m, down_m):
        step = min(across_m, down_m)
        rows, columns = (
            (np.arange(max(round(count * each / step), 1)) * (step / each)).astype(np.intp).clip(max=count - 1)
            for count, each in zip(pixels.shape[:2], (down_m, across_m), strict=True)
        )
        pixels = pixels[rows][:, columns]
    return np.ascontiguousarray(pixels)


def _sample(pixels: Array) -> Array:
    return pixels.reshape(-1)[:: max(pixels.size // 100_000, 1)]


def _corner(message: Volume, indices: Array) -> Array:
    """Return positions of voxel corners (not centres): index 0 is half a voxel before the first centre."""
    direction = np.array(message.direction).reshape(3, 3)  # rows: directions of i, j, k
    steps = direction * np.array(message.spacing)[:, None]
    places: Array = np.array(message.origin) + (np.asarray(indices, np.float64) - 0.5) @ steps
    return places


def _plane(
    message: Volume, voxels: Array, axis: int, index: int, window: tuple[float, float] | None, *, air: bool = False
) -> list[ColumnOf]:
    """Return the slice ``index`` across ``axis`` (0 i, 1 j, 2 k) at its pose, as a textured surface.

    Args:
        air: leave out air, so that slices do not hide each other.
    """
    pixels = np.take(voxels, index, axis=2 - axis)  # rows: the slower of the other two axes
    if voxels.dtype == np.uint8 and voxels.shape[3] not in _COLOUR:
        window = None
    texture = eight_bits(pixels, window)
    size = np.array([message.size[each] for each in _ACROSS[axis]])
    tiles = _tiles(texture.max(axis=2) > _AIR) if air else np.empty((0, 4, 2), np.int64)
    if not len(tiles):
        tiles = _CORNERS[None] * size
    corners = np.full((len(tiles) * 4, 3), index + 0.5)
    corners[:, _ACROSS[axis]] = tiles.reshape(-1, 2)
    triangles = (np.arange(len(tiles))[:, None, None] * 4 + _QUAD).reshape(-1, 3)
    return textured_surface(_corner(message, corners), triangles, tiles.reshape(-1, 2) / size, texture)


def _tiles(seen: Array) -> Array:
    """Return the corners (n, 4, 2), column and row, of the tiles of an image that are not empty.

    The viewer does not draw transparent textures, so empty tiles are left out of the surface.
    """
    rows, columns = (
        np.unique(np.linspace(0, length, min(length, _TILES) + 1).astype(np.int64)) for length in seen.shape
    )
    there = np.add.reduceat(np.add.reduceat(seen, rows[:-1], axis=0, dtype=np.int64), columns[:-1], axis=1) > 0
    row, column = np.nonzero(there)
    left, right, top, bottom = columns[column], columns[column + 1], rows[row], rows[row + 1]
    corners = ((left, top), (right, top), (right, bottom), (left, bottom))
    tiles: Array = np.stack([np.stack(corner, axis=-1) for corner in corners], axis=1)
    return tiles


def _turn(message: Volume, axis: int) -> int:
    """Return −1 for an axis of the slice that must be flipped for the radiological view, else 1.

    That view has the left of the patient at the right, and the head or the nose up.  The frame of the header is right,
    anterior, superior, so columns run to the left, rows to the back or downwards.
    """
    direction = np.array(message.direction).reshape(3, 3)[axis]
    return -1 if direction[int(np.argmax(np.abs(direction)))] > 0 else 1
