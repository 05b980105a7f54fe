"""The last image of each device is kept within a limit."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.gateway.to_ros import volumes
from igtl_gateway.gateway.to_ros.volumes import Volumes
from igtl_gateway.wire.image import Image


def image(value: int, part: tuple[int, int, int] = (2, 1, 1), offset: int = 0) -> Image:
    pixels = bytes([value]) * (part[0] * part[1] * part[2])
    return Image((2, 1, 1), 3, pixels, subvol_offset=(offset, 0, 0), subvol_size=part)


def test_parts_of_one_device_become_an_image() -> None:
    kept = Volumes()
    assert kept.get("A") is None
    assert kept.assembled("A", image(1, (1, 1, 1))) is None
    whole = kept.assembled("A", image(2, (1, 1, 1), offset=1))
    assert whole is not None and whole.array.ravel().tolist() == [1, 2]
    assert kept.get("A") is not None


def test_beyond_the_limit_whole_images_pass_and_parts_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(volumes, "MAX_VOLUMES", 1)
    kept = Volumes()
    assert kept.assembled("A", image(1)) is not None
    whole = image(2)
    assert kept.assembled("B", whole) is whole
    with pytest.raises(ConversionError, match="whole ones beyond 1 devices"):
        kept.assembled("B", image(3, (1, 1, 1)))
    assert kept.assembled("A", image(4, (1, 1, 1))) is not None, "A still has its place"
