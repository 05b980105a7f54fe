"""The I/O thread: waits for sockets, for requests of other threads, and for timers, and runs their actions.

The sockets take turns (``turns``): one that has much to do waits for the others.  Requests and timers wait for no turn.

Each action has a rescue beside it.  An action that raises ends only itself: the exception goes to its rescue, or,
where there is none, to ``on_error``, and the loop goes on.
"""

from __future__ import annotations

import heapq
import logging
import selectors
import socket
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from igtl_gateway.base.clock import Clock, thread_ns
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.tcp.turns import Turn, Turns

_log = logging.getLogger(__name__)

READ = selectors.EVENT_READ
WRITE = selectors.EVENT_WRITE

#: Turns are taken for this time until the sockets are looked at again, which costs a tenth of it beside 20 busy peers.
_LOOK_NS = 250_000
_PAUSE_S = 0.1  # after a turn that failed as a whole: the next might fail as quickly


class Watchable(Protocol):
    """A socket, or an object with its descriptor."""

    def fileno(self) -> int: ...


Action = Callable[[], None]
Rescue = Callable[[Exception], None]


class Loop:
    """One selector and the thread that runs ``body``, which is to call ``run_once`` again and again.

    ``stopping`` is set by the owner when the end has begun; any thread may read it.  ``looked_ns`` is the time of the
    last select: a socket whose bytes had arrived by then has had its turn before any timer, or waits for it.
    """

    def __init__(self, clock: Clock, body: Action, on_error: Rescue) -> None:
        self.stopping = False
        self.looked_ns = clock.monotonic_ns()
        self._clock = clock
        self._on_error = on_error
        self._thread = threading.Thread(target=body, name="igtl-tcp", daemon=True)
        self._never = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self._todo: deque[tuple[Action, Rescue]] = deque()
        self._turns = Turns()
        self._timers: list[tuple[int, int, Action, Rescue]] = []
        self._serial = 0
        self._wakeup = Turn(self._drain_wakeups, on_error)  # it waits for no turn
        self._selector.register(self._wake_in, READ, self._wakeup)

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    @property
    def started(self) -> bool:
        return self._thread.ident is not None

    def start(self) -> None:
        self._thread.start()

    def join(self) -> None:
        self._thread.join()

    def in_loop_thread(self) -> bool:
        """Whether the caller is the I/O thread."""
        return threading.get_ident() == self._thread.ident

    def now(self) -> int:
        """Monotonic nanoseconds."""
        return self._clock.monotonic_ns()

    def call_soon(self, action: Action, rescue: Rescue | None = None) -> None:
        """Have the I/O thread run this action soon."""
        self._todo.append((action, rescue or self._on_error))
        if not self.in_loop_thread():
            self.wake()

    def wake(self) -> None:
        with suppress(OSError):  # full: it is awake already; closed: it has ended
            self._wake_out.send(b"\0")

    # ── for the I/O thread ────────────────────────────────────────────────────────────────────────────────────

    def call_later(self, delay_s: float, action: Action, rescue: Rescue | None = None) -> None:
        """Run this action in ``delay_s`` seconds."""
        self._serial += 1
        due_ns = self.now() + round(delay_s * NS_PER_S)
        heapq.heappush(self._timers, (due_ns, self._serial, action, rescue or self._on_error))

    def watch(self, sock: Watchable, events: int, action: Callable[[int], None], rescue: Rescue | None = None) -> None:
        """Call the action, with the ready events, when the socket is ready for one of these events and has its turn."""
        try:
            turn = self._selector.get_key(sock).data
            turn.action, turn.rescue = action, rescue or self._on_error
        except KeyError:
            turn = Turn(action, rescue or self._on_error)
        self.watch_in_turn(sock, events, turn)

    def watch_in_turn(self, sock: Watchable, events: int, turn: Turn) -> None:
        """As ``watch``, for a taker of turns that lasts longer than the watching."""
        try:
            self._selector.modify(sock, events, turn)
        except KeyError:
            self._selector.register(sock, events, turn)

    def unwatch(self, sock: Watchable) -> None:
        """Watch the socket no longer, and give up its turn; always before it is closed."""
        with suppress(KeyError):
            self._selector.unregister(sock).data.give_up()

    def ask(self, turn: Turn) -> None:
        """Have a turn, with or without an event."""
        self._turns.ask(turn)

    def run_once(self, deadline_ns: int | None) -> None:
        """Wait for actions, not beyond the deadline, and run them."""
        try:
            self._run_once(deadline_ns)
        except Exception as exc:
            self._handle_error(self._on_error, exc)
            self._never.wait(_PAUSE_S)

    def run(self, action: Action, rescue: Rescue | None = None) -> None:
        """Run this action now."""
        try:
            action()
        except Exception as exc:
            self._handle_error(rescue or self._on_error, exc)

    def close(self) -> None:
        self._selector.close()
        self._wake_in.close()
        self._wake_out.close()

    def _run_once(self, deadline_ns: int | None) -> None:
        if self._timers and (deadline_ns is None or self._timers[0][0] < deadline_ns):
            deadline_ns = self._timers[0][0]
        timeout = None
        if self._todo or self._turns:
            timeout = 0.0
        elif deadline_ns is not None:
            timeout = max(0, deadline_ns - self.now()) / NS_PER_S
        ready = self._selector.select(timeout)
        if not ready and timeout:
            # a process that was stopped while it waited (SIGSTOP, a debugger) comes back without having looked
            ready = self._selector.select(0)
        self.looked_ns = self.now()
        for key, mask in ready:
            if key.data is self._wakeup:
                self._drain_wakeups(mask)
            else:
                key.data.mask |= mask
                self._turns.ask(key.data)
        self._take_turns()
        while self._todo:
            self.run(*self._todo.popleft())
        # after the sockets, see ``looked_ns``
        while self._timers and self._timers[0][0] <= self.now():
            self.run(*heapq.heappop(self._timers)[2:])

    def _take_turns(self) -> None:
        """Let those that wait have their turns, until it is time to look at the sockets again."""
        now_ns, spent_ns = self.looked_ns, 0
        while now_ns - self.looked_ns < _LOOK_NS and (turn := self._turns.next()):
            spent_ns = spent_ns or thread_ns()
            mask, turn.mask, turn.has_more = turn.mask, 0, False
            try:
                turn.action(mask)
            except Exception as exc:
                self._handle_error(turn.rescue, exc)
            begun_ns, spent_ns, now_ns = spent_ns, thread_ns(), self.now()
            self._turns.used(turn, spent_ns - begun_ns)

    def _handle_error(self, rescue: Rescue, exc: Exception) -> None:
        try:
            rescue(exc)
        except Exception:  # the last resort: there is no other handler
            _log.exception("after %r, its rescue raised", exc)

    def _drain_wakeups(self, mask: int) -> None:
        with suppress(BlockingIOError):
            self._wake_in.recv(4096)
