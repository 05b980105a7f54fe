"""The properties of a received message that its type does not have."""

from __future__ import annotations

import pytest

from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.wire import Item, Message, Raw
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.tables import table

TEXT = ReceivedMessage(Message("STRING", "Greeting", String.of("hello")), 7, 5)
POSE = ReceivedMessage(Message("TRANSFORM", "Tool", Transform((0.0,) * 12)), 7, 5)


@table("name", ["matrix", "position", "poses", "positions", "names", "array", "unit", "name"])
def test_a_string_has_no(name: str) -> None:
    with pytest.raises(ConversionError, match=f"^STRING/Greeting: found a message without {name}, expected one of "):
        getattr(TEXT, name)


def test_a_pose_has_no_text() -> None:
    with pytest.raises(ConversionError, match="without text"):
        _ = POSE.text


def test_an_empty_message() -> None:
    empty = ReceivedMessage(Message("IMAGE", "Camera", Raw(b"")), 1, 0)
    assert empty.is_empty
    with pytest.raises(ConversionError, match="found an empty message"):
        _ = empty.array


def test_what_it_is() -> None:
    metadata = (Item.of("operator", "A. B."),)
    message = ReceivedMessage(Message("QTRANS", "Tool", Raw(b"x"), 5 << 32, 2, 3, metadata), 4, 9)
    assert (message.type, message.device, str(message)) == ("POSITION", "Tool", "POSITION/Tool")
    assert (message.source_ns, message.header_version, message.metadata) == (5_000_000_000, 2, {"operator": "A. B."})
    assert ReceivedMessage(Message("GET_TRANS", "", Raw(b"")), 1, 0).query == ("GET", "TRANSFORM")
    assert "STRING/Greeting" in repr(TEXT)
