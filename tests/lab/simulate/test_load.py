"""What a test program may be asked to send."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway_lab.simulate.load import SIZES, Load


def test_the_default_is_what_the_paper_did() -> None:
    assert (Load().type, Load().rate_hz, Load().length) == ("TRANSFORM", 30.0, 1)
    assert Load("STRING").length == 100
    assert Load("IMAGE", 1920).length == 1920


def test_a_duration_sets_how_many() -> None:
    assert Load(rate_hz=30.0, count=7).lasting(2.0) == 60
    assert Load(rate_hz=30.0, count=7).lasting(None) == 7
    assert Load(rate_hz=0.1).lasting(0.5) == 1


@pytest.mark.parametrize("name", SIZES)
def test_the_bounds_of_every_type_are_its_own(name: str) -> None:
    _, least, usual, most = SIZES[name]
    assert [Load(name, size).length for size in (0, least, most)] == [usual, least, most]
    with pytest.raises(ConfigError, match=f"--size: found .*, expected .* for {name}"):
        Load(name, most + 1)


@pytest.mark.parametrize(
    ("load", "told"),
    [
        ({"type": "SOUND"}, "--type: found 'SOUND', expected one of TRANSFORM"),
        ({"type": "STRING", "size": 29}, "--size: found 29, expected 30 to 60,000 bytes for STRING"),
        ({"size": -1}, "--size: found -1, expected none for TRANSFORM"),
        ({"rate_hz": 0.0}, "--rate: found 0, expected above 0"),
        ({"rate_hz": float("nan")}, "--rate: found nan"),
        ({"count": 0}, "--count: found 0, expected 1 to"),
        ({"sender": "all"}, "--sender: found 'all', expected one of igtl, ros, both"),
    ],
)
def test_what_cannot_be_done_is_refused_by_name(load: dict[str, object], told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Load(**load)  # type: ignore[arg-type]
    assert str(caught.value).startswith(told)
