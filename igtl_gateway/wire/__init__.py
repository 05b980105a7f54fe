"""OpenIGTLink bytes ⇄ messages.  No sockets, no ROS, no clock: usable alone.

>>> from igtl_gateway.wire import Message, decode, encode
>>> from igtl_gateway.wire.text import String
>>> data = b"".join(encode(Message("STRING", "Greeting", String.of("hello"))))
>>> decode(data).content.text
'hello'
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igtl_gateway.wire.body import Raw
    from igtl_gateway.wire.header import HEADER_SIZE, Header
    from igtl_gateway.wire.message import Item, Message, decode, describe, encode

__all__ = ["HEADER_SIZE", "Header", "Item", "Message", "Raw", "decode", "describe", "encode"]


def __getattr__(name: str) -> Any:
    """Import the names of the package when one of them is first used: ``wire.header`` alone loads no codecs."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from igtl_gateway.wire import body, message

    globals().update({each: getattr(message, each, None) or getattr(body, each) for each in __all__})
    return globals()[name]
