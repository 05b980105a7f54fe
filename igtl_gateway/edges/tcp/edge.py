"""``TcpEdge``: the interface of the OpenIGTLink side, and its life from start to stop."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Literal

from igtl_gateway.base.buffers import Buffer, join, total_size
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.globs import matches
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.reserved import ReservedPorts
from igtl_gateway.edges.tcp.addresses import Addresses
from igtl_gateway.edges.tcp.aside import Aside
from igtl_gateway.edges.tcp.link import FLUSH_S
from igtl_gateway.edges.tcp.link_info import LinkCounters, LinkInfo, PeerLimits
from igtl_gateway.edges.tcp.link_parts import Admission, LinkContext, OpenAdmission, Refusals
from igtl_gateway.edges.tcp.loop import Loop
from igtl_gateway.edges.tcp.native_reader import NativeReader
from igtl_gateway.edges.tcp.outbox import Part
from igtl_gateway.edges.tcp.registry import LinkRegistry
from igtl_gateway.edges.tcp.reporter import Reporter
from igtl_gateway.edges.tcp.sockets import AllowList
from igtl_gateway.edges.tcp.tls import TlsFiles
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.native.passage import Link as NativeLink
from igtl_gateway.native.passage import Passage

_DRAIN_S = 0.25  # how long stop() waits for peers to close their side
_JOINED = 4096  # bytes of a message up to which one copied buffer is sent faster than several (3.5 µs against 5.5)
_LIMITS = PeerLimits()
_NO_FILES = TlsFiles()


def _ignore(_link: NativeLink) -> None:
    """Nothing is read natively."""


class TcpEdge:
    """Messages in by callback, messages out by ``send``.  Link numbers count from 1 and are never used twice.

    Callbacks come from the I/O thread, one at a time: for each link first ``on_link(number, True, note)``, then
    its messages, then ``on_link(number, False, note)``.  If one raises, a note reports it, and the thread goes on.

    The clock paces retries, stalls and notes; it must run by itself.

    Args:
        on_frame: link number and one whole message, unchecked; the buffer is the receiver's to keep.  It may return
            True for a message without valid content.
        on_link: a peer connected (True) or disconnected; the note's data has ``peer``, ``local``, ``role``, and, at
            the end, ``reason`` and the counts.
        on_note: link number (0 if none) and a fact: ``truncated``, ``too_large``, ``stalled``, ``unreachable``,
            ``idle``, ``out_of_memory``, ``queue_drop``, ``queue_full``, ``rate_limited``, ``refused``,
            ``tls_failed``, ``websocket_failed``, ``accept_failed``, ``connect_failed``, ``callback_failed``,
            ``internal_error``.
        clock: described above.
        limits: what a peer may cost.
        allow: networks (CIDR) whose peers may connect beside this host's own, or ``"any"``.
        tls: files for the connections with TLS.
        origins: whose pages may connect over WebSocket beside those of this machine (``https://HOST[:PORT]``, ``*``).
        passage: the native passage, whose streams the links may have; None: there is none.
        reserved: ports that are taken already; `listen` has them.
        admission: when large messages of peers pass; None: at once.
        when_full: ``"drop"``: ``send`` never waits, see ``Outbox``; ``"block"``: ``send`` waits for room and
            nothing is lost while the link is up (except in callbacks, which must not wait for themselves).

    Raises ConfigError for an invalid network.
    """

    def __init__(
        self,
        *,
        on_frame: Callable[[int, Buffer], object],
        on_link: Callable[[int, bool, Note], None],
        on_note: Callable[[int, Note], None],
        clock: Clock,
        limits: PeerLimits = _LIMITS,
        allow: Sequence[str] = (),
        when_full: Literal["drop", "block"] = "drop",
        tls: TlsFiles = _NO_FILES,
        origins: Sequence[str] = (),
        passage: Passage | None = None,
        reserved: ReservedPorts | None = None,
        admission: Admission | None = None,
    ) -> None:
        admission = admission or OpenAdmission()
        self._blocking = when_full == "block"
        self._loop = Loop(clock, self._run, self._failed)
        self._reporter = Reporter(self._loop, on_note)
        self._refusals = Refusals(self._reporter)
        self._faults: Counter[str] = Counter()
        native_reader = None
        if passage:
            native_reader = NativeReader(passage, self._attend, self._on_large, self._failed, admission)
        context = LinkContext(
            self._loop,
            self._reporter,
            self._refusals,
            limits,
            limits.body_rows(),
            self._faults,
            on_frame,
            self._drained,
            passage,
            native_reader.wait_large if native_reader else _ignore,
            admission,
            aside := Aside(self._loop),
        )
        self._aside = aside
        self._on_frame = on_frame
        self._limits = limits
        self._native_reader = native_reader
        self._registry = LinkRegistry(context, on_link)
        self._links = self._registry.links  # the same table, at hand for every message
        self._addresses = Addresses(self._registry, context, AllowList(allow), tls, origins, reserved)
        self._flush_s = 0.0
        self._finished = False

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    def listen(self, host: str, port: int, *, tls: bool = False, websocket: bool = False) -> tuple[str, int]:
        """Accept peers at this address from `start` on; port 0 chooses a free one.  Returns the address and port bound.

        Before, a peer waits for its connection, or is refused (``edges.reserved``).

        With ``tls`` clients must use TLS, and need a certificate where there is a CA for that; with ``websocket`` they
        speak WebSocket, one message of OpenIGTLink in each binary one.
        Raises ConfigError if the address is invalid, or open to other hosts without an allow-list, and after ``stop``;
        Unavailable if the address is in use, or reserved by the system, or the extra is not installed.
        """
        return self._addresses.listen(host, port, tls, websocket)

    def relay(
        self,
        host: str,
        port: int,
        to: tuple[str, int],
        *,
        tls: bool = False,
        tls_to: bool = False,
        websocket: bool = False,
    ) -> tuple[str, int]:
        """Accept peers at this address, each with a connection of its own to the server ``to``.

        The two links of a pair are announced together, the client's first; the note of the server's has the
        number of the client's as ``partner``.  When one closes, so does the other.  A link is read no faster than its
        partner takes what is sent to it; so what is received from one must be sent to the other, within ``on_frame``.

        With ``tls`` and ``websocket`` the clients use these, with ``tls_to`` the server uses TLS.  Returns and raises
        as ``listen``.
        """
        return self._addresses.relay(host, port, to, tls, tls_to, websocket)

    def connect(self, host: str, port: int, *, tls: bool = False) -> None:
        """Stay connected to this server: try until it is there, and again whenever the connection ends.

        Raises ConfigError for a port out of range, and after ``stop``.  Other causes might pass, and are noted.
        """
        self._addresses.connect(host, port, tls)

    def start(self) -> None:
        """Open the ports, and start the I/O thread; once.  Raises Unavailable for a port that was taken meanwhile."""
        self._addresses.open()
        self._loop.start()
        if self._native_reader:
            self._native_reader.start()

    def max_body(self, igtl_type: str) -> int:
        """Return the limit of the bodies of a type, in bytes."""
        return next(
            (size for glob, size in self._limits.body_rows() if matches(glob, igtl_type)), self._limits.max_body
        )

    def native_link(self, number: int) -> NativeLink | None:
        """Return a link as the native passage has it; None: its messages are Python's."""
        link = self._links.get(number)
        return link.native.link if link and link.native and not self._loop.stopping else None

    def ignore(self, stream: str, messages: int) -> None:
        """Count messages of a stream to links that take nothing any more."""
        self._registry.ignore({stream: messages})

    def send(self, links: Sequence[int], buffers: Sequence[Buffer], stream: str, keep: bool) -> None:
        """Send one message, as buffers one after the other, to each of these links.

        The buffers must not change afterwards: what the kernel does not take at once is queued without a copy.
        Messages leave a link in the order of the calls.  Links that have closed are ignored and counted.
        Raises TypeError or BufferError, with nothing sent, for a buffer that is not contiguous.
        """
        parts: Sequence[Part]
        if len(buffers) == 1 and type(buffers[0]) is bytes:  # as most messages are: no check is needed
            size, parts = len(buffers[0]), (buffers[0],)
        elif (size := sum([memoryview(buffer).nbytes for buffer in buffers])) <= _JOINED:
            parts = (b"".join(buffers),)
        else:
            # cast() refuses arrays with a zero in their shape
            parts = [memoryview(buffer).cast("B") for buffer in buffers if memoryview(buffer).nbytes]
        waits = self._blocking and not self._loop.in_loop_thread()
        for number in links:
            link = self._links.get(number)
            if link is None or not link.sender.send(parts, size, stream, keep, waits):
                self._registry.ignore((stream,))

    def send_all(
        self, links: Sequence[int], messages: Sequence[tuple[Sequence[Buffer], str]], is_urgent: Callable[[], bool]
    ) -> None:
        """`send` several messages, each with its stream, none to be dropped: small ones go in one system call.

        Where ``send`` waits for room in the queue, this waits for room in the kernel, until ``is_urgent`` returns True;
        messages that then find no room in the queue either are not taken.
        """
        run: list[bytes] = []
        streams: list[str] = []
        for buffers, stream in messages:
            if total_size(buffers) <= _JOINED:
                run.append(join(buffers))
                streams.append(stream)
            else:
                self._send_batch(links, b"".join(run), list(accumulate(map(len, run))), streams, is_urgent)
                run, streams = [], []
                data = memoryview(buffers[0]).cast("B") if len(buffers) == 1 else join(buffers)
                self._send_batch(links, data, [len(data)], [stream], is_urgent)
        self._send_batch(links, b"".join(run), list(accumulate(map(len, run))), streams, is_urgent)

    def _send_batch(
        self,
        links: Sequence[int],
        data: Part,
        ends: Sequence[int],
        streams: Sequence[str],
        is_urgent: Callable[[], bool],
    ) -> None:
        if not ends:
            return
        waits = self._blocking and not self._loop.in_loop_thread()
        for number in links:
            link = self._links.get(number)
            taken = link.sender.send_batch(data, ends, streams, waits, is_urgent) if link else 0
            if taken < len(streams):
                self._registry.ignore(streams[taken:])

    def counters(self) -> dict[int, LinkCounters]:
        """Counts per link that is up; under 0 the sum of all links that have closed."""
        return self._registry.counters()

    def disconnect(self, links: Sequence[int], reason: str, timeout_s: float = 0.0) -> bool:
        """Close these links, each once its peer has what is queued for it; False if that took longer.

        The reason is for the note.  Servers of ``connect`` are connected to again.
        """
        self._registry.finish(links, reason)
        return self._registry.wait(lambda: not any(number in self._links for number in links), timeout_s)

    def refused(self) -> dict[str, int]:
        """Number of refused connections, by reason."""
        return dict(sorted(self._refusals.counts.items()))

    def link_faults(self) -> dict[str, int]:
        """Number of links that a fault ended, or that ended inside a message, by the code of the note."""
        return dict(sorted(self._faults.items()))

    def flush(self, timeout_s: float) -> bool:
        """Wait until nothing is queued for any link; False if that took too long."""
        return self._registry.wait(lambda: not self._registry.is_queueing(), timeout_s)

    def links(self) -> list[LinkInfo]:
        """The peers, and the servers that are not connected."""
        return self._registry.infos() + self._addresses.absent()

    def wait_links(self, count: int, timeout_s: float | None) -> bool:
        """Wait until at least ``count`` links are up; False if that took too long or the edge was stopped."""
        return self._registry.wait(lambda: self._registry.count() >= count, timeout_s)

    def stop(self, flush_s: float = FLUSH_S) -> None:
        """Accept no more, send what is queued (for ``flush_s`` seconds at most), close all links, end the thread.

        Messages that arrive meanwhile are still delivered: do not call it under a lock that callbacks take.
        Further calls do nothing; from a callback it only requests the stop, and returns at once.
        """
        if self._native_reader and self._loop.started and not self._loop.in_loop_thread():
            self._native_reader.settle()
        with self._registry.changed:
            if not self._loop.stopping:
                self._flush_s = flush_s
                self._loop.stopping = True
            self._registry.changed.notify_all()
        self._loop.wake()
        if not self._loop.started:
            self._finish()
        elif not self._loop.in_loop_thread():
            self._loop.join()

    # ── the I/O thread ────────────────────────────────────────────────────────────────────────────────────────

    def _run(self) -> None:
        while not self._loop.stopping:
            self._loop.run_once(None)
        self._finish()

    def _failed(self, exc: Exception) -> None:
        """An unexpected error of our own code that concerns no single link, listener or server."""
        self._reporter.note_error(exc)

    def _attend(self, number: int) -> None:
        """The native passage has left something of a link to Python; called by its thread."""
        if link := self._links.get(number):
            self._loop.call_soon(link.attend, link.failed)

    def _on_large(self, number: int, message: Part) -> None:
        """The native passage has read a large message; called by its second thread."""
        self._reporter.call("on_frame", self._on_frame, number, message)

    def _drained(self) -> None:
        self._registry.notify()

    def _finish(self) -> None:
        """The orderly end: flush, half-close, read out, close."""
        if self._finished:
            return
        self._addresses.close()
        for link in list(self._links.values()):
            self._loop.run(link.read_by_python, link.failed)
        self._run_while(self._registry.is_queueing, self._flush_s)
        for link in self._links.values():
            link.end_sending()
        # Closing with unread bytes resets the connection, and the peer could lose the last messages.
        self._run_while(lambda: bool(self._links), _DRAIN_S)
        for link in list(self._links.values()):
            self._loop.run(link.close, link.failed)
        if self._native_reader:
            self._native_reader.stop()
        self._aside.stop()
        self._loop.close()
        self._finished = True

    def _run_while(self, condition: Callable[[], bool], timeout_s: float) -> None:
        """Run the loop while the condition holds, for that time at most."""
        deadline_ns = self._loop.now() + round(timeout_s * NS_PER_S)
        while condition() and self._loop.now() < deadline_ns:
            self._loop.run_once(deadline_ns)
