"""Images that come in parts: each device keeps its last whole image, into which parts are written."""

from __future__ import annotations

from igtl_gateway.convert.assembly import VolumeAssembler
from igtl_gateway.errors import ConversionError
from igtl_gateway.wire.image import Image

#: Devices whose images may come in parts: each keeps its last image.
MAX_VOLUMES = 64
#: What all of them may keep, in bytes: several times the largest volumes of the field (250 MiB).
MAX_VOLUMES_BYTES = 2 << 30


class Volumes:
    """The last image of each device."""

    def __init__(self) -> None:
        self._assemblers: dict[str, VolumeAssembler] = {}

    def get(self, device: str) -> VolumeAssembler | None:
        """What keeps the last image of a device; None if there is none."""
        return self._assemblers.get(device)

    def assembled(self, device: str, image: Image) -> Image | None:
        """The whole image that ``image`` updates; None as long as parts of it have never been sent.

        Raises ConversionError for parts from more devices than can be kept.
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
