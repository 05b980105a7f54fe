"""The I/O thread's turns: what raises ends itself only, and goes to its own rescue."""

from __future__ import annotations

import logging
import selectors
import socket
from collections.abc import Callable

import pytest

from igtl_gateway.base.clock import ManualClock, SystemClock
from igtl_gateway.edges.tcp.loop import READ, Loop


def test_every_kind_of_action_may_raise() -> None:
    done: list[str] = []

    def raises(name: str) -> Callable[..., None]:
        def action(*_: object) -> None:
            raise ZeroDivisionError(name)

        return action

    loop = Loop(ManualClock(), lambda: None, lambda exc: done.append(f"{exc} reported"))
    one, other = socket.socketpair()
    with one, other:
        other.send(b"!")
        loop.watch(one, READ, raises("socket"), lambda exc: done.append(f"{exc} rescued"))
        loop.call_soon(raises("post"), lambda exc: done.append(f"{exc} rescued"))
        loop.call_soon(raises("orphan"))
        loop.call_soon(lambda: done.append("posted"))
        loop.call_later(0, raises("timer"), lambda exc: done.append(f"{exc} rescued"))
        loop.call_later(0, lambda: done.append("timed"))
        loop.run_once(None)
        loop.unwatch(one)
    loop.close()
    assert done == ["socket rescued", "post rescued", "orphan reported", "posted", "timer rescued", "timed"]


def test_a_rescue_that_raises_is_the_last_resort(caplog: pytest.LogCaptureFixture) -> None:
    def worse(exc: Exception) -> None:
        raise RuntimeError("worse") from exc

    loop = Loop(ManualClock(), lambda: None, worse)
    done: list[int] = []
    loop.call_soon(lambda: done.append(1 // 0))
    loop.call_soon(lambda: done.append(1))
    with caplog.at_level(logging.ERROR):
        loop.run_once(None)
    loop.close()
    assert done == [1]
    assert "its rescue raised" in caplog.text


def test_who_was_stopped_while_waiting_looks_at_the_sockets_before_timers(monkeypatch: pytest.MonkeyPatch) -> None:
    """What epoll does then: it is interrupted, its time is over, and it gives nothing."""
    done: list[str] = []
    loop = Loop(SystemClock(), lambda: None, lambda exc: done.append(f"{exc}"))
    look = loop._selector.select

    def interrupted(timeout: float | None) -> list[tuple[selectors.SelectorKey, int]]:
        return [] if timeout else look(timeout)

    monkeypatch.setattr(loop._selector, "select", interrupted)
    one, other = socket.socketpair()
    with one, other:
        other.send(b"!")
        loop.watch(one, READ, lambda _: done.append("socket"))
        loop.call_later(0.001, lambda: done.append("timed"))
        while "timed" not in done:
            loop.run_once(None)
        loop.unwatch(one)
    loop.close()
    assert done[-2:] == ["socket", "timed"]
