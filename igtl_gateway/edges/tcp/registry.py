"""The links of an edge: their numbers, their beginning and end, and what they add up to."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.tcp.dialer import Dialer
from igtl_gateway.edges.tcp.layer import AnySocket, Layer
from igtl_gateway.edges.tcp.layered_link import LayeredLink
from igtl_gateway.edges.tcp.link import Link
from igtl_gateway.edges.tcp.link_info import LinkCounters, LinkInfo, Role
from igtl_gateway.edges.tcp.link_parts import LinkContext
from igtl_gateway.edges.tcp.sockets import tune_socket
from igtl_gateway.gateway.log.note import Level, Note


class LinkRegistry:
    """All links that are up, by number.

    ``changed`` guards ``links``, and the counts; it is notified when a waiting thread should check its condition.

    Args:
        context: what the links share.
        on_link: called with number, up or down, and the note of it, in the I/O thread.
    """

    def __init__(self, context: LinkContext, on_link: Callable[[int, bool, Note], None]) -> None:
        self.changed = threading.Condition()
        self.links: dict[int, Link] = {}
        self._context = context
        self._loop = context.loop
        self._on_link = on_link
        self._ignored: Counter[str] = Counter()
        self._gone = LinkCounters()
        self._dialers: dict[int, Dialer] = {}  # of the links that we made
        self._last_number = 0
        self._checked_ns = 0
        self._is_checking = False  # whether a check of all links is due at some time

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    def ignore(self, streams: Sequence[str] | Mapping[str, int]) -> None:
        """Count messages that no link took: one for each of these streams, or these numbers of them."""
        with self.changed:
            self._ignored.update(streams)

    def counters(self) -> dict[int, LinkCounters]:
        """Counts per link that is up; under 0 the sum of all links that have closed."""
        with self.changed:
            counts = {number: link.counters() for number, link in self.links.items()}
            return {0: self._gone + LinkCounters(ignored=dict(self._ignored))} | counts

    def infos(self) -> list[LinkInfo]:
        """The peers."""
        with self.changed:
            return [LinkInfo(link.number, link.peer, link.role, True) for link in self._open_links()]

    def count(self) -> int:
        """How many links are up; with ``changed`` held, or by the I/O thread."""
        return len(self._open_links())

    def clients(self) -> int:
        """How many peers have connected to us; of the I/O thread."""
        return sum(link.role == "server" for link in self.links.values())

    def is_queueing(self) -> bool:
        """Whether anything is queued for any link; with ``changed`` held, or by the I/O thread."""
        return any(not link.sender.all_sent for link in self.links.values())

    def finish(self, numbers: Sequence[int], reason: str) -> None:
        """Close these links, each once its peer has what is queued for it."""
        for number in numbers:
            if link := self.links.get(number):
                self._loop.call_soon(partial(link.finish, reason), link.failed)

    def wait(self, condition: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait for a condition, called with ``changed`` held; False if that took too long, or at stop."""
        if self._loop.in_loop_thread():  # it would wait for itself
            timeout_s = 0.0
        with self.changed:
            self.changed.wait_for(lambda: self._loop.stopping or condition(), timeout_s)
            return condition()

    def notify(self) -> None:
        """Have waiting threads check their conditions."""
        with self.changed:
            self.changed.notify_all()

    def _open_links(self) -> list[Link]:
        return [link for link in self.links.values() if link.announced]

    # ── for the I/O thread ────────────────────────────────────────────────────────────────────────────────────

    def up(self, sock: AnySocket, peer: str, dialer: Dialer | None = None) -> None:
        """A connection was made: give it a number, and report it."""
        link = self._make(sock, peer, "client" if dialer else "server")
        if dialer:
            dialer.link = link
            self._dialers[link.number] = dialer
        asked = {"asked": dialer.target} if dialer and dialer.target != peer else {}
        self._announce(link, **asked)

    def pair_up(self, client: AnySocket, peer: str, server: AnySocket, target: str) -> None:
        """A client connected, and a connection to its server was made."""
        try:
            one = self._make(client, peer, "server")
        except Exception:
            server.close()
            raise
        self._announce(one)
        try:
            other = self._make(server, target, "client")
        except Exception:
            one.close("internal_error")
            raise
        one.pair_with(other)
        other.pair_with(one)
        self._announce(other, partner=one.number)

    def _check_later(self) -> float:
        """Check the links after a while; return after how many seconds."""
        limits = self._context.limits
        pause_s = min(limits.stall_s / 4, limits.idle_s / 4 or 1.0, 1.0)
        self._loop.call_later(pause_s, self._check_liveness)
        return pause_s

    def _check_liveness(self) -> None:
        """Close the links that do not move any more, and check again after a while, unless there are none."""
        self._is_checking = bool(self.links)
        if not self._is_checking:
            return
        pause_s, now_ns = self._check_later(), self._loop.looked_ns
        # If we were stopped or had no time ourselves, no peer is to blame for all of it.
        step_ns = min(now_ns - self._checked_ns, round(2 * pause_s * NS_PER_S))
        self._checked_ns = now_ns
        for link in list(self.links.values()):
            self._loop.run(partial(link.liveness.check, step_ns), link.failed)

    def _make(self, sock: AnySocket, peer: str, role: Role) -> Link:
        """A link of the next number, not yet announced."""
        try:
            link: Link
            if isinstance(sock, Layer):
                link = LayeredLink(self._last_number + 1, sock, role, peer, self._context, self._link_down)
            else:
                tune_socket(sock)
                link = Link(self._last_number + 1, sock, role, peer, self._context, self._link_down)
            link.watch()
        except Exception:
            self._loop.unwatch(sock)
            sock.close()
            raise
        self._last_number += 1
        with self.changed:
            self.links[link.number] = link
        if not self._is_checking:
            self._is_checking, self._checked_ns = True, self._loop.looked_ns
            self._check_later()
        return link

    def _announce(self, link: Link, **facts: int | str) -> None:
        data = {"peer": link.peer, "local": link.local, "role": link.role} | link.facts | facts
        text = f"{link.peer} connected to {link.local}" if link.role == "server" else f"connected to {link.peer}"
        text += link.manner
        note = Note(Level.INFO, "link_up", text, data=data)
        self._context.reporter.call("on_link", self._on_link, link.number, True, note)
        link.announced = True
        self.notify()

    def _link_down(self, link: Link, note: Note) -> None:
        """The link has closed: keep its counts, and report it, before its partner can be sent no more."""
        counts = link.counters()
        with self.changed:
            del self.links[link.number]
            self._gone += counts
        if dialer := self._dialers.pop(link.number, None):
            self._loop.run(dialer.redial, dialer.failed)
        self._context.reporter.call("on_link", self._on_link, link.number, False, note)
        if link.partner:
            self._loop.run(partial(link.partner.finish, "the other side disconnected"), link.partner.failed)
        self.notify()
