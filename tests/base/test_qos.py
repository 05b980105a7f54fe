"""Qualities of service that DDS does not connect, and the reason."""

from __future__ import annotations

import pytest

from igtl_gateway.base.qos import Qos, incompatible
from tests.tables import table

RELIABILITY = "reliability (best effort offered, reliable requested)"
DURABILITY = "durability (volatile offered, transient local requested)"


@table("offered", [(r, d) for r in (False, True) for d in (False, True)])
@table("requested", [(r, d) for r in (False, True) for d in (False, True)])
def test_a_publisher_must_offer_what_is_requested(offered: tuple[bool, bool], requested: tuple[bool, bool]) -> None:
    """DDS: "offered >= requested", for each of the two."""
    found = incompatible(Qos(10, *offered), Qos(1, *requested))
    lacks = [
        text for text, has, wants in zip((RELIABILITY, DURABILITY), offered, requested, strict=True) if wants > has
    ]
    assert found == " and ".join(lacks)


def test_the_depth_does_not_count() -> None:
    assert incompatible(Qos(depth=1), Qos(depth=1000)) == ""


def test_the_usual_quality_is_that_of_ros() -> None:
    assert Qos() == Qos(10, reliable=True, latched=False)
    with pytest.raises(AttributeError):
        Qos().depth = 3  # type: ignore[misc]
