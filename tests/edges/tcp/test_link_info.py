"""Limits of the TCP edge."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.globs import matches
from igtl_gateway.edges.tcp import PeerLimits
from igtl_gateway.wire.header import DEFAULT_MAX_BODY
from tests.tables import table


@table(
    "name",
    [
        "max_clients",
        "queue_bytes",
        "queue_messages",
        "stall_s",
        "min_rate",
        "handshake_s",
        "max_body",
        "messages_per_s",
    ],
)
def test_limits_are_positive(name: str) -> None:
    with pytest.raises(ConfigError, match=f"limit {name}"):
        PeerLimits(**{name: 0})  # type: ignore[arg-type]


def test_a_time_for_idleness_is_none_or_positive() -> None:
    assert PeerLimits().idle_s == PeerLimits(idle_s=0).idle_s == 0
    with pytest.raises(ConfigError, match="limit idle_s: found -1"):
        PeerLimits(idle_s=-1)


def test_bodies_by_type() -> None:
    with pytest.raises(ConfigError, match="limit bodies, STRING: found 0"):
        PeerLimits(bodies=(("STRING", 0),))

    def longest(name: str, limits: PeerLimits) -> int:
        rows = limits.body_rows()
        return next((size for glob, size in rows if matches(glob, name)), limits.max_body)

    usual, small, own = PeerLimits(), PeerLimits(max_body=1000), PeerLimits(max_body=1000, bodies=(("IMAGE", 5000),))
    assert longest("STRING", usual) == longest("GET_TRANS", usual) == 2 * 2**20
    assert longest("RTS_COMMAND", usual) == 16 * 2**20
    assert longest("IMAGE", usual) == longest("POLYDATA", usual) == longest("SOMETHING", usual) == DEFAULT_MAX_BODY
    assert longest("STRING", small) == longest("IMAGE", small) == 1000, "one setting makes all of them smaller"
    assert (longest("IMAGE", own), longest("STRING", own)) == (5000, 1000), "what is set for a type holds for it"


def test_the_usual_limit_is_above_what_the_passage_passes_to_ros() -> None:
    """At the limit Python reads the link: a flood of 85,000 transforms a second then cost half as much CPU again."""
    assert PeerLimits().messages_per_s > 85_000
