"""WebSocket for browsers and headsets: a socket with frames (``framed_socket``), whose pages may come (``origins``).

One binary message is one OpenIGTLink message, as openigtlink-ng has it.  Extensions are not accepted: a peer that may
compress decides how much memory its messages take.  No subprotocol is chosen.
"""

from igtl_gateway.edges.tcp.websocket.framed_socket import WebSocketError, WebSocketSocket
from igtl_gateway.edges.tcp.websocket.origins import Origins

__all__ = ["Origins", "WebSocketError", "WebSocketSocket"]
