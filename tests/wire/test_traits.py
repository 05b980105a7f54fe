"""The traits of types, and the tables that are made of them."""

from __future__ import annotations

import re

from igtl_gateway.edges.tcp.link_info import MAX_BODIES
from igtl_gateway.wire.cost import AT_ONCE_NS, cost_ns
from igtl_gateway.wire.registry import ALIASES, BODIES, BULKY
from igtl_gateway.wire.traits import Traits, traits_of
from tests.places import ROOT


def test_the_sizes_of_types_are_those_that_users_read() -> None:
    text = (ROOT / "docs" / "how-to" / "security.md").read_text("utf-8")
    listed = re.search(r"Maximum body sizes by type, in MiB: (.*?); all others", text, re.DOTALL)
    assert listed
    read = {
        name: int(part.split()[-1]) << 20 for part in listed[1].split("; ") for name in re.findall(r"[A-Z]{4,}", part)
    }
    assert {
        name: most for name, most in MAX_BODIES if name in BODIES and (name in read or name not in ALIASES)
    } == read | {"RTS_COMMAND": 16 << 20}
    assert all(dict(MAX_BODIES)[name] == dict(MAX_BODIES)[of] for name, of in ALIASES.items() if of in dict(MAX_BODIES))


def test_bulky_types_have_pixels_points_or_cells() -> None:
    assert {"IMAGE", "POLYDATA", "VIDEO", "COLORT", "COLORTABLE", "NDARRAY"} == BULKY


def test_lists_are_dear_and_most_types_are_not() -> None:
    """What takes longer than a millisecond is read aside, with nothing in front of it."""

    def least_mib(name: str) -> float:
        head = b"\0\1" + name.encode().ljust(12, b"\0") + bytes(28)
        sizes = (1 << power for power in range(9, 28))
        return next(
            (size / 2**20 for size in sizes if cost_ns(head + size.to_bytes(8, "big") + bytes(8 + 512)) > AT_ONCE_NS), 0
        )

    assert least_mib("TDATA") == least_mib("QTDATA") < least_mib("TRAJ") == least_mib("POINT") < least_mib("STRING")
    assert least_mib("BIND") < least_mib("VIDEOMETA") < least_mib("IMGMETA") < least_mib("RTS_COMMAND")


def test_large_pictures_are_copied_aside() -> None:
    """60 MB are copied for a tenth of a second: into the ROS message, and of both for the recorder."""

    def picture(igtl_type: bytes, size: int) -> bytes:
        head = b"\0\1" + igtl_type.ljust(12, b"\0") + bytes(28) + size.to_bytes(8, "big")
        volume = b"".join(number.to_bytes(2, "big") for number in (1000, size // 1000, 1))
        return head + bytes(8) + b"\0\1\3\1" + volume + bytes(48) + bytes(6) + volume + bytes(512)

    for igtl_type in (b"IMAGE", b"VIDEO"):
        assert cost_ns(picture(igtl_type, 60_000_000)) > 10 * AT_ONCE_NS
        assert cost_ns(picture(igtl_type, 640 * 480)) < AT_ONCE_NS


def test_a_class_without_traits_is_as_most_types() -> None:
    assert traits_of(BODIES["GET_STATUS"]) == Traits() == traits_of(object)
    assert traits_of(BODIES["CLIENTINFO"]) == traits_of(BODIES["STRING"]) != Traits()
