"""The last image of each device is kept within a limit."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.to_ros import volumes
from igtl_gateway.gateway.to_ros.volumes import Volumes
from igtl_gateway.wire import Message
from igtl_gateway.wire.image import Image
from tests.gateway.to_igtl.test_latest import SIDE, looked
from tests.gateway.to_igtl.test_latest import part as one_pixel
from tests.gateway.to_igtl.test_latest import whole as whole_image
from tests.script import Script


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


def test_an_image_above_the_limit_costs_no_other_device_its_own() -> None:
    script = Script(Config(keep_mib=1))
    script.igtl(whole_image("A"))
    script.igtl(whole_image("Huge", side=1_100))
    script.igtl(whole_image("B"))
    looked(script)
    assert script.igtl(one_pixel("A")) == ["ros /igtl/in/A/image"]
    assert script.igtl(one_pixel("Huge", side=1_100)) == ["note conversion"]
    assert script.igtl(one_pixel("Huge", side=1_000)) == [], "another size is another image"


def test_parts_that_make_an_image_may_begin_again() -> None:
    script = Script(Config(keep_mib=1))
    for device in ("A", "B", "C", "D"):
        for half in (0, 1):
            pixels = bytes(SIDE * SIDE // 2)
            size, offset = (SIDE, SIDE // 2, 1), (0, half * SIDE // 2, 0)
            image = Image((SIDE, SIDE, 1), 3, pixels, subvol_offset=offset, subvol_size=size)
            script.igtl(Message("IMAGE", device, image))
    looked(script)
    script.igtl(one_pixel("A"))
    assert script.gateway.ledger.to_dict()["igtl_in"]["IMAGE/A"]["dropped"] == {"part_of_volume": 2}
