"""Contents: golden bytes written by hand, round trips, limits, lies."""

from __future__ import annotations

import json
import math
import struct
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join, total_size
from igtl_gateway.base.errors import ConversionError, MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.capability import MAX_TYPES, Capability
from igtl_gateway.wire.colort import ColorTable
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.fields import cut_text, decode_text, encode_text, visible
from igtl_gateway.wire.image import SCALARS, Image
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.ndarray import NDARRAY_SCALARS, NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import CODES, Status, String
from igtl_gateway.wire.tracking import TOOL_6D, QuaternionTrackingData, TrackingData
from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, Trajectories
from igtl_gateway.wire.transform import Position, Transform
from tests import strategies
from tests.tables import table
from tests.timing import quick

#: One type name of every class of contents: many queries share theirs.
KINDS = sorted({body: kind for kind, body in BODIES.items()}.values())


def f32(*values: float) -> bytes:
    return struct.pack(f">{len(values)}f", *values)


def one(kind: type[Elements], *values: Any) -> Elements:
    return kind(np.array([values], kind.DTYPE))


def text(value: str, width: int) -> bytes:
    return value.encode().ljust(width, b"\0")


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
    (
        "tools",
        one(TrackingData, "probe", TOOL_6D, 0, [0, 1, 0, -1, 0, 0, 0, 0, 1, 10, 20, 30]),
        text("probe", 20) + b"\2\0" + f32(0, 1, 0, -1, 0, 0, 0, 0, 1, 10, 20, 30),
    ),
    (
        "tools with quaternions",
        one(QuaternionTrackingData, "é".encode(), 4, 7, [1, 2, 3], [0, 0, 1, 0]),
        text("é", 20) + b"\4\7" + f32(1, 2, 3, 0, 0, 1, 0),
    ),
    (
        "trajectory",
        one(Trajectories, "t", "g", ENTRY_AND_TARGET, 0, [1, 2, 3, 4], [1, 2, 3], [4, 5, 6], 2.5, "ct"),
        text("t", 64) + text("g", 32) + b"\3\0\1\2\3\4" + f32(1, 2, 3, 4, 5, 6, 2.5) + text("ct", 20),
    ),
    (
        "list of images",
        one(ImageMetaList, "head", "CT1", "CT", "Doe", "007", 0x0000000180000000, [512, 256, 3], 5, 0),
        text("head", 64)
        + text("CT1", 20)
        + text("CT", 32)
        + text("Doe", 64)
        + text("007", 64)
        + b"\0\0\0\1\x80\0\0\0"
        + b"\2\0\1\0\0\3"
        + b"\5\0",
    ),
    (
        "list of labels",
        one(LabelMetaList, "liver", "L1", 9, 0, [1, 2, 3, 4], [512, 256, 3], "CT1"),
        text("liver", 64) + text("L1", 20) + b"\x09\0\1\2\3\4" + b"\2\0\1\0\0\3" + text("CT1", 20),
    ),
    (
        "list of videos",
        one(VideoMetaList, "scope", "V1", "Doe", "007", -2, 50.0, [640, 480, 1], range(12), 3, 0),
        text("scope", 64)
        + text("V1", 64)
        + text("Doe", 64)
        + text("007", 64)
        + struct.pack(">hd3H", -2, 50.0, 640, 480, 1)
        + f32(*range(12))
        + b"\3\0",
    ),
    (
        "sensor",
        Sensor(np.array([1.0, -2.5]), 0x00443E0000000000),
        b"\2\0" + bytes.fromhex("00443e0000000000") + struct.pack(">2d", 1.0, -2.5),
    ),
    ("sensor without values", Sensor(np.zeros(0)), bytes(10)),
    ("array", NdArray(4, (2, 1), b"\0\1\xff\xff"), b"\4\2\0\2\0\1\0\1\xff\xff"),
    ("complex array", NdArray(13, (1,), struct.pack(">2d", 1, -2)), b"\x0d\1\0\1" + struct.pack(">2d", 1, -2)),
    ("colours", ColorTable(3, 19, bytes(range(256)) * 3), b"\3\x13" + bytes(range(256)) * 3),
    ("capability", Capability(("IMAGE", "GET_POLYDATA")), b"IMAGE" + bytes(7) + b"GET_POLYDATA"),
]


@table(("body", "data"), [case[1:] for case in GOLDEN], ids=[case[0] for case in GOLDEN])
def test_golden_bytes(body: Body, data: bytes) -> None:
    assert join(body.pack()) == data
    assert join(type(body).unpack(memoryview(data)).pack()) == data
    json.dumps(body.describe())  # JSON values


@table(("body", "data"), [case[1:] for case in GOLDEN], ids=[case[0] for case in GOLDEN])
def test_every_truncation_is_a_wire_error_or_a_shorter_form(body: Body, data: bytes) -> None:
    for size in range(len(data)):
        try:
            shorter = type(body).unpack(memoryview(data[:size]))
        except WireError:
            continue
        # STATUS has no length, POSITION has short forms, no points are points
        assert isinstance(shorter, Status | Position | Elements | Capability)
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


@table(
    "changes",
    [
        {"components": 0},
        {"components": 2},
        {"scalar": 0},
        {"scalar": 8},
        {"scalar": 13},
        {"endian": 0, "scalar": 5, "pixels": bytes(48)},
        {"endian": 3},
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


@table(
    "changes",
    [
        {"coordinate": 0},  # LPS before 2013 and in openigtlink4java; the C++ library takes any byte
        {"scalar": 15},  # VTK's signed char, from 3D Slicer
        {"endian": 0},  # of pixels of one byte, which have no order
        {"endian": 0, "scalar": 15},
    ],
)
def test_an_image_of_a_program_that_means_something_by_it_is_accepted(changes: dict[str, Any]) -> None:
    data = image_content(**changes, pixels=bytes(range(24)))
    image = Image.unpack(memoryview(data))
    assert join(image.pack()) == data
    assert image.is_lps == ("coordinate" in changes)
    assert image.number_type == (2 if "scalar" in changes else 3)
    assert image.array.shape == (4, 3, 2, 1) and image.array[0, 0, 1, 0] == 1
    assert image.dtype.kind == ("i" if "scalar" in changes else "u")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"scalar": 8, "pixels": b""},
            "found 8 (VTK's long), expected one of [2, 3, 4, 5, 6, 7, 10, 11]: cast",
        ),
        ({"scalar": 16, "pixels": b""}, "found 16 (VTK's long long)"),
        (
            {"scalar": 15, "pixels": b""},
            "expected 24 bytes for (2, 3, 4): the C++ library knows no size",
        ),
        ({"scalar": 9}, "in 3D Slicer"),
    ],
)
def test_a_refused_type_of_slicer_is_named_as_slicer_does(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(MalformedBody) as caught:
        Image.unpack(memoryview(image_content(**changes)))
    assert reason in str(caught.value)


def test_a_bind_without_children_of_the_cpp_library_has_none() -> None:
    """It reserves 4 bytes, and writes nothing into them."""
    for data in (bytes(4), b"\xa5" * 4):
        bind = Bind.unpack(memoryview(data))
        assert bind.children == () and join(bind.pack()) == data


@pytest.mark.parametrize("kind", ["STT_TDATA", "STT_QTDATA", "STT_IMAGE", "STT_SENSOR"])
def test_the_interval_of_openigtlink4j_is_a_long(kind: str) -> None:
    for interval in (0, 50, 2**40):
        data = struct.pack(">q", interval)
        query = BODIES[kind].unpack(memoryview(data))
        assert query.resolution == interval and join(query.pack()) == data  # type: ignore[attr-defined]


@pytest.mark.parametrize("size", [0, 71])
def test_image_head_is_cut_off(size: int) -> None:
    with pytest.raises(TruncatedMessage):
        Image.unpack(memoryview(image_content()[:size]))


def test_sub_volume() -> None:
    image = Image.unpack(memoryview(image_content(offset=(1, 1, 2), size=(1, 2, 1), pixels=b"\5\6")))
    assert image.array[:, :, :, 0].tolist() == [[[5], [6]]]
    assert (image.dimensions, image.subvol_offset, image.sub_size) == ((2, 3, 4), (1, 1, 2), (1, 2, 1))


@table("scalar", sorted(SCALARS))
@table(("endian", "order"), [(1, ">"), (2, "<")])
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


LISTS = [Points, TrackingData, QuaternionTrackingData, Trajectories, ImageMetaList, LabelMetaList, VideoMetaList]
lists = pytest.mark.parametrize("kind", LISTS, ids=[kind.NAME for kind in LISTS])


@lists
def test_lists_are_registered(kind: type[Elements]) -> None:
    assert BODIES[kind.NAME] is kind


@lists
@pytest.mark.parametrize("size", [1, -1])
def test_a_list_holds_whole_elements(kind: type[Elements], size: int) -> None:
    with pytest.raises(MalformedBody) as error:
        kind.unpack(memoryview(bytes(2 * kind.DTYPE.itemsize + size)))
    assert error.value.place == f"{kind.NAME} content"
    assert str(kind.DTYPE.itemsize) in str(error.value)


@lists
def test_any_bytes_are_a_list(kind: type[Elements]) -> None:
    """Reserved bytes, text behind a NUL and every NaN come back as they went."""

    @given(st.integers(0, 3).flatmap(lambda count: st.binary(min_size=(n := count * kind.DTYPE.itemsize), max_size=n)))
    def run(data: bytes) -> None:
        content = kind.unpack(memoryview(data))
        assert join(content.pack()) == data
        assert len(content) == len(data) // kind.DTYPE.itemsize == len(content.describe()["elements"])
        assert content == kind.unpack(memoryview(data))
        if data:
            other = bytes([data[0] ^ 1]) + data[1:]
            assert content != kind.unpack(memoryview(other))
            assert content != kind.unpack(memoryview(data + data))

    run()


@lists
def test_lists_made_of_other_arrays(kind: type[Elements]) -> None:
    """Every second element of an array, and an array in the order of the machine."""
    array = np.frombuffer(bytes(range(256)) * kind.DTYPE.itemsize, kind.DTYPE)[:6]
    native = array.astype(kind.DTYPE.newbyteorder("="))
    assert kind(native) == kind(array)
    assert join(kind(array[::2]).pack()) == b"".join(array[index].tobytes() for index in (0, 2, 4))


def test_lists_of_two_types_differ() -> None:
    empty: list[Elements] = [kind(np.zeros(0, kind.DTYPE)) for kind in LISTS]
    assert all((a == b) is (a is b) for a in empty for b in empty)
    assert empty[0] != Raw(b"")
    with pytest.raises(TypeError):
        hash(empty[0])


def test_lists_as_json() -> None:
    described = {name: body.describe() for name, body, _ in GOLDEN}
    assert described["tools"] == {
        "elements": [
            {"name": "probe", "type": 2, "matrix": [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]},
        ]
    }
    (image,) = described["list of images"]["elements"]
    assert (image["timestamp"], image["size"]) == ({"sec": 1, "nanosec": 500_000_000}, [512, 256, 3])
    (video,) = described["list of videos"]["elements"]
    assert (video["zoom_level"], video["wire_matrix"]) == (-2, [float(number) for number in range(12)])
    assert not any("reserved" in body["elements"][0] for body in described.values() if "elements" in body)


ZEROS = bytes(600)
#: Contents that are refused, what the error is, and what its text must name.
BAD: list[tuple[type[Body], bytes, type[WireError], str]] = [
    (Sensor, b"", TruncatedMessage, "at least 10"),
    (Sensor, ZEROS[:9], TruncatedMessage, "9 bytes"),
    (Sensor, b"\x02" + ZEROS[:9] + ZEROS[:8], MalformedBody, "26 bytes for 2 values"),
    (Sensor, b"\x01" + ZEROS[:9] + ZEROS[:9], MalformedBody, "18 bytes for 1 values"),
    (Sensor, b"\xff" * 100, MalformedBody, "2050 bytes for 255 values"),
    (NdArray, b"\x03", TruncatedMessage, "at least 2"),
    (NdArray, b"\x03\x02\0\1\0", TruncatedMessage, "2 sizes of 2 bytes"),
    (NdArray, b"\x03\xff", TruncatedMessage, "255 sizes of 2 bytes"),
    (NdArray, b"\x03\0", MalformedBody, "dimensions: found 0, expected 1 … 255"),
    (NdArray, b"\x03\0x", MalformedBody, "dimensions"),
    (NdArray, b"\x01\1\0\0", MalformedBody, "scalar type: found 1"),
    (NdArray, b"\x08\1\0\1x", MalformedBody, "scalar type: found 8"),
    (NdArray, b"\x03\1\0\2x", MalformedBody, "found 1 bytes, expected 2 bytes"),
    (NdArray, b"\x03\1\0\1xx", MalformedBody, "found 2 bytes, expected 1 bytes"),
    (NdArray, b"\x0d\1\0\1" + ZEROS[:8], MalformedBody, "expected 16 bytes"),
    (NdArray, b"\x0b\4" + b"\xff" * 8, MalformedBody, str(65535**4 * 8)),  # 2⁶⁷: no machine word holds it
    (ColorTable, b"\x03", TruncatedMessage, "at least 2"),
    (ColorTable, b"\x04\x03" + ZEROS[:256], MalformedBody, "index type: found 4"),
    (ColorTable, b"\x03\x04" + ZEROS[:256], MalformedBody, "map type: found 4"),
    (ColorTable, b"\x03\x03" + ZEROS[:255], MalformedBody, "found 255 bytes, expected 256"),
    (ColorTable, b"\x03\x05" + ZEROS[:513], MalformedBody, "found 513 bytes, expected 512"),
    (ColorTable, b"\x05\x13" + ZEROS[:256], MalformedBody, "expected 196608"),
    (Capability, ZEROS[:11], MalformedBody, "a multiple of 12"),
    (Capability, ZEROS[:25], MalformedBody, "found 25 bytes"),
    (Capability, bytes(12 * (MAX_TYPES + 1)), MalformedBody, f"at most {MAX_TYPES}"),
]


@table(("kind", "content", "error", "named"), BAD)
def test_bad_contents(kind: type[Body], content: bytes, error: type[WireError], named: str) -> None:
    with pytest.raises(error) as raised:
        kind.unpack(memoryview(content))
    assert type(raised.value) is error
    assert named in str(raised.value)


@table(
    "body",
    [
        Sensor(np.zeros(256)),
        Sensor(np.zeros(1), 1 << 64),
        Sensor(np.zeros(1), -1),
        Sensor(np.zeros(1), 0, 256),
        NdArray(1, (1,), b"x"),
        NdArray(3, (), b"x"),
        NdArray(3, (1,) * 256, b"x"),
        NdArray(3, (2,), b"x"),
        NdArray(3, (65536,), bytes(65536)),
        NdArray(3, (-1, -1), b"x"),
        ColorTable(3, 3, bytes(255)),
        ColorTable(4, 3, bytes(256)),
        ColorTable(3, 300, bytes(256)),
        Capability(("GET_POLYDATA_",)),
        Capability(("é" * 7,)),
        Capability(("X",) * (MAX_TYPES + 1)),
    ],
    ids=lambda body: type(body).__name__,
)
def test_what_the_layout_cannot_hold(body: Body) -> None:
    with pytest.raises(MalformedBody):
        body.pack()


@table("scalar", sorted(NDARRAY_SCALARS))
def test_arrays_in_rows(scalar: int) -> None:
    """Big-endian, the last index fastest."""
    values = np.arange(24).reshape(2, 3, 4).astype(NDARRAY_SCALARS[scalar])
    again = NdArray.unpack(memoryview(join(NdArray(scalar, (2, 3, 4), values.tobytes()).pack())))
    assert again.array[1, 2, 3] == 23
    assert again.array[0, 1].tolist() == [4, 5, 6, 7]
    assert again.array.dtype == NDARRAY_SCALARS[scalar]
    assert np.shares_memory(again.array, again.flat)


@pytest.mark.parametrize(("size", "count"), [((1,) * 255, 1), ((0,) + (65535,) * 9, 0)])
def test_shapes_beyond_numpy(size: tuple[int, ...], count: int) -> None:
    """Valid on the wire: carried and described, but numpy has no such array."""
    content = NdArray.unpack(memoryview(join(NdArray(3, size, bytes(count)).pack())))
    assert content.describe() == {"scalar_type": 3, "size": list(size), "data": [0] * count}
    with pytest.raises(ConversionError):
        _ = content.array


def test_complex_numbers() -> None:
    content = NdArray(13, (2,), struct.pack(">4d", 1, -2, 0.5, 0))
    assert content.array.tolist() == [1 - 2j, 0.5]
    assert content.describe()["data"] == [1.0, -2.0, 0.5, 0.0]
    long = NdArray(13, (129,), bytes(129 * 16))
    assert long.describe()["data"] == {"count": 258, "crc64": "0" * 16}


def test_color_tables() -> None:
    assert ColorTable(3, 3, bytes(range(256))).array.tolist() == list(range(256))
    assert ColorTable(3, 5, b"\1\2" * 256).array.tolist() == [0x0102] * 256
    assert ColorTable(3, 19, b"\1\2\3" * 256).array.tolist() == [[1, 2, 3]] * 256
    assert ColorTable(5, 3, bytes(65536)).describe()["table"] == {"count": 65536, "crc64": "0" * 16}


def test_capability_without_types() -> None:
    assert Capability.unpack(memoryview(b"")) == Capability(())
    assert Capability(()).pack() == []
    assert Capability(("A\0junk", "\udcff")).describe() == {"types": ["A", "\ufffd"]}


#: What must arrive with every bit of its NaNs.
EXACT = [*(kind.NAME for kind in LISTS), "SENSOR", "NDARRAY", "COLORT", "CAPABILITY"]


@pytest.mark.slow
@table("kind", EXACT)
def test_what_is_decoded_equals_what_was_encoded(kind: str) -> None:
    @given(strategies.bodies()[kind], st.sampled_from([1, 2]))
    def run(body: Body, version: int) -> None:
        message = Message(kind, "device", body, 1, version)
        assert decode(join(encode(message))) == message

    run()


@pytest.mark.slow
@table("kind", KINDS)
def test_round_trip_of_every_body(kind: str) -> None:
    @given(strategies.bodies(strategies.finite32)[kind])
    def run(body: Body) -> None:
        data = join(body.pack())
        assert total_size(body.pack()) == len(data)
        if data:
            again = BODIES[kind].unpack(memoryview(data))
            assert join(again.pack()) == data
            assert again == body
            assert json.dumps(again.describe()) == json.dumps(body.describe())

    run()


@pytest.mark.slow
@table("kind", KINDS)
def test_arbitrary_content_raises_only_wire_errors(kind: str) -> None:
    @given(st.binary(max_size=150) | strategies.damaged(strategies.bodies()[kind].map(lambda b: join(b.pack())), 0))
    def run(data: bytes) -> None:
        try:
            body = BODIES[kind].unpack(memoryview(data))
        except WireError:
            return
        body.describe()
        assert join(body.pack()) == data

    run()


@table("kind", KINDS)
def test_ones_all_over_cost_nothing(kind: str) -> None:
    """Every count and size at its maximum: refused or read, without the memory that they announce."""
    contents = [b"\xff" * size for size in (1, 12, 28, 40, 48, 72, 136, 1000)]
    tracemalloc.start()
    with quick():
        for content in contents:
            try:
                BODIES[kind].unpack(memoryview(content))
            except WireError:
                pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000


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
