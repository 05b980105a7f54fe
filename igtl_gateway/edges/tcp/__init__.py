"""The OpenIGTLink edge: servers and clients over TCP, any number of peers at once.

Strategy: one I/O thread around one selector (``loop``) accepts (``listener``), connects (``dialer``), receives,
frames and calls back (``link``).  Sending does not pass through it: ``send`` writes to the socket in the caller's
own thread as long as the peer keeps up, which saves a thread hop per message.  Only what the kernel does not take
at once is queued (``outbox``), and the I/O thread sends it as the peer reads on.

Locks: each link has one, held for one non-blocking system call at most.  ``TcpEdge._changed`` (table of links,
totals) may be held while taking a link's lock, never the other way round.  No callback is ever made under either,
and callbacks are made by the I/O thread only; so a callback may take the caller's lock and ``send``, while another
thread sends under that same lock.

TLS (``tls``) is a socket of another kind below a link: the handshake comes before the link, and bytes that are
encrypted but not yet sent are flushed by the I/O thread.

A relay (``relay``) makes pairs of links, each client with a connection of its own to one server.  There the I/O thread
sends, and reads a link only while its partner's queue is empty.

Errors of our own in the I/O thread end neither it nor the other links: each is noted (``internal_error``) and the
part that it happened in mends itself, see ``Link.failed``, ``Listener.failed``, ``Dialer.failed``.
"""

from igtl_gateway.edges.tcp.edge import TcpEdge
from igtl_gateway.edges.tcp.facts import Limits, LinkCounters, LinkInfo
from igtl_gateway.edges.tcp.tls import TlsFiles

__all__ = ["Limits", "LinkCounters", "LinkInfo", "TcpEdge", "TlsFiles"]
