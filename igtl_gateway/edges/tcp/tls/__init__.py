"""TLS for both roles: certificates (``files``), and a socket that encrypts.

Strategy: OpenSSL never has the socket.  It works on two buffers in memory, and plain non-blocking system calls move
the bytes between these and the socket.  So no call of OpenSSL waits; a sender in any thread and the I/O thread as
receiver alternate at one lock, held for one batch of at most 64 KiB (tens of µs).  Bytes that OpenSSL has taken are
sent, even if the messages behind them are dropped: OpenSSL on a socket would need the same bytes again after each
"not now", which a queue that drops old messages cannot promise.

A server with a CA asks every client for a certificate of it; a client checks the server's certificate and its name.
Versions below TLS 1.2 are not accepted.
"""

from igtl_gateway.edges.tcp.tls.files import Context, TlsFiles
from igtl_gateway.edges.tcp.tls.secure_socket import PLAIN_TO_TLS, TLS_TO_PLAIN, TlsError, TlsSocket

__all__ = ["PLAIN_TO_TLS", "TLS_TO_PLAIN", "Context", "TlsError", "TlsFiles", "TlsSocket"]
