"""Volumes that arrive in parts: IMAGE messages that cover a sub-volume, put into the whole that they belong to."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.errors import ConversionError
from igtl_gateway.wire.image import BIG_ENDIAN, SCALARS, Image

#: A peer that announces a volume of 65,535³ must not cost that much memory.
MAX_VOLUME_BYTES = 1 << 30

#: Parts that are kept as they came until a volume may be whole: real ones are sent slice by slice.
MAX_PARTS = 4_096
#: What a part costs beside its pixels, about.
_PART_BYTES = 1_024

#: Shape (k, j, i, components), and scalar type as numpy calls it.
Form = tuple[tuple[int, ...], str]


class VolumeAssembler:
    """The volume of one stream.

    A volume handed out never changes: each update is written into a copy of it, so that what was recorded or is
    on its way keeps its values.  As long as too little came to make a volume whole, its parts are kept as they are: a
    header that announces much costs nothing.

    Attributes:
        missing: voxels that no message has told yet; as long as that is not sure, as many as there are at least.
        held: bytes that are kept, about.
    """

    def __init__(self) -> None:
        self.missing = self.held = 0
        self._form: Form | None = None  # (k, j, i, components) and scalar type
        self._parts: list[Image] = []  # as long as there is no array
        self._whole: npt.NDArray[Any] | None = None  # in the byte order of its first message
        self._seen: npt.NDArray[np.bool_] | None = None  # None once all is

    def update(self, image: Image, room: int = 2 * MAX_VOLUME_BYTES) -> Image | None:
        """The whole image after a message; None as long as parts of it are missing.

        A message of another size, scalar type or number of components starts anew.  Geometry is that of the newest
        message.

        Args:
            image: whole, or a part.
            room: bytes that may be kept; a whole image beyond that passes, and is not kept for updates.

        Raises:
            ConversionError: a volume above MAX_VOLUME_BYTES, or parts of one for which there is no room.
        """
        form = form_of(image)
        shape, _ = form
        if image.sub_size == image.dimensions:
            pixels = memoryview(image.pixels)
            if pixels.nbytes <= room:
                self.keep(form, _dtype(image), pixels)
            else:
                self._begin(form)
            return image
        size = math.prod(shape) * _dtype(image).itemsize
        if size > MAX_VOLUME_BYTES:
            raise ConversionError(f"IMAGE: found a volume of {size} bytes, expected {MAX_VOLUME_BYTES} at most")
        if self._form != form:
            self._begin(form)
        voxels = math.prod(shape[:3])
        if self._whole is None:
            self._parts.append(image)
            self.missing -= math.prod(image.sub_size)
            self.held += memoryview(image.pixels).nbytes + _PART_BYTES
            whole = self.missing <= 0 or len(self._parts) > MAX_PARTS
            if (size + voxels if whole else self.held) > room:
                self._begin(None)
                raise ConversionError(
                    f"IMAGE: found parts of a volume of {size} bytes, expected {room} at most to keep"
                )
            if not whole:
                return None
            self._whole = np.zeros(shape, _dtype(self._parts[0]))
            self._seen, self.missing, self.held = np.zeros(shape[:3], np.bool_), voxels, size + voxels
            parts, self._parts = self._parts, []
        else:
            parts = [image]
            if self._seen is None:
                self._whole = self._whole.copy()
        for one in parts:
            self._put(one)
        if self.missing:
            return None
        if self._seen is not None:
            self._seen, self.held = None, size
        endian = image.endian if self._whole.dtype == _dtype(image) else 3 - image.endian
        pixels = self._whole.reshape(-1).view(np.uint8).data
        return replace(image, pixels=pixels, endian=endian, subvol_offset=(0, 0, 0), subvol_size=None)

    def takes(self, form: Form) -> bool:
        """Whether an image of a form is kept, so that there is room for a whole one in its place."""
        return self._form == form and self._whole is not None

    def keep(self, form: Form, dtype: np.dtype[Any], pixels: memoryview) -> None:
        """Have a whole image for later updates; by itself ``update`` with one, where ``takes`` is true."""
        self._begin(form)
        self._whole = np.frombuffer(pixels, dtype).reshape(form[0])
        self.missing, self.held = 0, pixels.nbytes

    def _begin(self, form: Form | None) -> None:
        """Forget what was, for a volume of this form."""
        self._form, self._parts, self._whole, self._seen = form, [], None, None
        self.missing, self.held = math.prod(form[0][:3]) if form else 0, 0

    def _put(self, image: Image) -> None:
        """Write a part into the array."""
        assert self._whole is not None
        (x, y, z), (nx, ny, nz) = image.subvol_offset, image.sub_size
        part = (slice(z, z + nz), slice(y, y + ny), slice(x, x + nx))
        self._whole[part] = image.array
        if self._seen is not None:
            seen = self._seen[part]
            self.missing -= seen.size - int(np.count_nonzero(seen))
            seen[...] = True


def form_of(image: Image) -> Form:
    """Of the whole that an image is, or is a part of."""
    i, j, k = image.dimensions
    return (k, j, i, image.num_components), SCALARS[image.scalar_type]


def _dtype(image: Image) -> np.dtype[Any]:
    return np.dtype((">" if image.endian == BIG_ENDIAN else "<") + SCALARS[image.scalar_type])
