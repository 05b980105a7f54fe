"""Contents: golden bytes written by hand, round trips, limits, lies."""

from __future__ import annotations

import json
import math
import struct
import time
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.buffers import join, total_size
from igtl_gateway.errors import MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.fields import cut_text, decode_text, encode_text, visible
from igtl_gateway.wire.image import SCALARS, Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import CODES, Status, String
from igtl_gateway.wire.transform import Position, Transform
from tests import strategies


def f32(*values: float) -> bytes:
    return struct.pack(f">{len(values)}f", *values)


GOLDEN: list[tuple[str, Body, bytes]] = [
    (
        "transform",  # a quarter turn about z, then 10, 20, 30: column by column
        Transform.from_rows([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]),
        f32(0, 1, 0, -1, 0, 0, 0, 0, 1, 10, 20, 30),
    ),
    ("position", Position((1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 0.0)), f32(1, 2, 3, 0, 0, 1, 0)),
    ("position without w", Position((1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5), "quaternion3"), f32(1, 2, 3, 0.5, 0.5, 0.5)),
    ("position alone", Position((1.0, 2.0, 3.0), form="position_only"), f32(1, 2, 3)),
    ("string", String("é".encode(), 106), b"\x00\x6a\x00\x02\xc3\xa9"),
    ("empty string", String(b""), b"\x00\x03\x00\x00"),
    (
        "status",
        Status(13, -2, "E", "wait"),
        b"\x00\x0d" + b"\xff" * 7 + b"\xfe" + b"E".ljust(20, b"\0") + b"wait\0",
    ),
    ("status without NUL", Status(1, 0, "", "x", False), b"\x00\x01" + bytes(28) + b"x"),
    (
        "image",
        Image((2, 1, 1), 5, b"\x34\x12\x78\x56"),
        b"\0\1\1\5\2\1" + b"\0\2\0\1\0\1" + f32(1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0) + bytes(6) + b"\0\2\0\1\0\1"
        b"\x34\x12\x78\x56",
    ),
    (
        "point",
        Points.of(np.array([[1.0, 2.0, 3.0]]), np.array([[1, 2, 3, 4]], np.uint8), 5.0),
        bytes(96) + b"\1\2\3\4" + f32(1, 2, 3, 5) + bytes(20),
    ),
]


@pytest.mark.parametrize(("body", "data"), [case[1:] for case in GOLDEN], ids=[case[0] for case in GOLDEN])
def test_golden_bytes(body: Body, data: bytes) -> None:
    assert join(body.pack()) == data
    assert join(type(body).unpack(memoryview(data)).pack()) == data
    json.dumps(body.describe())  # JSON values


@pytest.mark.parametrize(("body", "data"), [case[1:] for case in GOLDEN], ids=[case[0] for case in GOLDEN])
def test_every_truncation_is_a_wire_error_or_a_shorter_form(body: Body, data: bytes) -> None:
    for size in range(len(data)):
        try:
            shorter = type(body).unpack(memoryview(data[:size]))
        except WireError:
            continue
        # STATUS has no length, POSITION has short forms, no points are points
        assert isinstance(shorter, Status | Position | Points)
        assert join(shorter.pack()) == data[:size]


def test_transform_rows() -> None:
    rows = [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0], [9.0, 10.0, 11.0, 12.0]]
    assert Transform.from_rows(rows).rows == [*rows, [0.0, 0.0, 0.0, 1.0]]


@pytest.mark.parametrize(("value", "fits"), [(3.4028234e38, True), (3.5e38, False), (math.inf, True), (1e300, False)])
def test_numbers_beyond_float32(value: float, fits: bool) -> None:
    bodies: list[Body] = [
        Transform((value,) * 12),
        Position((value, 0.0, 0.0)),
        Image((0, 0, 0), 3, b"", wire_matrix=(value,) * 12),
    ]
    for body in bodies:
        if fits:
            join(body.pack())
        else:
            with pytest.raises(MalformedBody):
                body.pack()


@given(st.tuples(*[strategies.any32] * 3))
def test_w_is_reconstructed(xyz: tuple[float, float, float]) -> None:
    w = Position.unpack(memoryview(f32(0, 0, 0, *xyz))).quaternion[3]
    rest = 1.0 - sum(value * value for value in xyz)
    assert math.isnan(w) if math.isnan(rest) else w == pytest.approx(math.sqrt(max(rest, 0.0)), abs=1e-7)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (String(b"abc"), "abc"),
        (String("é".encode()), "é"),  # Slicer and PLUS: UTF-8, whatever they name
        (String(b"\xe9", 4), "é"),
        (String("é".encode("utf-16-be"), 1013), "é"),
        (String(b"\xd8", 1013), "\ufffd"),  # half a character
        (String(b"\xff", 106), "\ufffd"),
        (String(b"abc", 9999), "abc"),
    ],
)
def test_encodings_of_strings(content: String, text: str) -> None:
    assert content.text == text


@pytest.mark.parametrize("size", [0, 1, 3])
def test_string_head_is_cut_off(size: int) -> None:
    with pytest.raises(TruncatedMessage):
        String.unpack(memoryview(bytes(size)))


@pytest.mark.parametrize("length", [0, 1, 3, 65535])
def test_string_length_must_be_true(length: int) -> None:
    with pytest.raises(MalformedBody):
        String.unpack(memoryview(struct.pack(">HH", 3, length) + b"ab"))


def test_longest_string() -> None:
    assert len(join(String(bytes(65535)).pack())) == 65539


def test_status_codes_are_those_of_the_document() -> None:
    assert [CODES.index(name) for name in ("OK", "busy", "not ready", "shutting down")] == [1, 6, 13, 19]


def test_status_of_a_default_constructed_cpp_object() -> None:
    """PLUS's keep-alive: a newline and garbage in the error name."""
    data = b"\0\1" + bytes(8) + b"\n\x00garbage\xff\xfe".ljust(20, b"\0") + b"\0"
    status = Status.unpack(memoryview(data))
    assert join(status.pack()) == data
    assert status.describe()["error_name"] == "\n"


def image_content(**changes: Any) -> bytes:
    fields: dict[str, Any] = {"version": 1, "components": 1, "scalar": 3, "endian": 2, "coordinate": 1}
    fields |= {"dims": (2, 3, 4), "offset": (0, 0, 0), "size": (2, 3, 4), "pixels": bytes(24)} | changes
    return (
        struct.pack(">HBBBB3H", *list(fields.values())[:5], *fields["dims"])
        + f32(*[0] * 12)
        + struct.pack(">6H", *fields["offset"], *fields["size"])
        + bytes(fields["pixels"])
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"components": 0},
        {"components": 2},
        {"scalar": 0},
        {"scalar": 8},
        {"scalar": 13},
        {"endian": 0},
        {"endian": 3},
        {"coordinate": 0},
        {"coordinate": 3},
        {"offset": (1, 0, 0)},
        {"size": (2, 4, 4)},
        {"size": (65535, 65535, 65535), "dims": (65535, 65535, 65535)},
        {"size": (0, 3, 4)},
        {"pixels": bytes(23)},
        {"pixels": bytes(25)},
        {"scalar": 11},
    ],
)
def test_contradictions_in_an_image(changes: dict[str, Any]) -> None:
    Image.unpack(memoryview(image_content()))
    with pytest.raises(MalformedBody):
        Image.unpack(memoryview(image_content(**changes)))


@pytest.mark.parametrize("size", [0, 71])
def test_image_head_is_cut_off(size: int) -> None:
    with pytest.raises(TruncatedMessage):
        Image.unpack(memoryview(image_content()[:size]))


def test_sub_volume() -> None:
    image = Image.unpack(memoryview(image_content(offset=(1, 1, 2), size=(1, 2, 1), pixels=b"\5\6")))
    assert image.array[:, :, :, 0].tolist() == [[[5], [6]]]
    assert (image.dimensions, image.subvol_offset, image.sub_size) == ((2, 3, 4), (1, 1, 2), (1, 2, 1))


@pytest.mark.parametrize("scalar", sorted(SCALARS))
@pytest.mark.parametrize(("endian", "order"), [(1, ">"), (2, "<")])
def test_pixels_in_both_byte_orders(scalar: int, endian: int, order: str) -> None:
    """i runs fastest, then j, then k; components are interleaved."""
    values = np.arange(2 * 3 * 4 * 2).reshape(4, 3, 2, 2).astype(order + SCALARS[scalar])
    image = Image((2, 3, 4), scalar, values.tobytes(), 2, endian)
    again = Image.unpack(memoryview(join(image.pack())))
    assert again.array[3, 2, 1].tolist() == [46, 47]
    assert again.array[0, 0, 1].tolist() == [2, 3]
    assert (again.array == values).all()


@pytest.mark.parametrize("dimensions", [(65536, 1, 1), (-1, 1, 1)])
def test_image_sizes_beyond_their_fields(dimensions: tuple[int, int, int]) -> None:
    with pytest.raises(MalformedBody):
        Image(dimensions, 3, bytes(max(dimensions[0], 0))).pack()


def test_points_are_views() -> None:
    data = np.zeros(3 * 136, np.uint8)
    points = Points.unpack(data.data)
    assert np.shares_memory(points.elements, data)
    (only,) = points.pack()
    assert np.shares_memory(np.frombuffer(only, np.uint8), data)


@pytest.mark.parametrize("size", [1, 135, 137])
def test_points_of_broken_size(size: int) -> None:
    with pytest.raises(MalformedBody):
        Points.unpack(memoryview(bytes(size)))


@pytest.mark.parametrize("kind", sorted(BODIES))
def test_round_trip_of_every_body(kind: str) -> None:
    @given(strategies.bodies(strategies.finite32)[kind])
    def run(body: Body) -> None:
        data = join(body.pack())
        assert total_size(body.pack()) == len(data)
        if data:
            again = BODIES[kind].unpack(memoryview(data))
            assert join(again.pack()) == data
            assert json.dumps(again.describe()) == json.dumps(body.describe())

    run()


@pytest.mark.parametrize("kind", sorted(BODIES))
def test_arbitrary_content_raises_only_wire_errors(kind: str) -> None:
    @given(st.binary(max_size=150) | strategies.damaged(strategies.bodies()[kind].map(lambda b: join(b.pack())), 0))
    def run(data: bytes) -> None:
        try:
            body = BODIES[kind].unpack(memoryview(data))
        except WireError:
            return
        body.describe()
        assert len(join(body.pack())) == len(data)

    run()


@pytest.mark.parametrize("kind", sorted(BODIES))
def test_ones_all_over_cost_nothing(kind: str) -> None:
    """Every count and size at its maximum: refused or read, without the memory that they announce."""
    contents = [b"\xff" * size for size in (1, 12, 28, 40, 48, 72, 136, 1000)]
    tracemalloc.start()
    began = time.perf_counter()
    for content in contents:
        try:
            BODIES[kind].unpack(memoryview(content))
        except WireError:
            pass
    spent = time.perf_counter() - began
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000
    assert spent < 1.0


def test_raw_shows_its_beginning() -> None:
    assert Raw(b"").describe() == {}
    assert Raw(bytes(100)).describe() == {"raw_size": 100, "raw_hex": "00" * 64}


@given(st.binary(max_size=20))
def test_text_fields_lose_nothing(data: bytes) -> None:
    assert encode_text(decode_text(data), 20, "x") == data.ljust(20, b"\0")
    visible(decode_text(data)).encode("utf-8")


@given(st.text(), st.integers(0, 12))
def test_cut_text(text: str, width: int) -> None:
    cut = cut_text(text, width)
    assert text.startswith(cut)
    assert len(cut.encode()) <= width
    if cut != text:  # the next character would not have fitted
        assert len(text[: len(cut) + 1].encode()) > width
