"""Text in pieces is the text of one call."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base import long_text
from igtl_gateway.wire.text import CODECS, text_of


@pytest.fixture(autouse=True)
def short_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_text, "LONG", 0)
    monkeypatch.setattr(long_text, "_PIECE", 3)


def _whole(data: bytes, codec: str) -> str:
    try:
        return data.decode("utf-8" if codec == "ascii" else codec)
    except UnicodeDecodeError:
        return data.decode("utf-8", "replace")


@pytest.mark.parametrize("encoding", CODECS)
@given(data=st.binary(max_size=40) | st.text(max_size=20).map(lambda text: text.encode("utf-8")))
def test_bytes(encoding: int, data: bytes) -> None:
    assert text_of(data, encoding) == _whole(data, CODECS[encoding])


@pytest.mark.parametrize("encoding", CODECS)
@given(text=st.text(max_size=20))
def test_text_of_each_encoding(encoding: int, text: str) -> None:
    data = text.encode(CODECS[encoding], "replace")
    assert text_of(data, encoding) == _whole(data, CODECS[encoding])


@given(data=st.binary(max_size=40))
def test_undecodable_bytes(data: bytes) -> None:
    text = data.decode("utf-8", "surrogateescape")
    assert b"".join(long_text.encoded(text)) == data
    assert long_text.replaced(text) == text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    assert long_text.decoded(data, "utf-8", "surrogateescape") == text
