"""What holds for the content of every type of message, with bytes that a test has written by hand."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, WireError
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.registry import BODIES


def f32(*values: float) -> bytes:
    return struct.pack(f">{len(values)}f", *values)


def text(value: str, width: int) -> bytes:
    """A field of text, padded with NUL."""
    return value.encode().ljust(width, b"\0")


def element(kind: type[Elements], *values: Any) -> Elements:
    """A list of one element."""
    return kind(np.array([values], kind.DTYPE))


def check_golden(body: Body, data: bytes, is_shorter_form: Callable[[int], bool] = lambda _: False) -> dict[str, Any]:
    """Check that a content is these bytes, and these bytes are it, whole; return its description, which is JSON.

    Args:
        body: the content.
        data: its bytes, written by hand.
        is_shorter_form: whether this number of bytes, less than all, is a content, too.
    """
    assert join(body.pack()) == data
    again = type(body).unpack(memoryview(data))
    assert join(again.pack()) == data
    described = body.describe()
    assert again.describe() == described == json.loads(json.dumps(described))
    for size in range(len(data)):
        if is_shorter_form(size):
            assert join(type(body).unpack(memoryview(data[:size])).pack()) == data[:size]
        else:
            with pytest.raises(WireError):
                type(body).unpack(memoryview(data[:size]))
    return described


def check_list(kind: type[Elements], size: int) -> None:
    """Check what holds for each type that is a list: its name, the bytes of an element, and invalid contents."""
    assert BODIES[kind.NAME] is kind
    assert kind.DTYPE.itemsize == size
    for extra in (1, -1):
        with pytest.raises(MalformedBody) as error:
            kind.unpack(memoryview(bytes(2 * size + extra)))
        assert str(error.value) == f"{kind.NAME} content: found {2 * size + extra} bytes, expected a multiple of {size}"
