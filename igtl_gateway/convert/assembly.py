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


class VolumeAssembler:
    """The volume of one stream.

    A volume handed out never changes: each update is written into a copy of it, so that what was recorded or is
    on its way keeps its values.

    Attributes:
        missing: voxels that no message has told yet.
    """

    def __init__(self) -> None:
        self.missing = 0
        self._whole: npt.NDArray[Any] | None = None  # (k, j, i, components), in the byte order of its first message
        self._seen: npt.NDArray[np.bool_] | None = None  # None once all is

    def update(self, image: Image) -> Image | None:
        """The whole image after a message; None as long as parts of it are missing.

        A message of another size, scalar type or number of components starts anew.  Geometry is that of the newest
        message.  Raises ConversionError for a volume above MAX_VOLUME_BYTES.
        """
        if image.sub_size == image.dimensions:
            self._whole, self._seen, self.missing = image.array, None, 0
            return image
        i, j, k = image.dimensions
        shape = (k, j, i, image.num_components)
        dtype = np.dtype((">" if image.endian == BIG_ENDIAN else "<") + SCALARS[image.scalar_type])
        size = math.prod(shape) * dtype.itemsize
        if size > MAX_VOLUME_BYTES:
            raise ConversionError(f"IMAGE: found a volume of {size} bytes, expected {MAX_VOLUME_BYTES} at most")
        whole = self._whole
        if whole is None or whole.shape != shape or whole.dtype.newbyteorder("=") != dtype.newbyteorder("="):
            whole = np.zeros(shape, dtype)
            self._seen, self.missing = np.zeros(shape[:3], np.bool_), math.prod(shape[:3])
        elif self._seen is None:
            whole = whole.copy()
        (x, y, z), (nx, ny, nz) = image.subvol_offset, image.sub_size
        part = (slice(z, z + nz), slice(y, y + ny), slice(x, x + nx))
        whole[part] = image.array
        self._whole = whole
        if self._seen is not None:
            seen = self._seen[part]
            self.missing -= seen.size - int(np.count_nonzero(seen))
            seen[...] = True
            if self.missing:
                return None
            self._seen = None
        endian = image.endian if whole.dtype == dtype else 3 - image.endian
        pixels = whole.reshape(-1).view(np.uint8).data
        return replace(image, pixels=pixels, endian=endian, subvol_offset=(0, 0, 0), subvol_size=None)
