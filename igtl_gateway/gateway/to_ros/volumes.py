"""Partial images: the latest whole image of each device, into which parts are written."""

from __future__ import annotations

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.assembly import VolumeAssembler
from igtl_gateway.wire.image import Image

#: Maximum number of devices with partial images.
MAX_VOLUMES = 64
#: Maximum size of all kept images in bytes: several times the largest usual volumes (250 MiB).
MAX_VOLUMES_BYTES = 2 << 30


class Volumes:
    """The latest image of each device."""

    def __init__(self) -> None:
        self._assemblers: dict[str, VolumeAssembler] = {}

    def get(self, device: str) -> VolumeAssembler | None:
        """Return the assembler of a device; None if there is none."""
        return self._assemblers.get(device)

    def assembled(self, device: str, image: Image) -> Image | None:
        """Return the whole image that ``image`` updates; None while some of its parts are missing.

        Raises ConversionError for partial images of too many devices.
        """
        assembler = self._assemblers.get(device)
        if assembler is None:
            if len(self._assemblers) >= MAX_VOLUMES:
                if image.sub_size == image.dimensions:
                    return image
                raise ConversionError(
                    f"IMAGE {device!r}: found a part of an image, expected whole ones beyond {MAX_VOLUMES} devices"
                )
            assembler = self._assemblers[device] = VolumeAssembler()
        others = sum(one.held for one in self._assemblers.values()) - assembler.held
        return assembler.update(image, MAX_VOLUMES_BYTES - others)
