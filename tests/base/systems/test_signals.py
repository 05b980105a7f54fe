"""Signals that wait for a good moment."""

from __future__ import annotations

import signal

import pytest

from igtl_gateway.base.systems.signals import endings_held


def test_a_held_signal_comes_when_it_is_looked_for() -> None:
    with endings_held() as look:
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            look()
        look()
    done = []
    with pytest.raises(KeyboardInterrupt), endings_held():
        signal.raise_signal(signal.SIGINT)
        done.append("the block")
    assert done == ["the block"]
