"""The player: order, pauses, jumps and steps, with entries that are numbers."""

from __future__ import annotations

import dataclasses
import hashlib
import threading
from collections.abc import Callable, Iterator, Sequence

import pytest

from igtl_gateway.app.player import Feed, Jump, Player
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.replay.restamp import Restamper
from igtl_gateway.replay.simclock import is_tick, with_ticks

S = 1_000_000_000
BEGIN = 1_700_000_000 * S
PATIENCE_S = 30.0
#: Entry number n is at second n of the recording.
ENTRIES = [Entry(n, BEGIN + n * S, Kind.ROS_OUT, "/a", "x/msg/Y", (bytes([n]),)) for n in range(1, 6)]


def at(second: float) -> int:
    return BEGIN + round(second * S)


def feed(from_ns: int | None) -> Iterator[Entry]:
    """Entry 1 is the state of all that comes later."""
    for entry in ENTRIES:
        if from_ns is None or entry.stamp_ns >= from_ns or entry is ENTRIES[0]:
            yield entry


class Played:
    """A player in a thread, and what it sent."""

    def __init__(
        self,
        rate: float | None = None,
        *,
        paused: bool = False,
        loop: bool = False,
        start_ns: int | None = None,
        restamp: Restamper | None = None,
        entries: Feed = feed,
        stop_after: int = 10_000,
        together: bool = False,
    ) -> None:
        self.batches: list[int] = []
        self.sent: list[int] = []
        self.ticks = 0
        self.jumps: list[Jump] = []
        self.stop = threading.Event()
        self._stop_after = stop_after
        self._changed = threading.Condition()
        self.player = Player(
            entries,
            self._send,
            SystemClock(),
            self.stop,
            rate=rate,
            paused=paused,
            loop=loop,
            span=(at(1), at(5)),
            start_ns=start_ns,
            restamp=restamp,
            on_jump=self.jumps.append,
            send_all=self._send_all if together else None,
        )
        self._thread = threading.Thread(target=self.player.run)
        self._thread.start()

    def _send(self, entry: Entry) -> bool:
        with self._changed:
            if is_tick(entry):
                self.ticks += 1
            else:
                self.sent.append(entry.seq)
            if len(self.sent) >= self._stop_after:
                self.stop.set()
            self._changed.notify_all()
        return entry.seq != 3

    def _send_all(self, entries: Sequence[Entry]) -> bool:
        self.batches.append(len(entries))
        return all([self._send(entry) for entry in entries])

    def wait(self, condition: Callable[[], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, PATIENCE_S), self.sent

    def end(self) -> list[int]:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        return self.sent

    def __enter__(self) -> Played:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._thread.join(PATIENCE_S)


@pytest.mark.parametrize("rate", [None, 1000.0, 50.0])
def test_every_rate_sends_the_same(rate: float | None) -> None:
    with Played(rate) as run:
        assert run.end() == [1, 2, 3, 4, 5]
        played = run.player.played
        assert (played.messages, played.bytes, played.without_peer, played.by_stream) == (5, 5, 1, {"/a": 5})
        assert played.digest == "74f81fe167d99b4cb41d6d0ccda82278caee9f3e2f25d5e5a3936ff3dcec60d0"
        assert run.player.sides["ros"].digest == played.digest


def test_a_part_begins_with_its_state() -> None:
    with Played(start_ns=at(3.5)) as run:
        assert run.end() == [1, 4, 5]
        assert run.jumps == []


def test_paused_it_sends_nothing_but_what_is_stepped() -> None:
    with Played(1000.0, paused=True) as run:
        assert run.player.burst(1) == 1
        assert run.sent == [1]
        assert run.player.burst(2) == 2
        assert run.sent == [1, 2, 3]
        assert run.player.position_ns == at(3)
        run.player.resume()
        assert run.end() == [1, 2, 3, 4, 5]
        assert run.player.burst(1) == 0, "it is over"
        assert not run.player.step() and not run.player.seek(at(2))


def test_a_burst_of_all_ends_at_the_end() -> None:
    with Played(paused=True) as run:
        assert run.player.burst(0) == 5
        assert run.end() == [1, 2, 3, 4, 5]


def test_only_a_paused_player_steps() -> None:
    with Played(0.001) as run:
        run.wait(lambda: run.sent == [1])
        assert run.player.burst(1) == 0 and not run.player.step()
        run.player.toggle()
        assert run.player.burst(1) == 1
        run.player.toggle()
        assert not run.player.paused
        assert run.player.burst(1) == 0
        assert run.sent == [1, 2]


def test_a_new_rate_wakes_a_player_that_waits() -> None:
    with Played(1e-6) as run:
        run.wait(lambda: run.sent == [1])
        for rate in (0.0, -1.0, float("nan")):
            assert not run.player.set_rate(rate)
        assert run.player.set_rate(1e6)
        assert run.player.rate == 1e6
        assert run.end() == [1, 2, 3, 4, 5]


def test_a_seek_sends_the_state_even_while_paused_and_is_told() -> None:
    with Played(1.0, paused=True) as run:
        run.player.burst(2)
        assert run.player.seek(at(4))
        run.wait(lambda: run.sent == [1, 2, 1])
        assert run.player.position_ns == at(4)
        assert run.jumps == [Jump("seek", at(2), at(4))]
        assert run.player.burst(1) == 1
        assert run.sent == [1, 2, 1, 4]
        assert run.player.seek(at(2)), "backwards, too"
        run.player.set_rate(1e6)
        run.player.resume()
        assert run.end() == [1, 2, 1, 4, 1, 2, 3, 4, 5]


def test_behind_the_last_message_a_paused_player_waits_for_a_way_back() -> None:
    with Played(paused=True, entries=lambda start: (entry for entry in feed(start) if entry.seq < 4)) as run:
        assert run.player.seek(at(4))
        run.wait(lambda: run.sent == [1])
        assert run.player.burst(1) == 0
        assert run.player.seek(at(3))
        assert run.player.burst(1) == 1
        assert run.end() == [1, 1, 3]


def test_one_cannot_seek_outside() -> None:
    with Played(paused=True) as run:
        assert not run.player.seek(at(0.9)) and not run.player.seek(at(5.1))
        assert run.player.seek(at(1)) and run.player.seek(at(5))


def test_a_loop_begins_again_with_the_state_until_it_is_stopped() -> None:
    with Played(loop=True, start_ns=at(4), stop_after=8) as run:
        assert run.end() == [1, 4, 5, 1, 4, 5, 1, 4]
        assert run.jumps == [Jump("loop", at(5), at(4))] * 2


def test_a_loop_of_nothing_ends() -> None:
    with Played(loop=True, entries=lambda _: iter(ENTRIES[:1]), start_ns=at(4)) as run:
        assert run.end() == [1]


def test_a_burst_of_all_ends_with_the_pass_of_a_loop() -> None:
    with Played(loop=True, paused=True) as run:
        assert run.player.burst(0) == 5
        assert run.player.burst(1) == 1
        assert run.sent == [1, 2, 3, 4, 5, 1]


def test_a_stop_ends_a_wait() -> None:
    with Played(1e-6) as run:
        run.wait(lambda: run.sent == [1])
        run.stop.set()
        assert run.end() == [1]


def test_an_error_of_the_feed_comes_out_and_lets_nobody_wait() -> None:
    def broken(_: int | None) -> Iterator[Entry]:
        yield ENTRIES[0]
        raise ValueError("damaged")

    player = Player(broken, lambda _: True, SystemClock(), threading.Event(), rate=None)
    with pytest.raises(ValueError, match="damaged"):
        player.run()
    assert not player.step()


def test_the_clock_is_no_message_and_is_repeated_while_paused() -> None:
    def ticking(from_ns: int | None) -> Iterator[Entry]:
        return with_ticks(feed(from_ns), from_ns, S // 2)

    with Played(entries=ticking) as run:
        assert run.end() == [1, 2, 3, 4, 5]
        assert run.ticks == 9 and run.player.played.messages == 5
    with Played(entries=ticking, paused=True) as run:
        assert run.player.burst(2) == 2
        run.wait(lambda: run.ticks > 10)
        assert run.sent == [1, 2]
        assert run.player.seek(at(4))
        run.wait(lambda: run.sent == [1, 2, 1])


def test_new_stamps_are_what_is_hashed() -> None:
    plain, told = Played(), list[str]()
    with plain, Played(restamp=Restamper("now", told.append)) as run:
        assert run.end() == plain.end()
        assert told == ["x/msg/Y"]
        assert run.player.played.digest == plain.player.played.digest, "a type without a stamp"


def test_what_has_no_pauses_goes_together() -> None:
    with Played(together=True, loop=True, stop_after=30) as run:
        assert run.end()[:30] == [1, 2, 3, 4, 5] * 6
        assert max(run.batches) > 1
        assert run.player.played.messages == len(run.sent) == sum(run.batches)
        assert [jump.from_ns for jump in run.jumps] == [at(5)] * len(run.jumps)
    with Played(50.0, together=True) as run:
        assert (run.end(), run.batches) == ([1, 2, 3, 4, 5], [])
    with Played(paused=True, together=True) as run:
        assert run.player.burst(2) == 2
        assert run.sent == [1, 2]
        run.player.resume()
        assert run.end() == [1, 2, 3, 4, 5]


def test_what_comes_before_damage_is_sent() -> None:
    def damaged(_: int | None) -> Iterator[Entry]:
        yield from ENTRIES
        raise ValueError("damaged")

    sent: list[int] = []

    def send(entries: Sequence[Entry]) -> bool:
        sent.extend(entry.seq for entry in entries)
        return True

    player = Player(damaged, lambda entry: send([entry]), SystemClock(), threading.Event(), rate=None, send_all=send)
    with pytest.raises(ValueError, match="damaged"):
        player.run()
    assert sent == [1, 2, 3, 4, 5] and player.played.messages == 5


def test_the_digest_of_large_messages_and_of_two_sides() -> None:
    kinds = (Kind.ROS_OUT, Kind.ROS_OUT, Kind.IGTL_OUT, Kind.ROS_OUT, Kind.IGTL_OUT)
    entries = [
        dataclasses.replace(entry, kind=kind, payload=(bytes([entry.seq]) * size,))
        for entry, kind, size in zip(ENTRIES, kinds, (1, 500_000, 2, 600_000, 700_000), strict=True)
    ]
    with Played(entries=lambda _: entries) as run:
        run.end()
    for side, chosen in (("ros", kinds[0]), ("igtl", kinds[2])):
        data = b"".join(entry.data() for entry in entries if entry.kind is chosen)
        assert run.player.sides[side].digest == hashlib.sha256(data).hexdigest()
        assert run.player.sides[side].bytes == len(data)
    whole = hashlib.sha256(b"".join(entry.data() for entry in entries))
    assert run.player.played.digest == whole.hexdigest()
    player = Player(lambda _: entries, lambda _: True, SystemClock(), threading.Event(), rate=None, digest=False)
    assert player.run().digest is None and player.sides["ros"].digest is None
