"""Limits of the TCP edge."""

from __future__ import annotations

import pytest

from igtl_gateway.edges.tcp import Limits
from igtl_gateway.errors import ConfigError


@pytest.mark.parametrize("name", ["max_clients", "queue_bytes", "queue_messages", "stall_s", "max_body"])
def test_limits_are_positive(name: str) -> None:
    with pytest.raises(ConfigError, match=f"limit {name}"):
        Limits(**{name: 0})
