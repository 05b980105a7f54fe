"""What the verbs share."""

from __future__ import annotations

import argparse
import signal

import pytest

from igtl_gateway.base.quantities import count_text, size_text
from igtl_gateway.cli.common import stop_event
from igtl_gateway.cli.options import address


@pytest.mark.usefixtures("terminal_signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_sets_the_event(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_event() as stop:
        assert not stop.is_set()
        signal.raise_signal(number)
        assert stop.wait(10)
    assert signal.getsignal(number) == before


def test_under_nohup_the_terminal_may_go() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_event() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN and not stop.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_that_meets_the_main_thread_inside_the_event_does_not_hang() -> None:
    with stop_event() as stop:
        with stop._cond:  # type: ignore[attr-defined]  # what Event.wait holds for a moment
            signal.raise_signal(signal.SIGINT)
        assert stop.wait(10)


def test_without_a_signal_nothing_is_set() -> None:
    with stop_event() as stop:
        pass
    assert not stop.is_set()


@pytest.mark.parametrize(
    ("text", "parsed"),
    [
        ("127.0.0.1:18944", ("127.0.0.1", 18944)),
        (":5000", ("127.0.0.1", 5000)),
        ("5000", ("127.0.0.1", 5000)),
        ("robot", ("robot", 18944)),
        ("[::1]:5000", ("::1", 5000)),
        ("[::1]", ("::1", 18944)),
    ],
)
def test_addresses(text: str, parsed: tuple[str, int]) -> None:
    assert address(text) == parsed


@pytest.mark.parametrize("text", ["robot:port", "robot:65536", "robot:-1"])
def test_addresses_that_are_none(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected HOST:PORT"):
        address(text)


def test_numbers_for_people() -> None:
    assert (count_text(1, "peer"), count_text(1234, "entry", "entries")) == ("1 peer", "1,234 entries")
    assert (size_text(812), size_text(9_600_000), size_text(3e12)) == ("812 B", "9.6 MB", "3.0 TB")
