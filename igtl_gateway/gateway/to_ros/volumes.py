"""Partial images: the latest whole image of each device, into which parts are written."""

from __future__ import annotations

from igtl_gateway.base.errors import ConversionError, NoBase
from igtl_gateway.convert.assembly import ForeseenVolume, VolumeAssembler
from igtl_gateway.gateway.kept import beyond
from igtl_gateway.wire.image import Image

#: Maximum number of devices with partial images.
MAX_VOLUMES = 64
#: Maximum size of all kept images in bytes, until the next tick: several times the largest usual volumes (250 MiB).
MAX_VOLUMES_BYTES = 2 << 30


class Volumes:
    """The latest image of each device.

    Args:
        room: bytes of all images but the newest that ``forget`` leaves; None: any number, as in old recordings.
    """

    def __init__(self, room: int | None = None) -> None:
        self._assemblers: dict[str, VolumeAssembler] = {}
        self._room = room

    def get(self, device: str) -> VolumeAssembler | None:
        """Return the assembler of a device; None if there is none."""
        return self._assemblers.get(device)

    def foreseen(self, device: str, image: Image) -> ForeseenVolume | None:
        """Return what ``assembled`` would, and change nothing, for a part that gives a whole image; from any thread."""
        assembler = self._assemblers.get(device)
        return assembler.foreseen(image) if assembler else None

    def assembled(
        self, device: str, image: Image, seq: int = 0, foreseen: ForeseenVolume | None = None
    ) -> Image | None:
        """Return the whole image that ``image`` of the entry ``seq`` updates; None while some of its parts are missing.

        Raises ConversionError for partial images of too many devices, NoBase for parts of what was forgotten.
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
        if assembler.lacks_base(image):
            raise NoBase(
                f"IMAGE {device!r}: found a part of an image that is not kept, expected a whole one: the images of all "
                f"devices exceed {(self._room or 0) >> 20} MiB (keep_mib)"
            )
        assembler.used = seq
        others = sum(one.held for one in self._assemblers.values()) - assembler.held
        return assembler.update(image, MAX_VOLUMES_BYTES - others, foreseen)

    def exceed(self) -> bool:
        """Return whether ``forget`` has anything to do."""
        return bool(self._beyond())

    def forget(self) -> None:
        """Forget images that alone exceed the room, then those used least recently, until the others are within it."""
        for one in self._beyond():
            one.forget()

    def _beyond(self) -> list[VolumeAssembler]:
        older = sorted(self._assemblers.values(), key=lambda one: one.used)[:-1]
        return beyond(self._room, (one for one in older if one.held), lambda one: one.held)
