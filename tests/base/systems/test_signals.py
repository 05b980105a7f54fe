"""Signals that wait for a good moment."""

from __future__ import annotations

import signal
import threading

import pytest

from igtl_gateway.base.systems.signals import endings_held, endings_noted, signals_in_thread


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


def test_an_ending_is_noted_and_has_its_effect_at_the_end() -> None:
    with pytest.raises(KeyboardInterrupt) as raised, endings_noted() as came:
        assert not came()
        signal.raise_signal(signal.SIGINT)
        assert came()
        raise KeyboardInterrupt
    assert raised.value.__suppress_context__, "two tracebacks"


def test_an_ending_that_a_thread_takes_interrupts_what_notes_it() -> None:
    taken = threading.Event()
    with (
        signals_in_thread({signal.SIGINT: taken.set}, "test"),
        pytest.raises(KeyboardInterrupt),
        endings_noted(),
    ):
        signal.raise_signal(signal.SIGINT)
    assert taken.wait(60)


def test_an_ignored_ending_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with endings_noted() as came:
            signal.raise_signal(signal.SIGINT)
            assert not came()
    finally:
        signal.signal(signal.SIGINT, before)
