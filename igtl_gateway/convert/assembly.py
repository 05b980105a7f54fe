"""Assembly of volumes: IMAGE messages that cover only a sub-volume are collected into the whole volume."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.wire.image import SCALARS, Image

#: Limit for announced volumes: a header can announce 65,535³ voxels.
MAX_VOLUME_BYTES = 1 << 30

#: Maximum number of parts stored before an array is allocated; senders usually send one part per slice.
MAX_PARTS = 4_096
#: Approximate memory of a part besides its pixels.
_PART_BYTES = 1_024

#: Shape (k, j, i, components), and numpy name of the scalar type.
Form = tuple[tuple[int, ...], str]


@dataclass(frozen=True, slots=True)
class ForeseenVolume:
    """What a part makes of a volume, before it is its turn.

    Attributes:
        image: the part.
        whole: the whole image.
        pixels: its array.
        state: of the assembler from which it was made.
        needs: bytes for it, while its parts are put together; 0: no more than before.
    """

    image: Image
    whole: Image
    pixels: npt.NDArray[Any]
    state: int
    needs: int = 0


class VolumeAssembler:
    """The volume of one stream.

    A returned volume never changes: each update is written into a copy, so recorded and queued messages keep their
    values.  Until the received parts could cover the volume, they are stored as received, so a header that announces
    a large volume costs no memory.

    Attributes:
        missing: voxels that no message has covered yet.  While parts are stored, overlaps are not known: a lower bound.
        held: approximate number of stored bytes.
        used: number of the last entry with a message of it, for those who choose what to forget.
    """

    def __init__(self) -> None:
        self.missing = self.held = self.used = 0
        self._forgotten: Form | None = None  # of a whole image that was forgotten
        self._is_base = False  # a whole image came as one message
        self._form: Form | None = None
        self._parts: list[Image] = []  # until the array is allocated
        self._whole: npt.NDArray[Any] | None = None  # byte order of the first message
        self._seen: npt.NDArray[np.bool_] | None = None  # None when all voxels are covered
        self._state = 0  # increases before and after each change

    def foreseen(self, image: Image) -> ForeseenVolume | None:
        """Return what ``update`` would make of a part that gives a whole volume, and change nothing.

        From any thread.  None for all else: a whole image, and a part of a volume that still lacks others.
        """
        state, whole, seen, parts, missing = self._state, self._whole, self._seen, [*self._parts], self.missing
        if image.sub_size == image.dimensions or self._form != form_of(image):
            return None
        shape, _ = form_of(image)
        voxels = math.prod(shape[:3])
        size = voxels * shape[3] * image.dtype.itemsize
        if size > MAX_VOLUME_BYTES or state != self._state:
            return None
        new = math.prod(image.sub_size)
        if whole is None:
            if missing > new:
                return None
            parts.append(image)
            seen = np.zeros(shape[:3], np.bool_)
            if sum(_cover(seen, one) for one in parts) < voxels:
                return None
        else:
            parts = [image]
            if seen is not None and missing > (new - int(np.count_nonzero(seen[_place_of(image)]))):
                return None
        pixels = np.zeros(shape, parts[0].dtype) if whole is None else whole.copy()
        for one in parts:
            pixels[_place_of(one)] = one.array
        if state != self._state:
            return None
        return ForeseenVolume(image, _image_of(image, pixels), pixels, state, 0 if whole is not None else size + voxels)

    def update(
        self, image: Image, room: int = 2 * MAX_VOLUME_BYTES, foreseen: ForeseenVolume | None = None
    ) -> Image | None:
        """Add a message; return the whole image, or None while parts of it are missing.

        A message with another size, scalar type or number of components starts a new volume.  The geometry is that
        of the newest message.

        Args:
            image: a whole image or a part of one.
            room: bytes that may be stored.  A larger whole image is returned, but not stored for updates.
            foreseen: result of that for this image, used if nothing has changed since.

        Raises:
            ConversionError: the volume exceeds MAX_VOLUME_BYTES, or its parts exceed ``room``.
        """
        if foreseen and foreseen.image is image and foreseen.state == self._state and foreseen.needs <= room:
            self._state += 1
            if self._whole is None or self._seen is not None:  # complete now
                self.missing, self.held = 0, foreseen.pixels.nbytes
            self._whole, self._seen, self._parts = foreseen.pixels, None, []
            self._state += 1
            return foreseen.whole
        self._state += 1
        try:
            return self._updated(image, room)
        finally:
            self._state += 1

    def _updated(self, image: Image, room: int) -> Image | None:
        form = form_of(image)
        shape, _ = form
        if image.sub_size == image.dimensions:
            pixels = memoryview(image.pixels)
            if pixels.nbytes <= room:
                self.keep(form, image.dtype, pixels)
            else:
                self._begin(form)
            return image
        size = math.prod(shape) * image.dtype.itemsize
        if size > MAX_VOLUME_BYTES:
            raise ConversionError(
                f"IMAGE: found a volume of {counted(size, 'byte')}, expected {MAX_VOLUME_BYTES} at most"
            )
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
                    f"IMAGE: found parts of a volume of {counted(size, 'byte')}, expected {room} at most to keep"
                )
            if not whole:
                return None
            self._whole = np.zeros(shape, self._parts[0].dtype)
            self._seen, self.missing, self.held = np.zeros(shape[:3], np.bool_), voxels, size + voxels
            parts, self._parts = self._parts, []
        else:
            parts = [image]
            if self._seen is None:
                self._whole = self._whole.copy()
        for one in parts:
            self._whole[_place_of(one)] = one.array
            if self._seen is not None:
                self.missing -= _cover(self._seen, one)
        if self.missing:
            return None
        if self._seen is not None:
            self._seen, self.held = None, size
        return _image_of(image, self._whole)

    def takes(self, form: Form) -> bool:
        """Return whether a whole image of this form is stored; ``keep`` can replace it within the same memory."""
        return self._form == form and self._whole is not None

    def keep(self, form: Form, dtype: np.dtype[Any], pixels: memoryview) -> None:
        """Store a whole image for later updates.  If ``takes`` is true, this is equal to ``update`` with that image."""
        self._state += 1
        self._begin(form)
        self._whole = np.frombuffer(pixels, dtype).reshape(form[0])
        self.missing, self.held, self._is_base = 0, pixels.nbytes, True
        self._state += 1

    def forget(self) -> None:
        """Discard what is stored.  Parts of a whole image that came as one message then lack their base."""
        forgotten = self._form if self._is_base else None
        self._state += 1
        self._begin(None)
        self._forgotten = forgotten
        self._state += 1

    def lacks_base(self, image: Image) -> bool:
        """Return whether this is a part of a whole image that was forgotten."""
        is_part = self._forgotten is not None and image.sub_size != image.dimensions
        return is_part and self._forgotten == form_of(image)

    def _begin(self, form: Form | None) -> None:
        """Discard everything stored and start a volume of this form."""
        self._form, self._parts, self._whole, self._seen = form, [], None, None
        self._forgotten, self._is_base = None, False
        self.missing, self.held = math.prod(form[0][:3]) if form else 0, 0


def form_of(image: Image) -> Form:
    """Return the form of the whole image to which a message belongs."""
    i, j, k = image.dimensions
    return (k, j, i, image.num_components), SCALARS[image.number_type]


def _place_of(image: Image) -> tuple[slice, slice, slice]:
    """Return where a part is in the array of the whole image."""
    (x, y, z), (nx, ny, nz) = image.subvol_offset, image.sub_size
    return slice(z, z + nz), slice(y, y + ny), slice(x, x + nx)


def _cover(seen: npt.NDArray[np.bool_], image: Image) -> int:
    """Note which voxels a part covers; return how many of them were missing."""
    covered = seen[_place_of(image)]
    new = covered.size - int(np.count_nonzero(covered))
    covered[...] = True
    return new


def _image_of(newest: Image, pixels: npt.NDArray[Any]) -> Image:
    """Return the whole image with these pixels, and all else of the newest message."""
    endian = newest.endian if pixels.dtype == newest.dtype else 3 - newest.endian
    data = pixels.reshape(-1).view(np.uint8).data
    return replace(newest, pixels=data, endian=endian, subvol_offset=(0, 0, 0), subvol_size=None)
