"""Limits of reading: what they allow, how they are set, the text of the error."""

from __future__ import annotations

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import ConfigError, LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.base.untrusted.limits import Deadline, FileLimits
from tests.tables import table

S = 1_000_000_000


def test_a_small_piece_may_have_any_ratio_and_a_large_one_may_not() -> None:
    bounds = FileLimits(memory=1000, ratio=10, free=100)
    assert [bounds.unpacked(packed) for packed in (0, 5, 10, 50, 5000)] == [100, 100, 100, 500, 1000]


def test_the_error_names_the_place_the_value_and_the_limit() -> None:
    with (
        limits.limits_in_force(FileLimits(count=3)),
        pytest.raises(LimitExceeded, match=r"x.mha: found 4, .* 3 \(--limit count=3\)"),
    ):
        limits.check_limit("count", 4, "x.mha")
    limits.check_limit("count", 4, "x.mha")


def test_what_unpacks_to_too_much() -> None:
    with limits.limits_in_force(FileLimits(memory=1000, ratio=10, free=100)):
        limits.check_unpacked(10, 100, "chunk 1")
        with pytest.raises(LimitExceeded, match="ratio=10"):
            limits.check_unpacked(10, 101, "chunk 1")
        with pytest.raises(LimitExceeded, match="memory=1000"):
            limits.check_unpacked(5000, 1001, "chunk 1")


def test_parse_replaces_what_is_named() -> None:
    with limits.limits_in_force(FileLimits()):
        assert limits.parse_limits(["memory=5", "depth=6", "memory=7"]) == FileLimits(memory=7, depth=6)
    assert limits.parse_limits([]) == limits.current_limits()


@table("word", ["", "memory", "memory=", "memory=-1", "memory=0", "size=5", "depth=1e3", "depth=²"])
def test_parse_refuses(word: str) -> None:
    with pytest.raises(ConfigError, match="--limit: found"):
        limits.parse_limits([word])


def test_every_limit_has_a_meaning() -> None:
    assert list(limits.MEANINGS) == list(FileLimits.__dataclass_fields__)


def test_a_deadline_grows_with_the_file() -> None:
    clock = ManualClock()
    with limits.limits_in_force(FileLimits(seconds=2, seconds_per_mb=3)):
        deadline = Deadline(2_000_000, clock)
        clock.advance(8 * S)
        deadline.check("here")
        clock.advance(1)
        with pytest.raises(LimitExceeded, match=r"here: found more than 8 s of work"):
            deadline.check("here")
