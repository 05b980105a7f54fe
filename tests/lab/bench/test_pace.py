"""Sending on absolute deadlines, with a clock that runs when it is looked at."""

from __future__ import annotations

import threading

from igtl_gateway.base.clock import ManualClock
from igtl_gateway_lab.bench.pace import Schedule, SendPacer
from igtl_gateway_lab.bench.window import SendWindow, progress

MS = 1_000_000


class Looked(ManualClock):
    """A millisecond passes with each look."""

    def monotonic_ns(self) -> int:
        self.advance(MS)
        return super().monotonic_ns()


def test_streams_are_sent_at_their_rates_in_the_order_of_time() -> None:
    clock, log = Looked(), []

    def sender(name: str) -> Schedule:
        def send(first: int, _count: int) -> list[int]:
            log.append(f"{name}{first}")
            return [0]

        return Schedule(send, {"a": 100.0, "b": 50.0}[name], {"a": 4, "b": 2}[name])

    SendPacer(clock).run([sender("a"), sender("b")], 0, 0)
    assert log == ["a1", "a2", "b1", "a3", "a4", "b2"]  # b begins half a period later


def test_a_late_message_makes_none_later() -> None:
    clock = Looked()

    def send(first: int, _count: int) -> list[int]:
        if first == 2:
            clock.advance(25 * MS)
        return [clock.utc_ns()]

    (sent,) = SendPacer(clock).run([Schedule(send, 100.0, 6)], 0, 0)
    assert sent[2] - sent[1] < 10 * MS  # those that were missed follow at once ...
    assert 50 * MS <= sent[5] < 56 * MS  # ... and the sixth comes when it would have


def test_a_flood_without_count_ends_in_time() -> None:
    clock = Looked()
    (sent,) = SendPacer(clock).run([Schedule(lambda first, _count: [first], 0.0, 0)], 0, 20 * MS)
    assert sent == list(range(1, len(sent) + 1))
    assert 15 <= len(sent) <= 21


def test_a_flood_waits_for_its_window() -> None:
    clock, heard, bursts = Looked(), progress(), []

    def send(first: int, count: int) -> list[int]:
        assert first + count - 1 - heard[0] <= 8
        bursts.append(count)
        heard[0] = first + count - 5  # all but four of them have arrived
        return [0] * count

    (sent,) = SendPacer(clock).run([Schedule(send, 0.0, 30, SendWindow(heard, 8, clock))], 0, 0)
    assert len(sent) == 30
    assert bursts[:3] == [8, 4, 4]


def test_it_can_be_stopped() -> None:
    pace = SendPacer(Looked())
    begun = threading.Event()

    def send(_first: int, _count: int) -> list[int]:
        begun.set()
        return [0]

    thread = threading.Thread(target=pace.run, args=([Schedule(send, 0.0, 0)], 0, 1 << 62))
    thread.start()
    assert begun.wait(10)
    pace.stop()
    thread.join(10)
    assert not thread.is_alive()
