"""Whether a link is alive: silence, slow messages, unreachable peers, and queues that do not move."""

from __future__ import annotations

import math
from functools import partial

from igtl_gateway.base.quantities import count_text, duration_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.tcp.layer import AnySocket
from igtl_gateway.edges.tcp.link_parts import LinkContext, LinkLife
from igtl_gateway.edges.tcp.receiver import Receiver
from igtl_gateway.edges.tcp.sender import Sender
from igtl_gateway.edges.tcp.sockets import UNANSWERED_S, unanswered_s
from igtl_gateway.gateway.log.note import Level


class Liveness:
    """Closes a link that does not move any more; of the I/O thread alone."""

    def __init__(
        self,
        sock: AnySocket,
        link: LinkLife,
        sender: Sender,
        receiver: Receiver,
        context: LinkContext,
    ) -> None:
        self._sock = sock
        self._link = link
        self._sender = sender
        self._receiver = receiver
        self._limits = context.limits
        self._loop = context.loop
        self._up_ns = self._loop.now()
        self._moved = (0, 0)  # bytes in and out when they last changed …
        self._moved_ns = self._up_ns  # … and when that was

    def was_established(self, least_s: float) -> bool:
        """Whether the peer spoke OpenIGTLink: it sent a byte of it, or the link lasted for ``least_s``."""
        if self._receiver.is_foreign:
            return False
        return self._receiver.bytes > 0 or self._loop.now() - self._up_ns >= least_s * NS_PER_S

    def check(self, step_ns: int) -> None:
        """Close if the peer stalls inside a message, sends it far too slowly, is unreachable, or is idle for too long.

        Args:
            step_ns: the time since the last check, or less if this one is late.
        """
        limits, receiver, peer = self._limits, self._receiver, self._link.peer
        now_ns = self._loop.looked_ns
        message_s = receiver.message_ns(step_ns) / NS_PER_S
        pending = receiver.pending if receiver.is_read else 0
        if pending and (now_ns - receiver.heard_ns) / NS_PER_S > limits.stall_s:
            self._link.fault(Level.WARN, "stalled", f"{peer} sent a part of a message and stopped")
        elif pending and message_s > limits.stall_s + pending / limits.min_rate:
            text = (
                f"{peer} sent {count_text(pending, 'byte')} of a message in "
                f"{duration_text(message_s * NS_PER_S)}: too slow"
            )
            self._link.fault(Level.WARN, "stalled", text)
        elif (dead_s := unanswered_s(self._sock)) > UNANSWERED_S:
            text = f"{peer} is unreachable: it has confirmed nothing for {duration_text(dead_s * NS_PER_S)}"
            self._link.fault(Level.WARN, "unreachable", text)
        elif limits.idle_s:
            moved = (receiver.bytes, self._sender.sent_bytes)
            if moved != self._moved:
                self._moved, self._moved_ns = moved, now_ns
            elif (now_ns - self._moved_ns) / NS_PER_S > limits.idle_s and receiver.is_read:
                self._link.fault(Level.WARN, "idle", f"{peer}: no traffic in either direction for {limits.idle_s:g} s")

    def close_when_stalled(self, goal: int = 0) -> None:
        """Close if the queue hardly moves any more; a peer that reads slowly, or is busy for a while, gets everything.

        Args:
            goal: bytes that must have been sent by now.
        """
        sender, limits = self._sender, self._limits
        with sender.lock:
            sent, done = sender.outbox.sent_bytes - sender.backlog, sender.all_sent
        if not self._link.is_open or done:
            return
        if sent >= goal:
            goal = sent + math.ceil(limits.min_rate * limits.stall_s)
            self._loop.call_later(limits.stall_s, partial(self.close_when_stalled, goal), self._link.failed)
        else:
            self._link.close()
