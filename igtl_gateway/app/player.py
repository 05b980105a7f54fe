"""The player: sends the entries of a recording, each when it is due, and can be paused, stepped and moved."""

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
from igtl_gateway.base.buffers import total_size
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import ConfigError, RosError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.replay.playback import PlaybackClock, checked_rate
from igtl_gateway.replay.restamp import Restamper
from igtl_gateway.replay.simclock import is_tick
from igtl_gateway.replay.timeline import SessionTimeline

#: Interval of the checks of the stop event, and of the ticks of simulated time during a pause.
_POLL_S = 0.1
#: Bounds of a batch, in messages, bytes and nanoseconds.  Without pauses, messages are sent in batches.  A batch ends
#: at the number of bytes; the next batch is smaller if collecting and sending took longer than the time.
_BATCH, _BATCH_BYTES, _BATCH_NS = 512, 1 << 18, 10_000_000
#: A number above that of the messages of any recording.
_ALL = 1 << 62

_SIDES = {Kind.IGTL_IN: "igtl", Kind.IGTL_OUT: "igtl", Kind.ROS_IN: "ros", Kind.ROS_OUT: "ros"}

#: Returns the entries from a recorded time (UTC ns; None: the beginning), preceded by the latched state at that time.
Feed = Callable[[int | None], Iterable[Entry]]


@dataclass(slots=True)
class PlaybackCounts:
    """Counts of the messages sent so far."""

    messages: int = 0
    bytes: int = 0
    without_peer: int = 0  #: messages without a connected peer; included in ``messages``
    by_stream: Counter[str] = field(default_factory=Counter)
    refused: Counter[tuple[str, str]] = field(default_factory=Counter)  #: messages not sent, by stream and reason
    left_out: int = 0  #: messages that no connected peer can read; not in ``messages``
    _digest: Digest | None = field(default_factory=Digest)

    def add(self, entries: Sequence[Entry], delivered: bool) -> None:
        self.messages += len(entries)
        self.without_peer += 0 if delivered else len(entries)
        self.by_stream.update([entry.channel for entry in entries])
        parts = [part for entry in entries for part in entry.payload]
        size = total_size(parts)
        self.bytes += size
        if self._digest:
            self._digest.update(parts, size)

    def copy(self) -> PlaybackCounts:
        """Return an independent copy."""
        digest = self._digest.copy() if self._digest else None
        return PlaybackCounts(
            self.messages,
            self.bytes,
            self.without_peer,
            Counter(self.by_stream),
            Counter(self.refused),
            self.left_out,
            digest,
        )

    @property
    def digest(self) -> str | None:
        """SHA-256 of all bytes in the order in which they were sent; None if it is not computed."""
        return self._digest.hexdigest() if self._digest else None


@dataclass(frozen=True, slots=True)
class Jump:
    """A jump of the playback to another recorded time.

    Attributes:
        why: ``"seek"`` or ``"loop"``.
        from_ns: recorded time before the jump, UTC ns; None before the first entry.
        to_ns: recorded time after the jump, UTC ns; None: the beginning.
    """

    why: Literal["seek", "loop"]
    from_ns: int | None
    to_ns: int | None


class _NextAction(Enum):
    SEND = auto()
    JUMP = auto()
    END = auto()


class Player:
    """Sends entries, each when it is due, without loss: a slow reader slows the replay down.

    `run` plays.  All other methods may be called from any thread at the same time.

    Args:
        feed: returns the entries to send.
        send: sends one entry, and returns whether a peer was connected or ROS received it; may block.  If it raises
            RosError, the entry is counted as refused, and not as sent.
        clock: source of monotonic time for the pace, and of UTC for new stamps.
        stop: ends the playback when set.
        rate: recorded seconds per real second; None: at the highest rate without loss.
        paused: start paused.
        loop: repeat until stopped.
        span: first and last recorded time of a seek, UTC ns.
        start_ns: recorded time of the start, and of each repetition, UTC ns; None: the first entry.
        restamp: computes new stamps; None: the stamps do not change.
        admit: returns an entry as its receivers can read it; None if none of them can.
        admit_all: returns those of several that a receiver can read, each as ``admit`` does; None: ``admit`` for each.
        on_jump: called at every jump, in the thread of `run`.
        send_all: sends several entries in order, as ``send`` does for one; used if there are no pauses between them.
        digest: whether to compute `PlaybackCounts.digest`, which takes longer than the rest of the player.
        pace: timeline of the session, so that the playback skips jumps of its clock; None: skip none.
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
        admit: Callable[[Entry], Entry | None] = lambda entry: entry,
        admit_all: Callable[[Sequence[Entry]], Sequence[Entry]] | None = None,
        on_jump: Callable[[Jump], None] = lambda jump: None,
        send_all: Callable[[Sequence[Entry]], bool] | None = None,
        digest: bool = True,
        pace: SessionTimeline | None = None,
    ) -> None:
        self.played = PlaybackCounts() if digest else PlaybackCounts(_digest=None)
        # counts by side; with one side only, its counts are ``played`` itself
        self.sides: dict[str, PlaybackCounts] = {}
        self._feed = feed
        self._send = send
        self._clock = clock
        self._stop = stop
        self._loop = loop
        self._span = span
        self._start_ns = start_ns
        self._restamp = restamp
        self._admit = admit
        self._admit_all = admit_all or (lambda entries: [each for each in map(admit, entries) if each])
        self._on_jump = on_jump
        self._send_all = send_all
        self._changed = threading.Condition()  # guards the attributes below
        self._playback = PlaybackClock(rate, paused, pace)
        self._jump: Jump | None = None
        self._to_step = 0
        self._stepped = 0
        self._over = False
        self._in_pass = 0  # messages since the last jump, without its latched state
        self._tick: Entry | None = None
        self._entries: Iterator[Entry] = iter(())
        self._ahead: deque[Entry] = deque()  # taken from the feed, not yet sent
        self._feed_error: Exception | None = None  # raised by the feed after the entries of ``_ahead``
        self._batch_size = 1

    # -- for any thread -------------------------------------------------------------------------------------------

    @property
    def paused(self) -> bool:
        with self._changed:
            return self._playback.paused

    @property
    def rate(self) -> float | None:
        """Recorded seconds per real second; None: at the highest rate without loss."""
        with self._changed:
            return self._playback.rate

    @property
    def position_ns(self) -> int | None:
        """The current recorded time, UTC ns; None before the first entry."""
        with self._changed:
            return self._playback.position_ns(self._clock.monotonic_ns())

    def pause(self) -> None:
        with self._changed:
            self._playback.pause(self._clock.monotonic_ns())
            self._changed.notify_all()

    def resume(self) -> None:
        with self._changed:
            self._end_steps()
            self._playback.resume(self._clock.monotonic_ns())
            self._changed.notify_all()

    def toggle(self) -> None:
        with self._changed:
            if self._playback.paused:
                self.resume()
            else:
                self.pause()

    def set_rate(self, rate: float) -> bool:
        """Set the rate; return False if it is invalid."""
        try:
            checked_rate(rate)
        except ConfigError:
            return False
        with self._changed:
            self._playback.set_rate(rate, self._clock.monotonic_ns())
            self._changed.notify_all()
        return True

    def seek(self, recorded_ns: int) -> bool:
        """Continue at this recorded time (UTC ns), with its latched state; return False if it is outside the span."""
        with self._changed:
            if self._over or not self._span[0] <= recorded_ns <= self._span[1]:
                return False
            self._jump = Jump("seek", self._playback.position_ns(self._clock.monotonic_ns()), recorded_ns)
            self._changed.notify_all()
        return True

    def step(self, count: int = 1) -> bool:
        """Play the next messages (0: all remaining) without pauses; return False if not paused, or at the end."""
        with self._changed:
            if self._over or not self._playback.paused:
                return False
            self._to_step += count or _ALL
            self._changed.notify_all()
            return True

    def burst(self, count: int) -> int:
        """Play the next messages as `step` does, wait for the end, and return their number."""
        with self._changed:
            begun = self._stepped
            if self.step(count):
                self._changed.wait_for(lambda: self._over or not self._to_step)
            return self._stepped - begun

    # -- the playback ---------------------------------------------------------------------------------------------

    def run(self) -> PlaybackCounts:
        """Play to the end, or until stopped, and return the counts.  Raises the exceptions of the feed."""
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
        self._feed_error = None
        self._entries = iter(self._feed(start_ns))

    def _next(self) -> Entry | None:
        if self._ahead:
            return self._ahead.popleft()
        if self._feed_error:
            raise self._feed_error
        return next(self._entries, None)

    def _send_batch(self, entry: Entry, send_all: Callable[[Sequence[Entry]], bool]) -> None:
        """Send an entry, without pauses together with the entries that follow."""
        begun_ns = self._clock.monotonic_ns()
        self._collect_batch(entry, begun_ns)
        with self._changed:
            unlimited = self._playback.rate is None and not self._playback.paused
            if unlimited and not self._jump:
                batch = [entry, *self._ahead]
                self._ahead.clear()
                # before sending: a rate that is set in the meantime applies after this batch
                state = next((at for at, each in enumerate(batch) if not self._is_state(each)), len(batch))
                if state < len(batch):  # the latched state is first in a batch
                    self._playback.reached(batch[-1].stamp_ns, begun_ns)
                    self._in_pass += len(batch) - state
            else:
                batch = []
        if not batch:
            self._send_entry(entry)
            return
        if self._restamp:
            batch = [self._restamped(each, self._restamp) for each in batch]
        admitted = self._admit_all(batch)
        self.played.left_out += len(batch) - len(admitted)
        if admitted:
            self._count(admitted, send_all(admitted))
        quick = self._clock.monotonic_ns() - begun_ns < _BATCH_NS
        self._batch_size = min(2 * self._batch_size, _BATCH) if quick else max(self._batch_size // 2, 1)

    def _collect_batch(self, entry: Entry, begun_ns: int) -> None:
        """Read more entries from the feed into ``_ahead``, up to the bounds of a batch."""
        if self._playback.rate is not None or self._playback.paused or self._feed_error:
            return
        ahead, entries, monotonic_ns = self._ahead, self._entries, self._clock.monotonic_ns
        size = entry.size + sum(each.size for each in ahead)
        left, until_ns = self._batch_size - 1 - len(ahead), begun_ns + _BATCH_NS
        try:
            while left > 0 and size < _BATCH_BYTES and monotonic_ns() < until_ns:
                following = next(entries, None)
                if following is None:
                    return
                ahead.append(following)
                left -= 1
                size += total_size(following.payload)
        except Exception as error:  # raised after the entries before it are sent
            self._feed_error = error

    def _await_turn(self, entry: Entry | None) -> _NextAction:
        """Wait until an entry is due or the playback changes, and return the next action.

        Args:
            entry: the next entry; None at the end of the feed.
        """
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
                        self._end_steps()  # a seek behind the last message: wait for another seek
                        self._changed.wait(_POLL_S)
                        continue
                    # a loop over no messages would never wait
                    if not (self._loop and self._in_pass):
                        return _NextAction.END
                    if self._to_step > _ALL // 2:  # a step of all remaining messages has ended
                        self._end_steps()
                    self._jump = Jump("loop", position_ns, self._start_ns)
                    return _NextAction.JUMP
                left_ns = 0 if self._is_state(entry) else self._playback.wait_ns(entry.stamp_ns, now_ns)
                if left_ns == 0 or (left_ns is None and self._to_step):
                    return _NextAction.SEND
                if left_ns is None and self._tick:
                    with suppress(RosError):
                        self._send(self._tick)  # for nodes that start during the pause
                self._changed.wait(_POLL_S if left_ns is None else min(left_ns / NS_PER_S, _POLL_S))

    def _end_steps(self) -> None:
        self._to_step = 0
        self._changed.notify_all()

    def _is_state(self, entry: Entry) -> bool:
        """Return whether an entry is sent immediately after a jump; this includes the tick of the jump's target."""
        return self._playback.is_state(entry.stamp_ns - is_tick(entry))

    def _send_entry(self, entry: Entry) -> None:
        stamped = self._restamped(entry, self._restamp) if self._restamp else entry
        sent = self._admit(stamped)
        if sent is None:
            self.played.left_out += 1
            with self._changed:
                if not self._is_state(entry):
                    self._playback.reached(entry.stamp_ns, self._clock.monotonic_ns())
            return
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
        """Count sent entries, all of one side."""
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
