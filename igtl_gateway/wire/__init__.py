"""OpenIGTLink bytes ⇄ messages.  No sockets, no ROS, no clock: usable alone.

>>> from igtl_gateway.wire import Message, decode, encode
>>> from igtl_gateway.wire.text import String
>>> data = b"".join(encode(Message("STRING", "Greeting", String.of("hello"))))
>>> decode(data).content.text
'hello'
"""

from igtl_gateway.wire.body import Raw
from igtl_gateway.wire.message import HEADER_SIZE, Header, Item, Message, decode, describe, encode

__all__ = ["HEADER_SIZE", "Header", "Item", "Message", "Raw", "decode", "describe", "encode"]
