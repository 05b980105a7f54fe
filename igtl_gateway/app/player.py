"""The player: sends a recording's entries, each when it is due, and obeys whoever holds the keys."""

from __future__ import annotations

import dataclasses
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Literal

from igtl_gateway.app.digest import Digest
from igtl_gateway.buffers import total_size
from igtl_gateway.clock import Clock
from igtl_gateway.errors import ConfigError, RosError
from igtl_gateway.replay.playback import PlaybackClock, checked_rate
from igtl_gateway.replay.restamp import Restamper
from igtl_gateway.replay.simclock import is_tick
from igtl_gateway.replay.timeline import SessionTimeline
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.stamp import NS_PER_S

#: So long at most between two looks at the stop event; also between two repetitions of the clock while paused.
_LOOK_S = 0.1
#: Without pauses between them messages are sent together: so many at most, so many bytes from which on no more are
#: taken, and fewer where collecting and sending takes longer than this.
_TOGETHER, _TOGETHER_BYTES, _TOGETHER_NS = 512, 1 << 18, 10_000_000
#: More messages than any recording has.
_ALL = 1 << 62

_SIDES = {Kind.IGTL_IN: "igtl", Kind.IGTL_OUT: "igtl", Kind.ROS_IN: "ros", Kind.ROS_OUT: "ros"}

#: Entries from a moment on (UTC ns; None: from the beginning), the state of that moment before them.
Feed = Callable[[int | None], Iterable[Entry]]


@dataclass(slots=True)
class PlaybackCounts:
    """What was sent so far."""

    messages: int = 0
    bytes: int = 0
    unheard: int = 0  #: of the messages, those for which nobody was there
    by_stream: Counter[str] = field(default_factory=Counter)
    refused: Counter[tuple[str, str]] = field(default_factory=Counter)  #: not sent: by stream and reason
    _digest: Digest | None = field(default_factory=Digest)

    def add(self, entries: Sequence[Entry], delivered: bool) -> None:
        self.messages += len(entries)
        self.unheard += 0 if delivered else len(entries)
        self.by_stream.update([entry.channel for entry in entries])
        parts = [part for entry in entries for part in entry.payload]
        size = total_size(parts)
        self.bytes += size
        if self._digest:
            self._digest.update(parts, size)

    def copy(self) -> PlaybackCounts:
        """The same, to go on by itself."""
        digest = self._digest.copy() if self._digest else None
        return PlaybackCounts(
            self.messages, self.bytes, self.unheard, Counter(self.by_stream), Counter(self.refused), digest
        )

    @property
    def digest(self) -> str | None:
        """SHA-256 of all bytes in the order in which they were sent; None if it was not wanted."""
        return self._digest.hexdigest() if self._digest else None


@dataclass(frozen=True, slots=True)
class Jump:
    """The playback left the order of the recording.

    Attributes:
        why: ``"seek"`` or ``"loop"``.
        from_ns: where it was, in UTC ns of the recording; None if nowhere yet.
        to_ns: where it goes on; None: at the beginning.
    """

    why: Literal["seek", "loop"]
    from_ns: int | None
    to_ns: int | None


class _NextAction(Enum):
    SEND = auto()
    JUMP = auto()
    END = auto()


class Player:
    """Sends entries, each when it is due, none lost: a slow reader slows the replay down.

    `run` plays; all else may be called from any thread meanwhile.

    Args:
        feed: opens what is sent.
        send: sends one entry; may wait; tells whether anybody was there.  Where it raises RosError, the entry is
            counted as refused and not as sent.
        clock: paces, and gives new stamps.
        stop: ends the playback when set.
        rate: recorded seconds per real second; None: as fast as possible.
        paused: begin so.
        loop: begin again at the end, until stopped.
        span: UTC ns of the recording between which one may seek, both included.
        start_ns: where to begin, and to loop to; None: at the first entry.
        restamp: gives new stamps; None: all stay as they are.
        on_jump: told of every jump, in the thread of `run`.
        send_all: as ``send`` for several entries of one side, in order: for those between which there is no pause.
        digest: whether to compute what `PlaybackCounts.digest` tells, which takes longer than all else.
        pace: of the session.
    """

    def __init__(
        self,
        feed: Feed,
        send: Callable[[Entry], bool],
        clock: Clock,
        stop: threading.Event,
        *,
        rate: float | None = 1.0,
        paused: bool = False,
        loop: bool = False,
        span: tuple[int, int] = (0, _ALL),
        start_ns: int | None = None,
        restamp: Restamper | None = None,
        on_jump: Callable[[Jump], None] = lambda jump: None,
        send_all: Callable[[Sequence[Entry]], bool] | None = None,
        digest: bool = True,
        pace: SessionTimeline | None = None,
    ) -> None:
        self.played = PlaybackCounts() if digest else PlaybackCounts(_digest=None)
        # while there is one side only, it is the whole
        self.sides: dict[str, PlaybackCounts] = {}
        self._feed = feed
        self._send = send
        self._clock = clock
        self._stop = stop
        self._loop = loop
        self._span = span
        self._start_ns = start_ns
        self._restamp = restamp
        self._on_jump = on_jump
        self._send_all = send_all
        self._changed = threading.Condition()  # guards all below
        self._playback = PlaybackClock(rate, paused, pace)
        self._jump: Jump | None = None
        self._to_step = 0
        self._stepped = 0
        self._over = False
        self._in_pass = 0  # messages since the last jump, its state not counted
        self._tick: Entry | None = None
        self._entries: Iterator[Entry] = iter(())
        self._ahead: deque[Entry] = deque()  # taken from the feed, not yet sent
        self._damage: Exception | None = None  # what the feed raised behind these
        self._together = 1

    # -- for any thread -------------------------------------------------------------------------------------------

    @property
    def paused(self) -> bool:
        with self._changed:
            return self._playback.paused

    @property
    def rate(self) -> float | None:
        """Recorded seconds per real second; None: as fast as possible."""
        with self._changed:
            return self._playback.rate

    @property
    def position_ns(self) -> int | None:
        """The moment of the recording that is now; None before the first entry."""
        with self._changed:
            return self._playback.position_ns(self._clock.monotonic_ns())

    def pause(self) -> None:
        with self._changed:
            self._playback.pause(self._clock.monotonic_ns())
            self._changed.notify_all()

    def resume(self) -> None:
        with self._changed:
            self._no_more_steps()
            self._playback.resume(self._clock.monotonic_ns())
            self._changed.notify_all()

    def toggle(self) -> None:
        with self._changed:
            if self._playback.paused:
                self.resume()
            else:
                self.pause()

    def set_rate(self, rate: float) -> bool:
        """Go on at this rate; False if there is no such rate."""
        try:
            checked_rate(rate)
        except ConfigError:
            return False
        with self._changed:
            self._playback.set_rate(rate, self._clock.monotonic_ns())
            self._changed.notify_all()
        return True

    def seek(self, recorded_ns: int) -> bool:
        """Go on from this moment, with the state that was there; False if it is not among what is played."""
        with self._changed:
            if self._over or not self._span[0] <= recorded_ns <= self._span[1]:
                return False
            self._jump = Jump("seek", self._playback.position_ns(self._clock.monotonic_ns()), recorded_ns)
            self._changed.notify_all()
        return True

    def step(self, count: int = 1) -> bool:
        """While paused: play the next messages (0: all that are left), at once.  False if not paused, or at the end."""
        with self._changed:
            if self._over or not self._playback.paused:
                return False
            self._to_step += count or _ALL
            self._changed.notify_all()
            return True

    def burst(self, count: int) -> int:
        """`step`, and wait for it: how many were played."""
        with self._changed:
            begun = self._stepped
            if self.step(count):
                self._changed.wait_for(lambda: self._over or not self._to_step)
            return self._stepped - begun

    # -- the playback ---------------------------------------------------------------------------------------------

    def run(self) -> PlaybackCounts:
        """Play to the end, or until stopped.  What the feed raises comes out here."""
        try:
            self._run()
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()
        return self.played

    def _run(self) -> None:
        self._begin(self._start_ns)
        while True:
            entry = self._next()
            turn = self._await_turn(entry)
            if turn is _NextAction.END:
                return
            if turn is _NextAction.JUMP:
                jump, self._jump = self._jump, None
                if jump:
                    self._on_jump(jump)
                    self._begin(jump.to_ns)
            elif entry and self._send_all:
                self._send_batch(entry, self._send_all)
            elif entry:
                self._send_entry(entry)

    def _begin(self, start_ns: int | None) -> None:
        with self._changed:
            self._playback.jump(start_ns, self._clock.monotonic_ns())
            self._in_pass = 0
        if self._restamp:
            self._restamp.begin(start_ns, self._clock.utc_ns())
        self._ahead.clear()
        self._damage = None
        self._entries = iter(self._feed(start_ns))

    def _next(self) -> Entry | None:
        if self._ahead:
            return self._ahead.popleft()
        if self._damage:
            raise self._damage
        return next(self._entries, None)

    def _send_batch(self, entry: Entry, send_all: Callable[[Sequence[Entry]], bool]) -> None:
        """Send an entry, and those that are due with it where there are no pauses."""
        begun_ns = self._clock.monotonic_ns()
        self._collect_batch(entry, begun_ns)
        with self._changed:
            unlimited = self._playback.rate is None and not self._playback.paused
            if unlimited and not self._jump:
                batch = [entry, *self._ahead]
                self._ahead.clear()
                # beforehand: whoever sets a rate meanwhile goes on behind them
                state = next((at for at, each in enumerate(batch) if not self._is_state(each)), len(batch))
                if state < len(batch):  # the state comes before all else
                    self._playback.reached(batch[-1].stamp_ns, begun_ns)
                    self._in_pass += len(batch) - state
            else:
                batch = []
        if not batch:
            self._send_entry(entry)
            return
        if self._restamp:
            batch = [self._restamped(each, self._restamp) for each in batch]
        self._count(batch, send_all(batch))
        quick = self._clock.monotonic_ns() - begun_ns < _TOGETHER_NS
        self._together = min(2 * self._together, _TOGETHER) if quick else max(self._together // 2, 1)

    def _collect_batch(self, entry: Entry, begun_ns: int) -> None:
        """Take more from the feed, if it gives them soon."""
        if self._playback.rate is not None or self._playback.paused or self._damage:
            return
        ahead, entries, monotonic_ns = self._ahead, self._entries, self._clock.monotonic_ns
        size = entry.size + sum(each.size for each in ahead)
        left, until_ns = self._together - 1 - len(ahead), begun_ns + _TOGETHER_NS
        try:
            while left > 0 and size < _TOGETHER_BYTES and monotonic_ns() < until_ns:
                following = next(entries, None)
                if following is None:
                    return
                ahead.append(following)
                left -= 1
                size += total_size(following.payload)
        except Exception as error:  # what came before it is sent first
            self._damage = error

    def _await_turn(self, entry: Entry | None) -> _NextAction:
        """Wait until it is clear what comes next; ``entry`` is None at the end."""
        with self._changed:
            while True:
                if self._stop.is_set():
                    return _NextAction.END
                if self._jump:
                    return _NextAction.JUMP
                now_ns = self._clock.monotonic_ns()
                if entry is None:
                    position_ns = self._playback.position_ns(now_ns)
                    if self._playback.paused and not self._in_pass and position_ns is not None:
                        self._no_more_steps()  # a jump behind the last message: one may want to jump back
                        self._changed.wait(_LOOK_S)
                        continue
                    # a pass without messages would be followed by the same at once, for ever
                    if not (self._loop and self._in_pass):
                        return _NextAction.END
                    if self._to_step > _ALL // 2:  # "all that are left": none is
                        self._no_more_steps()
                    self._jump = Jump("loop", position_ns, self._start_ns)
                    return _NextAction.JUMP
                left_ns = 0 if self._is_state(entry) else self._playback.wait_ns(entry.stamp_ns, now_ns)
                if left_ns == 0 or (left_ns is None and self._to_step):
                    return _NextAction.SEND
                if left_ns is None and self._tick:
                    with suppress(RosError):
                        self._send(self._tick)  # nodes that come while it is paused want to know the time, too
                self._changed.wait(_LOOK_S if left_ns is None else min(left_ns / NS_PER_S, _LOOK_S))

    def _no_more_steps(self) -> None:
        self._to_step = 0
        self._changed.notify_all()

    def _is_state(self, entry: Entry) -> bool:
        """Whether it is sent at once after a jump; the tick that tells the jump's target is."""
        return self._playback.is_state(entry.stamp_ns - is_tick(entry))

    def _send_entry(self, entry: Entry) -> None:
        sent = self._restamped(entry, self._restamp) if self._restamp else entry
        try:
            delivered = self._send(sent)
        except RosError as error:
            self.played.refused[entry.channel, str(error)] += 1
        else:
            if is_tick(entry):
                self._tick = sent
            else:
                self._count([sent], delivered)
        with self._changed:
            now_ns = self._clock.monotonic_ns()
            if self._is_state(entry):
                return
            self._playback.reached(entry.stamp_ns, now_ns)
            if is_tick(entry):
                return
            self._in_pass += 1
            if self._to_step:
                self._to_step -= 1
                self._stepped += 1
                self._changed.notify_all()

    def _restamped(self, entry: Entry, restamp: Restamper) -> Entry:
        return dataclasses.replace(entry, payload=restamp.payload(entry, self._clock.utc_ns()))

    def _count(self, entries: Sequence[Entry], delivered: bool) -> None:
        """These were sent, all to one side."""
        side = _SIDES[entries[0].kind]
        if side not in self.sides:
            for other in self.sides:
                self.sides[other] = self.played.copy()
            self.sides[side] = (
                PlaybackCounts(_digest=Digest() if self.played.digest else None) if self.sides else self.played
            )
        self.played.add(entries, delivered)
        if len(self.sides) > 1:
            self.sides[side].add(entries, delivered)
