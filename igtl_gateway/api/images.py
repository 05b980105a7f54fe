"""Images with their geometry: views of pixels, and the matrix from pixel indices to the patient or the frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.display import as_array, html_line, shape_text
from igtl_gateway.api.placement import ImagePlacement
from igtl_gateway.api.source import Source
from igtl_gateway.base.errors import ConfigError, MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.images import pixel_layout
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.record.sessionfile.channels import ChannelSummary
from igtl_gateway.wire.image import SCALARS
from igtl_gateway.wire.image import Image as WireImage

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class ImageView:
    """An image or a volume; for numpy its ``array``.

    Attributes:
        array: pixels, a view on the recorded bytes: (slices, rows, columns), and a fourth axis for several components.
        matrix: (4, 4) float64: (column, row, slice, 1) of the pixel ``array[slice, row, column]`` → its centre.  Of
            OpenIGTLink in RAS, of ``igtl_msgs/Volume`` in ``frame``; None if the message has no valid geometry.
        spacing: distance of neighbouring pixels along columns, rows and slices; None without geometry.
        unit: unit of matrix and spacing.
        time: gateway time, UTC ns.
        source_time: the sender's stamp, UTC ns; 0 = unset.
        frame: ROS frame; ``""`` for OpenIGTLink.
        encoding: of ``sensor_msgs/Image``, such as ``"rgb8"``; ``""`` for others.
    """

    array: Array
    matrix: Array | None
    spacing: tuple[float, float, float] | None
    unit: str
    time: int
    source_time: int
    frame: str = ""
    encoding: str = ""

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> Array:
        return as_array(self.array, dtype, copy)

    def __repr__(self) -> str:
        spacing = f", {' × '.join(f'{each:.4g}' for each in self.spacing)} {self.unit}" if self.spacing else ""
        frame = f", {self.frame}" if self.frame else ""
        encoding = f", {self.encoding}" if self.encoding else ""
        return f"<ImageView: {shape_text(self.array)}{encoding}{spacing}{frame}>"

    def _repr_html_(self) -> str:
        return html_line(repr(self))

    @property
    def plane(self) -> Array:
        """The pixels of an image with one slice: (rows, columns), and a third axis for several components.

        Raises:
            ConfigError: there are several slices.
        """
        if self.array.shape[0] != 1:
            raise ConfigError(f"plane: found {counted(self.array.shape[0], 'slice')}, expected 1")
        plane: Array = self.array[0]
        return plane


class Images(Sequence[ImageView]):
    """The images of a stream; each one is decoded when it is used.

    Raises WireError, ConversionError or DamagedRecording for a damaged image, when it is used.
    """

    def __init__(self, source: Source, channel: ChannelSummary, unit: str, blocks: list[MessageBlock]) -> None:
        is_igtl = channel.kind in (Kind.IGTL_IN, Kind.IGTL_OUT)
        if (channel.entry_type != "IMAGE") if is_igtl else (channel.type not in (RosImage.TYPE, Volume.TYPE)):
            raise ConfigError(
                f"{channel.stream}: found type {channel.entry_type}, expected IMAGE, {RosImage.TYPE} or {Volume.TYPE}"
            )
        self._type, self._unit, self._name = channel.entry_type, unit, channel.stream or channel.topic
        self._blocks, self._acceptance = blocks, source.acceptance
        self._ends = np.cumsum([len(block) for block in blocks], dtype=np.int64)

    def __repr__(self) -> str:
        return f"<Images: {len(self):,} of {self._name}>"

    def _repr_html_(self) -> str:
        return html_line(repr(self))

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    @overload
    def __getitem__(self, index: int) -> ImageView: ...
    @overload
    def __getitem__(self, index: slice) -> list[ImageView]: ...
    def __getitem__(self, index: int | slice) -> ImageView | list[ImageView]:
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        block, row = find_row(self._blocks, self._ends, index)
        head = int(block.times[row]), int(block.source_times[row])
        payload = block.payload(row)
        if self._type == RosImage.TYPE:
            return _ros_image(RosImage.unpack(payload), self._unit, *head)
        if self._type == Volume.TYPE:
            return _volume(Volume.unpack(payload), self._unit, *head)
        content = self._acceptance.message(payload).content
        if not isinstance(content, WireImage):
            raise MalformedBody("IMAGE", "an empty body", "pixels")
        return _wire_image(content, self._unit, *head)


def find_row(blocks: list[MessageBlock], ends: npt.NDArray[np.int64], index: int) -> tuple[MessageBlock, int]:
    """Return block and row of a message by its index in the stream; ``ends``: last index of each block + 1.

    Raises IndexError.
    """
    count = int(ends[-1]) if len(ends) else 0
    place = index + count if index < 0 else index
    if not 0 <= place < count:
        raise IndexError(f"found index {index}, expected less than {count}")
    number = int(np.searchsorted(ends, place, side="right"))
    return blocks[number], place - (int(ends[number - 1]) if number else 0)


def _wire_image(image: WireImage, unit: str, time: int, source_time: int) -> ImageView:
    array = image.array
    placement = ImagePlacement.of_image(image)
    matrix = spacing = None
    if placement is not None:
        matrix = np.eye(4)
        matrix[:3, :3] = np.array(placement.axes).T
        # the first pixel of a part of an image is not that of the image
        matrix[:3, 3] = np.array(placement.origin) + matrix[:3, :3] @ np.array(image.subvol_offset)
        lengths = np.sqrt((matrix[:3, :3] ** 2).sum(axis=0))
        spacing = float(lengths[0]), float(lengths[1]), float(lengths[2])
    return ImageView(_without_single(array), matrix, spacing, unit, time, source_time)


def _volume(volume: Volume, unit: str, time: int, source_time: int) -> ImageView:
    dtype = np.dtype((">" if volume.is_bigendian else "<") + _scalar(volume.scalar_type))
    columns, rows, slices = volume.size
    array = _pixels(volume.data, dtype, (slices, rows, columns, volume.components))
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(volume.direction).reshape(3, 3).T * np.array(volume.spacing)
    matrix[:3, 3] = volume.origin
    spacing = float(volume.spacing[0]), float(volume.spacing[1]), float(volume.spacing[2])
    return ImageView(_without_single(array), matrix, spacing, unit, time, source_time, volume.header.frame_id)


def _ros_image(image: RosImage, unit: str, time: int, source_time: int) -> ImageView:
    scalar, components, _ = pixel_layout(image.encoding)
    dtype = np.dtype((">" if image.is_bigendian else "<") + SCALARS[scalar])
    row = image.width * components * dtype.itemsize
    data = np.frombuffer(image.data, np.uint8)
    if image.step < row or len(data) < image.step * image.height:
        raise MalformedBody(
            "sensor_msgs/Image",
            counted(len(data), "byte"),
            f"{counted(image.height, 'row')} of {counted(image.step, 'byte')}",
        )
    # rows with padding: numpy takes strides for a whole buffer only
    array: Array = np.ndarray(
        (1, image.height, image.width, components),
        dtype,
        data,
        strides=(image.step * image.height, image.step, components * dtype.itemsize, dtype.itemsize),
    )
    frame = image.header.frame_id
    return ImageView(_without_single(array), None, None, unit, time, source_time, frame, image.encoding)


def _pixels(data: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
    found, expected = memoryview(data).nbytes, int(np.prod(shape)) * dtype.itemsize
    if found != expected:
        raise MalformedBody("igtl_msgs/Volume", f"{counted(found, 'byte')} of pixels", counted(expected, "byte"))
    return np.frombuffer(data, dtype).reshape(shape)


def _scalar(scalar_type: int) -> str:
    if scalar_type not in SCALARS:
        raise MalformedBody("igtl_msgs/Volume", f"scalar type {scalar_type}", f"one of {sorted(SCALARS)}")
    return SCALARS[scalar_type]


def _without_single(array: Array) -> Array:
    """Drop the axis of the components if there is one component."""
    return array[..., 0] if array.shape[-1] == 1 else array
