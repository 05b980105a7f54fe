"""The OpenIGTLink edge: servers and clients over TCP, any number of peers at once.

Strategy: one I/O thread around one selector (``loop``) accepts (``listener``), connects (``dialer``), receives, frames
and calls back (``receiver``).  Sending does not pass through it: ``send`` writes to the socket in the caller's own
thread as long as the peer keeps up (``sender``), which saves a thread hop per message.  Only what the kernel does not
take at once is queued (``outbox``), and the I/O thread sends it as the peer reads on.

A ``link`` joins a sender, a receiver and a check of ``liveness``; ``registry`` has all links, ``addresses`` makes their
connections, and ``edge`` is the interface of the whole.

Locks: each link has one, ``Sender.lock``, held for one non-blocking system call at most.  ``LinkRegistry.changed``
(table of links, totals) may be held while a link's lock is taken, never the other way round.  No callback is ever made
under either, and callbacks are made by the I/O thread only; so a callback may take the caller's lock and ``send``,
while another thread sends under that same lock.

TLS (``tls``) and WebSocket (``websocket``) are other kinds of sockets below a link (``layer``, ``layered_link``): the
handshake (``handshake``) comes before the link, and the I/O thread flushes bytes that are encrypted but not yet sent.

A relay (``relay``) makes pairs of links, each client with a connection of its own to one server.  There the I/O thread
sends, and reads a link only while its partner's queue is empty.

An error of our own code in the I/O thread ends neither the thread nor the other links: a note (``internal_error``)
reports it, and the part in which it happened recovers, see ``Link.failed``, ``Listener.failed``, ``Dialer.failed``.
"""

from igtl_gateway.edges.tcp.edge import TcpEdge
from igtl_gateway.edges.tcp.link_info import LinkCounters, LinkInfo, PeerLimits
from igtl_gateway.edges.tcp.tls import TlsFiles

__all__ = ["LinkCounters", "LinkInfo", "PeerLimits", "TcpEdge", "TlsFiles"]
