"""The handshake of one layer of a connection (TLS, WebSocket), within a time."""

from __future__ import annotations

from collections.abc import Callable

from igtl_gateway.edges.tcp.layer import Layer, LayerError
from igtl_gateway.edges.tcp.loop import READ, WRITE, Loop

_VERDICT_S = (
    0.25  # the longest time for a TLS server without tickets to refuse us: several round trips across a continent
)


class Handshake:
    """The handshake of one connection; of the I/O thread alone.

    It ends with one call: ``done``, or ``refused`` with reason and detail.  The callee owns the socket then.
    """

    def __init__(
        self,
        sock: Layer,
        loop: Loop,
        done: Callable[[], None],
        refused: Callable[[str, str], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self.sock = sock
        self._loop = loop
        self._done = done
        self._refused = refused
        self._failed = failed
        self._over = False
        self._waiting = False  # for the server's verdict

    def begin(self, timeout_s: float) -> None:
        self._loop.call_later(timeout_s, self._timed_out, self._failed)
        self._step(0)

    def yield_to_newer(self) -> None:
        """End in favour of a handshake that began later."""
        self._finish()
        self._refused(f"no {self.sock.NAME} handshake before others came", "")

    def cancel(self) -> None:
        """End without a call, and close."""
        self._finish()
        self.sock.close()

    def _finish(self) -> None:
        self._over = True
        self._loop.unwatch(self.sock)

    def _step(self, _mask: int) -> None:
        if self._over:  # something else in the same turn ended it
            return
        try:
            done = self.sock.do_handshake()
        except LayerError as error:
            self._finish()
            self._refused(error.reason, error.detail)
        except OSError as error:
            self._finish()
            self._refused(f"connection lost in the {self.sock.NAME} handshake", f"{error.strerror or error}")
        else:
            if done:
                self._finish()
                self._done()
            else:
                if self.sock.shaken and not self._waiting:
                    self._waiting = True
                    self._loop.call_later(_VERDICT_S, self._no_verdict, self._failed)
                events = READ | (WRITE if self.sock.pending else 0)
                self._loop.watch(self.sock, events, self._step, self._failed)

    def _no_verdict(self) -> None:
        """The server has not refused us within the time for that."""
        if not self._over:
            self._finish()
            self._done()

    def _timed_out(self) -> None:
        if not self._over:
            self._finish()
            self._refused(f"no {self.sock.NAME} handshake in time", "")
