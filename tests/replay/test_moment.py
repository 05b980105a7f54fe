"""Moments as people write them."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.replay.moment import moment

START = 1_795_248_000_123_456_789  # 2026-11-21T08:00:00.123456789Z
S = 1_000_000_000


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0", START),
        ("12.5", START + 12_500_000_000),
        ("0.000000001", START + 1),
        ("1795248001.000000002", 1_795_248_001 * S + 2),
        ("2026-11-21T08:00:01Z", 1_795_248_001 * S),
        ("2026-11-21T08:00:01.25", 1_795_248_001 * S + S // 4),
        ("2026-11-21 10:00:01+02:00", 1_795_248_001 * S),
    ],
)
def test_seconds_utc_and_iso(text: str, expected: int) -> None:
    assert moment(text, START, "--start") == expected


@pytest.mark.parametrize("text", ["", "soon", "-1", "nan", "inf", "2026-13-01T00:00:00Z", "12:00"])
def test_what_is_no_moment_is_said_with_its_option(text: str) -> None:
    with pytest.raises(ConfigError, match=r"--end: found .*, expected seconds from the beginning"):
        moment(text, START, "--end")
