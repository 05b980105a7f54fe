"""The I/O thread: waits for sockets, for requests of other threads, and for timers, and runs their actions.

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

from igtl_gateway.clock import Clock
from igtl_gateway.stamp import NS_PER_S

_log = logging.getLogger(__name__)

READ = selectors.EVENT_READ
WRITE = selectors.EVENT_WRITE

_PAUSE_S = 0.1  # after a turn that failed as a whole: the next might fail as quickly


class Watchable(Protocol):
    """A socket, or an object with its descriptor."""

    def fileno(self) -> int: ...


Action = Callable[[], None]
Rescue = Callable[[Exception], None]


class Loop:
    """One selector and the thread that runs ``body``, which is to call ``run_once`` again and again.

    ``stopping`` is set by the owner when the end has begun; any thread may read it.  ``looked_ns`` is the time of the
    last select: bytes that had arrived by then are read before any action or timer of that turn, however long it takes.
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
        self._timers: list[tuple[int, int, Action, Rescue]] = []
        self._serial = 0
        self.watch(self._wake_in, READ, self._drain_wakeups)

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
        """Call the action, with the ready events, whenever the socket is ready for one of these events."""
        data = (action, rescue or self._on_error)
        try:
            self._selector.modify(sock, events, data)
        except KeyError:
            self._selector.register(sock, events, data)

    def unwatch(self, sock: Watchable) -> None:
        """Watch the socket no longer; always before it is closed."""
        with suppress(KeyError):
            self._selector.unregister(sock)

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
        if self._todo:
            timeout = 0.0
        elif deadline_ns is not None:
            timeout = max(0, deadline_ns - self.now()) / NS_PER_S
        ready = self._selector.select(timeout)
        if not ready and timeout:
            # a process that was stopped while it waited (SIGSTOP, a debugger) comes back without having looked
            ready = self._selector.select(0)
        self.looked_ns = self.now()
        for key, mask in ready:
            action, rescue = key.data
            try:
                action(mask)
            except Exception as exc:
                self._handle_error(rescue, exc)
        while self._todo:
            self.run(*self._todo.popleft())
        # after the sockets, see ``looked_ns``
        while self._timers and self._timers[0][0] <= self.now():
            self.run(*heapq.heappop(self._timers)[2:])

    def _handle_error(self, rescue: Rescue, exc: Exception) -> None:
        try:
            rescue(exc)
        except Exception:  # the last resort: there is no other handler
            _log.exception("after %r, its rescue raised", exc)

    def _drain_wakeups(self, mask: int) -> None:
        with suppress(BlockingIOError):
            self._wake_in.recv(4096)
