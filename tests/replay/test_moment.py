"""Moments as people write them."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.replay.moment import check_part, moment
from tests.tables import table

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


def test_the_first_and_the_last_moment() -> None:
    assert moment("1970-01-01T00:00:00Z", START, "--start") == 0
    assert moment("2262-04-11T23:47:16.854775Z", START, "--start") == 9_223_372_036_854_775_000
    for text in ("1969-12-31T23:59:59.999999Z", "2262-04-12T00:00:00Z", "9999-01-01T00:00:00Z"):
        with pytest.raises(ConfigError, match=r"--start: found .*, expected a time from 1970 to 2262"):
            moment(text, START, "--start")


@table(
    ("start_s", "end_s", "is_empty_part", "words"),
    [
        (None, None, True, ""),
        (0, 10, True, ""),
        (10, None, True, ""),
        (11, None, True, "--start: found +11.000 s, expected at most +10.000 s"),
        (-5, None, True, ""),
        (3, 3, True, "--end: found +3.000 s, expected after +3.000 s"),
        (3, 3, False, ""),
        (3, 2, False, "--end: found +2.000 s, expected at least +3.000 s"),
        (None, 0, True, "--end: found +0.000 s, expected after +0.000 s"),
        (None, 0, False, ""),
        (3, 99, True, ""),
    ],
)
def test_a_part_holds_a_message(start_s: int | None, end_s: int | None, is_empty_part: bool, words: str) -> None:
    start_ns, end_ns = (None if each is None else START + each * S for each in (start_s, end_s))
    if not words:
        check_part(start_ns, end_ns, START, START + 10 * S, is_empty_part=is_empty_part)
        return
    with pytest.raises(ConfigError) as caught:
        check_part(start_ns, end_ns, START, START + 10 * S, is_empty_part=is_empty_part)
    assert str(caught.value) == words
