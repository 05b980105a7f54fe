"""Which codec reads which type, empty contents, children of BIND."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import TruncatedMessage
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Raw
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.query import EmptyQuery
from igtl_gateway.wire.registry import ALIASES, BODIES, describe_content, read_child, read_content
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import TrackingData
from igtl_gateway.wire.transform import Position
from tests.tables import table
from tests.wire.contents import f32

HELLO = memoryview(b"\0\3\0\5hello")


def test_an_alias_is_read_as_the_type_that_it_means() -> None:
    assert ALIASES["QTRANS"] == "POSITION" and ALIASES["COLORTABLE"] == "COLORT" and ALIASES["CAPABIL"] == "CAPABILITY"
    assert all(BODIES[alias] is BODIES[meant] for alias, meant in ALIASES.items())
    assert not ALIASES.keys() & set(ALIASES.values()), "an alias is never sent"


def test_names_end_at_their_first_nul() -> None:
    """C++ readers stop there, too."""
    assert read_content("STRING\0junk", HELLO) == String(b"hello")


@table("kind", ["UNHEARDOF", "string", "STRING ", ""])
def test_other_types_are_carried_as_they_are(kind: str) -> None:
    assert read_content(kind, HELLO) == Raw(HELLO)


@table(
    ("kind", "codec"),
    [
        ("STRING", Raw), ("IMAGE", Raw), ("TRANSFORM", Raw), ("UNHEARDOF", Raw), ("TDATA", TrackingData),
        ("CAPABILITY", Capability), ("GET_STATUS", EmptyQuery),
    ],
)  # fmt: skip
def test_an_empty_content_has_no_fields_unless_it_may(kind: str, codec: type) -> None:
    assert type(read_content(kind, memoryview(b""))) is codec


def test_a_bad_content_is_refused_by_its_codec() -> None:
    with pytest.raises(TruncatedMessage, match="STRING content: found 3 bytes"):
        read_content("STRING", HELLO[:3])


def child(kind: str, name: str, content: bytes) -> BindChild:
    return BindChild(kind, name, content)


def test_children_are_described_with_their_contents_or_their_errors() -> None:
    inner = Bind((child("QTRANS", "pose", f32(1, 2, 3)),))
    packed = b"".join(bytes(part) for part in inner.pack())
    bind = Bind((child("STRING", "text", bytes(HELLO)), child("STATUS", "bad", b"\0\1"), child("BIND", "more", packed)))
    assert isinstance(read_child(bind.children[2]), Bind)
    with pytest.raises(TruncatedMessage):
        read_child(bind.children[1])
    good, bad, more = describe_content(bind)["children"]
    assert good["content"] == String(b"hello").describe()
    assert bad["error"] == {
        "code": "truncated",
        "text": "STATUS content: found 2 bytes, expected at least 30 bytes",
    }
    assert "content" not in bad and "error" not in good
    assert more["content"]["children"][0]["content"] == Position((1.0, 2.0, 3.0), form="position_only").describe()


def test_a_content_that_is_no_bind_is_described_by_itself() -> None:
    status = Status(1, 0, "", "ready")
    assert describe_content(status) == status.describe()
