"""The stream, type and stamp that the header of a message names."""

from __future__ import annotations

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import TruncatedMessage
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.session import header_names
from igtl_gateway.wire import HEADER_SIZE, Message, encode
from igtl_gateway.wire.text import String

HELLO = join(encode(Message("STRING", "Greeting", String.of("hello"), 7 << 32)))


def test_stream_type_and_stamp() -> None:
    assert header_names(HELLO) == ("STRING/Greeting", "STRING", 7 * NS_PER_S)
    assert header_names(HELLO[:HEADER_SIZE]) == header_names(HELLO), "the body is not looked at"


def test_less_than_a_header_is_refused() -> None:
    with pytest.raises(TruncatedMessage, match=str(HEADER_SIZE)):
        header_names(HELLO[: HEADER_SIZE - 1])
