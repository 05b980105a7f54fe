from __future__ import annotations

import io

import av
import numpy as np
import pytest

from igtl_gateway.addon import WireError
from igtl_gateway.addon.igtl import Image, Message, encode
from igtl_gateway.addons.page.pictures import SMALL, small_png
from tests.integration.bridge import string


def message(pixels: np.ndarray, kind: int, parts: int = 1) -> bytes:
    rows, columns = pixels.shape[:2]
    image = Image((columns, rows, 1), kind, pixels.tobytes(), num_components=parts)
    return b"".join(encode(Message("IMAGE", "Camera", image, 1, 1, 0, ())))


def decoded(png: bytes, form: str) -> np.ndarray:
    with av.open(io.BytesIO(png)) as source:
        return np.asarray(next(source.decode(video=0)).to_ndarray(format=form))


def test_bytes_are_as_they_are() -> None:
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert (decoded(small_png(message(grey, 3)), "gray") == grey).all()
    colour = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    assert (decoded(small_png(message(colour, 3, 3)), "rgb24") == colour).all()


def test_other_values_are_scaled() -> None:
    depth = np.array([[0, 500], [1000, 250]], np.uint16)
    assert decoded(small_png(message(depth, 5)), "gray").tolist() == [[0, 127], [255, 63]]
    assert decoded(small_png(message(np.full((2, 2), np.nan, np.float32), 10)), "gray").tolist() == [[0, 0], [0, 0]]


def test_large_pictures_become_small() -> None:
    found = decoded(small_png(message(np.zeros((700, 1_000), np.uint8), 3)), "gray")
    assert max(found.shape) <= SMALL


def test_what_is_no_picture() -> None:
    with pytest.raises(WireError, match="found String, expected an IMAGE"):
        small_png(string("hello"))
    assert small_png(message(np.zeros((0, 0), np.uint8), 3)) == b""
