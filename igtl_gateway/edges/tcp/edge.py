"""``TcpEdge``: what the rest of the gateway sees of the links, and the life of the whole from start to stop."""

from __future__ import annotations

import socket
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from itertools import accumulate
from typing import Literal

from igtl_gateway.buffers import Buffer, join, total_size
from igtl_gateway.clock import Clock
from igtl_gateway.edges.tcp.dialer import Dialer
from igtl_gateway.edges.tcp.facts import Limits, LinkCounters, LinkInfo, Role
from igtl_gateway.edges.tcp.link import FLUSH_S, Link, Surroundings, TlsLink
from igtl_gateway.edges.tcp.listener import Listener
from igtl_gateway.edges.tcp.loop import Loop
from igtl_gateway.edges.tcp.outbox import Part
from igtl_gateway.edges.tcp.refusals import Refusals
from igtl_gateway.edges.tcp.relay import Relay
from igtl_gateway.edges.tcp.reporter import Reporter
from igtl_gateway.edges.tcp.sockets import PORT_MAX, AllowList, listening_socket, place_of, tune
from igtl_gateway.edges.tcp.tls import Context, Handshake, TlsFiles, TlsSocket
from igtl_gateway.errors import ConfigError
from igtl_gateway.session.note import Level, Note
from igtl_gateway.stamp import NS_PER_S

_DRAIN_S = 0.25  # how long stop() waits for peers to close their side
_JOINED = 4096  # bytes of a message up to which one copied buffer is sent faster than several (3.5 µs against 5.5)
_LIMITS = Limits()
_NO_FILES = TlsFiles()

#: Takes a connection and the address of its peer.
Up = Callable[[socket.socket | TlsSocket, str], None]


class TcpEdge:
    """Frames in by callback, frames out by ``send``.  Link numbers count from 1 and are never used twice.

    Callbacks come from the I/O thread, one at a time: for each link first ``on_link(number, True, note)``, then
    its frames, then ``on_link(number, False, note)``.  One that raises is noted, and things go on.

    The clock paces retries, stalls and notes; it must run by itself.

    Args:
        on_frame: link number and one whole message, unchecked; the buffer is the receiver's to keep.
        on_link: a peer came (True) or went; the note's data has ``peer``, ``local``, ``role``, and, when it went,
            ``reason`` and the counts.
        on_note: link number (0 if none) and a fact: ``truncated``, ``too_large``, ``stalled``, ``unreachable``,
            ``idle``, ``out_of_memory``, ``queue_drop``, ``queue_full``, ``rate_limited``, ``refused``,
            ``tls_failed``, ``accept_failed``, ``connect_failed``, ``callback_failed``, ``internal_error``.
        clock: see above.
        limits: what a peer can cost.
        allow: networks (CIDR) whose peers may connect beside this host's own, or ``"any"``.
        tls: files for the connections that are to have TLS.
        when_full: ``"drop"``: ``send`` never waits, see ``Outbox``; ``"block"``: ``send`` waits for room and
            nothing is lost while the link lives (except in callbacks, which must not wait for themselves).

    Raises ConfigError for a network that is none.
    """

    def __init__(
        self,
        *,
        on_frame: Callable[[int, Buffer], None],
        on_link: Callable[[int, bool, Note], None],
        on_note: Callable[[int, Note], None],
        clock: Clock,
        limits: Limits = _LIMITS,
        allow: Sequence[str] = (),
        when_full: Literal["drop", "block"] = "drop",
        tls: TlsFiles = _NO_FILES,
    ) -> None:
        self._on_link = on_link
        self._limits = limits
        self._allow = AllowList(allow)
        self._tls = tls
        self._blocking = when_full == "block"

        self._changed = threading.Condition()  # guards _links, _ignored, _gone; told when a waiter should look again
        self._links: dict[int, Link] = {}
        self._ignored: Counter[str] = Counter()
        self._gone = LinkCounters()

        self._loop = Loop(clock, self._run, self._failed)
        self._reporter = Reporter(self._loop, on_note)
        self._refusals = Refusals(self._reporter)
        self._around = Surroundings(
            self._loop,
            self._reporter,
            self._refusals,
            limits,
            limits.body_rows(),
            Counter(),
            on_frame,
            self._notify,
            self._down,
        )
        self._last_number = 0
        self._listeners: list[Listener] = []
        self._dialers: list[Dialer] = []
        self._relays: list[Relay] = []
        self._handshakes: dict[TlsSocket, Handshake] = {}  # of the clients that are about to come
        self._swept_ns = self._loop.looked_ns
        self._flush_s = 0.0
        self._finished = False

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    def listen(self, host: str, port: int, *, tls: bool = False) -> tuple[str, int]:
        """Serve peers at this address; port 0 chooses a free one.  Returns the address and port bound.

        With ``tls`` they have to speak it, and to have a certificate where there is a CA for that.
        Raises ConfigError if the address is invalid, or open to other hosts without an allow-list, and after ``stop``;
        Unavailable if it is taken, or not ours to take.
        """
        return self._listen(host, port, self._up, tls)

    def relay(
        self, host: str, port: int, to: tuple[str, int], *, tls: bool = False, tls_to: bool = False
    ) -> tuple[str, int]:
        """Serve peers at this address, each with a connection of its own to the server ``to``.

        The two links of a pair are announced together, the client's first; the note of the server's has the
        number of the client's as ``partner``.  When one goes, so does the other.  A link is read no faster than its
        partner takes what is sent to it; so what comes from one must be sent to the other, within ``on_frame``.

        With ``tls`` clients speak it, with ``tls_to`` the server does.  Returns and raises as ``listen``.
        """
        if not 1 <= to[1] <= PORT_MAX:
            raise ConfigError(f"connect {to[0]}: found port {to[1]}, expected 1 to {PORT_MAX}")
        secure = self._securer(to[0]) if tls_to else None
        relay = Relay(*to, self._up_pair, self._loop, self._reporter, secure)
        bound = self._listen(host, port, relay.take, tls)
        self._relays.append(relay)
        return bound

    def _listen(self, host: str, port: int, up: Up, tls: bool) -> tuple[str, int]:
        context = self._tls.server() if tls else None
        sock = listening_socket(host, port, self._allow)
        bound: tuple[str, int] = sock.getsockname()[:2]
        greet = partial(self._greet, up, context) if context else up
        listener = Listener(sock, self._allow, self._crowded, greet, self._loop, self._reporter, self._refusals)
        with self._changed:
            if self._loop.stopping:
                sock.close()
                raise ConfigError(f"listen {place_of((host, port))}: the edge was stopped; a new one is needed")
            self._listeners.append(listener)
        self._loop.post(listener.open, listener.failed)
        return bound

    def _securer(self, host: str) -> Callable[[socket.socket], TlsSocket]:
        """What puts TLS on a connection to that host.  Raises ConfigError."""
        context = self._tls.client()

        def secure(sock: socket.socket) -> TlsSocket:
            tune(sock)
            return TlsSocket(sock, context, server_side=False, host=host)

        return secure

    def connect(self, host: str, port: int, *, tls: bool = False) -> None:
        """Stay connected to this server: try until it is there, and again whenever it goes.

        Raises ConfigError for a port out of range, and after ``stop``.  Anything else may mend itself, and is noted.
        """
        if not 1 <= port <= PORT_MAX:
            raise ConfigError(f"connect {host}: found port {port}, expected 1 to {PORT_MAX}")
        secure = self._securer(host) if tls else None
        dialer = Dialer(host, port, self._up, self._loop, self._reporter, secure=secure)
        with self._changed:
            if self._loop.stopping:
                raise ConfigError(f"connect {dialer.target}: the edge was stopped; a new one is needed")
            self._dialers.append(dialer)
        self._loop.post(dialer.dial, dialer.failed)

    def start(self) -> None:
        """Start the I/O thread; once."""
        self._loop.start()

    def send(self, links: Sequence[int], buffers: Sequence[Buffer], stream: str, keep: bool) -> None:
        """Send one message, as buffers one after the other, to each of these links.

        The buffers must not change afterwards: what the kernel does not take at once is queued as it is.
        Messages leave a link in the order of the calls.  Links that are gone are ignored and counted.
        Raises TypeError or BufferError, with nothing sent, for a buffer that is not contiguous.
        """
        parts: Sequence[Part]
        if len(buffers) == 1 and type(buffers[0]) is bytes:  # most messages are: they need no look at all
            size, parts = len(buffers[0]), (buffers[0],)
        elif (size := sum([memoryview(buffer).nbytes for buffer in buffers])) <= _JOINED:
            parts = (b"".join(buffers),)
        else:
            # cast() refuses arrays with a zero in their shape
            parts = [memoryview(buffer).cast("B") for buffer in buffers if memoryview(buffer).nbytes]
        waits = self._blocking and not self._loop.inside()
        for number in links:
            link = self._links.get(number)
            if link is None or not link.send(parts, size, stream, keep, waits):
                with self._changed:
                    self._ignored[stream] += 1

    def send_all(
        self, links: Sequence[int], messages: Sequence[tuple[Sequence[Buffer], str]], hurry: Callable[[], bool]
    ) -> None:
        """`send` several messages, each with its stream, none to be dropped: small ones go in one system call.

        Where ``send`` waits for room in the queue, this waits for room in the kernel, until ``hurry`` says that there
        is no time for that; what finds no room in the queue either is then not taken.
        """
        run: list[bytes] = []
        streams: list[str] = []
        for buffers, stream in messages:
            if total_size(buffers) <= _JOINED:
                run.append(join(buffers))
                streams.append(stream)
            else:
                self._send_run(links, b"".join(run), list(accumulate(map(len, run))), streams, hurry)
                run, streams = [], []
                data = memoryview(buffers[0]).cast("B") if len(buffers) == 1 else join(buffers)
                self._send_run(links, data, [len(data)], [stream], hurry)
        self._send_run(links, b"".join(run), list(accumulate(map(len, run))), streams, hurry)

    def _send_run(
        self,
        links: Sequence[int],
        data: Part,
        ends: Sequence[int],
        streams: Sequence[str],
        hurry: Callable[[], bool],
    ) -> None:
        if not ends:
            return
        waits = self._blocking and not self._loop.inside()
        for number in links:
            link = self._links.get(number)
            taken = link.send_run(data, ends, streams, waits, hurry) if link else 0
            if taken < len(streams):
                with self._changed:
                    self._ignored.update(streams[taken:])

    def counters(self) -> dict[int, LinkCounters]:
        """Counts per link that is up; under 0 those of all links that are gone, taken together."""
        with self._changed:
            counts = {number: link.counters() for number, link in self._links.items()}
            return {0: self._gone + LinkCounters(ignored=dict(self._ignored))} | counts

    def disconnect(self, links: Sequence[int], reason: str, timeout_s: float = 0.0) -> bool:
        """Close these links, each once its peer has what is queued for it; False if that took longer.

        The reason is for the note.  Servers that they were made to with ``connect`` are connected to again.
        """
        for number in links:
            if link := self._links.get(number):
                self._loop.post(partial(link.finish, reason), link.failed)
        return self._wait(lambda: not any(number in self._links for number in links), timeout_s)

    def refused(self) -> dict[str, int]:
        """Connections that were not let in, by reason."""
        return dict(sorted(self._refusals.counts.items()))

    def link_faults(self) -> dict[str, int]:
        """Links that a fault ended, or that ended inside a message, by the code of the note about that."""
        return dict(sorted(self._around.faults.items()))

    def flush(self, timeout_s: float) -> bool:
        """Wait until nothing is queued for any link; False if that took too long."""
        return self._wait(lambda: not self._queued(), timeout_s)

    def links(self) -> list[LinkInfo]:
        """The peers, and the servers that are not there yet."""
        with self._changed:
            live = [LinkInfo(link.number, link.peer, link.role, True) for link in self._live()]
        return live + [LinkInfo(0, dialer.target, "client", False) for dialer in self._dialers if not dialer.link]

    def wait_links(self, count: int, timeout_s: float | None) -> bool:
        """Wait until at least ``count`` links are up; False if that took too long or the edge was stopped."""
        return self._wait(lambda: len(self._live()) >= count, timeout_s)

    def stop(self, flush_s: float = FLUSH_S) -> None:
        """Accept no more, send what is queued (for ``flush_s`` seconds at most), close all links, end the thread.

        Frames that arrive meanwhile are still delivered: do not call it under a lock that callbacks take.
        Further calls do nothing; from a callback it only asks, and returns at once.
        """
        with self._changed:
            if not self._loop.stopping:
                self._flush_s = flush_s
                self._loop.stopping = True
            self._changed.notify_all()
        self._loop.wake()
        if not self._loop.started:
            self._finish()
        elif not self._loop.inside():
            self._loop.join()

    def _wait(self, condition: Callable[[], bool], timeout_s: float | None) -> bool:
        if self._loop.inside():  # it would wait for itself
            timeout_s = 0.0
        with self._changed:
            self._changed.wait_for(lambda: self._loop.stopping or condition(), timeout_s)
            return condition()

    def _live(self) -> list[Link]:
        return [link for link in self._links.values() if link.announced]

    def _queued(self) -> bool:
        return any(not link.all_sent for link in self._links.values())

    # ── the I/O thread ────────────────────────────────────────────────────────────────────────────────────────

    def _run(self) -> None:
        self._loop.run(self._sweep)
        while not self._loop.stopping:
            self._loop.turn(None)
        self._finish()

    def _sweep(self) -> None:
        """Close the links that fell silent."""
        limits, now = self._limits, self._loop.looked_ns
        pause_s = min(limits.stall_s / 4, limits.idle_s / 4 or 1.0, 1.0)
        self._loop.later(pause_s, self._sweep)
        # If we were stopped or had no time ourselves, no peer is to blame for all of it.
        step_ns = min(now - self._swept_ns, round(2 * pause_s * NS_PER_S))
        self._swept_ns = now
        for link in list(self._links.values()):
            self._loop.run(partial(link.sweep, step_ns), link.failed)

    def _failed(self, exc: Exception) -> None:
        """An unexpected error of ours that concerns no single link, listener or server."""
        self._reporter.note_error(exc)

    def _crowded(self) -> str:
        """Why no further peer may connect, or ``""``."""
        most = self._limits.max_clients
        clients = sum(link.role == "server" for link in self._links.values())
        clients += sum(relay.waiting for relay in self._relays)
        return f"{most} clients are connected already" if clients >= most else ""

    def _greet(self, up: Up, context: Context, sock: socket.socket, peer: str) -> None:
        """A client came that has to speak TLS first.

        As many may be in the handshake as may be connected, beside those.  One more takes the place of the one that
        has said nothing for longest: nobody needs a certificate to say nothing, and who has one must get in.
        """
        tune(sock)
        if len(self._handshakes) >= self._limits.max_clients:
            waiting = self._handshakes.values()
            next((one for one in waiting if not one.sock.begun), next(iter(waiting))).give_way()
        secured = TlsSocket(sock, context, server_side=True)

        def done() -> None:
            del self._handshakes[secured]
            if reason := self._crowded():
                self._refusals.refuse(secured, peer, reason)
            else:
                up(secured, peer)

        def refused(reason: str, detail: str) -> None:
            del self._handshakes[secured]
            self._refusals.refuse(secured, peer, reason, detail)

        def failed(exc: Exception) -> None:
            self._reporter.note_error(exc)
            if handshake := self._handshakes.pop(secured, None):
                handshake.cancel()

        self._handshakes[secured] = handshake = Handshake(secured, self._loop, done, refused, failed)
        handshake.begin(self._limits.handshake_s)

    def _up(self, sock: socket.socket | TlsSocket, peer: str, dialer: Dialer | None = None) -> None:
        """A connection was made: give it a number, and tell."""
        link = self._link(sock, peer, "client" if dialer else "server")
        if dialer:
            dialer.link = link
        self._announce(link)

    def _up_pair(
        self, client: socket.socket | TlsSocket, peer: str, server: socket.socket | TlsSocket, target: str
    ) -> None:
        """A client came, and a connection to its server was made."""
        try:
            one = self._link(client, peer, "server")
        except Exception:
            server.close()
            raise
        self._announce(one)
        try:
            other = self._link(server, target, "client")
        except Exception:
            one.close("internal_error")
            raise
        one.partner, other.partner = other, one
        self._announce(other, partner=one.number)

    def _link(self, sock: socket.socket | TlsSocket, peer: str, role: Role) -> Link:
        """A link of the next number, not yet announced."""
        try:
            link: Link
            if isinstance(sock, TlsSocket):
                link = TlsLink(self._last_number + 1, sock, role, peer, self._around)
            else:
                tune(sock)
                link = Link(self._last_number + 1, sock, role, peer, self._around)
            link.open()
        except Exception:
            self._loop.unwatch(sock)
            sock.close()
            raise
        self._last_number += 1
        with self._changed:
            self._links[link.number] = link
        return link

    def _announce(self, link: Link, **facts: int) -> None:
        data = {"peer": link.peer, "local": link.local, "role": link.role} | link.facts | facts
        text = f"{link.peer} connected to {link.local}" if link.role == "server" else f"connected to {link.peer}"
        note = Note(Level.INFO, "link_up", text, data=data)
        self._reporter.call("on_link", self._on_link, link.number, True, note)
        link.announced = True
        self._notify()

    def _down(self, link: Link, note: Note) -> None:
        """The link has closed: keep its counts, and tell, before its partner can be sent no more."""
        counts = link.counters()
        with self._changed:
            del self._links[link.number]
            self._gone += counts
        for dialer in self._dialers:
            if dialer.link is link:
                self._loop.run(dialer.redial, dialer.failed)
        self._reporter.call("on_link", self._on_link, link.number, False, note)
        if link.partner:
            self._loop.run(partial(link.partner.finish, "the other side has gone"), link.partner.failed)
        self._notify()

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _finish(self) -> None:
        """The orderly end: flush, half-close, read out, close."""
        if self._finished:
            return
        for listener in self._listeners:
            listener.close()
        for dialer in self._dialers:
            dialer.hang_up()
        for relay in self._relays:
            relay.close()
        for handshake in self._handshakes.values():
            handshake.cancel()
        self._turns(self._queued, self._flush_s)
        for link in self._links.values():
            link.end_sending()
        # Closing with unread bytes resets the connection, and the peer could lose the last that we sent.
        self._turns(lambda: bool(self._links), _DRAIN_S)
        for link in list(self._links.values()):
            self._loop.run(link.close, link.failed)
        self._loop.close()
        self._finished = True

    def _turns(self, condition: Callable[[], bool], timeout_s: float) -> None:
        """Go on while the condition holds, for that long at most."""
        deadline_ns = self._loop.now() + round(timeout_s * NS_PER_S)
        while condition() and self._loop.now() < deadline_ns:
            self._loop.turn(deadline_ns)
