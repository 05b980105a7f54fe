"""A world of its own for each test of the TCP edge."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.edges.tcp.world import World


@pytest.fixture
def world() -> Iterator[World]:
    world = World()
    yield world
    world.close()
