"""Plain values as contents, and the contents as plain values."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from igtl_gateway.api.contents import VALUE_TYPES, content_of
from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.image import LPS, Image
from igtl_gateway.wire.registry import ALIASES, BODIES
from tests.tables import table

#: A rotation by 90° about z, and (1, 2, 3) mm.
POSE = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def received(type_name: str, value: object, **options: Any) -> ReceivedMessage:
    content = content_of(type_name, value, **options)
    return ReceivedMessage(decode(b"".join(encode(Message(type_name, "D", content)))), 1, 0)


@pytest.mark.parametrize("type_name", ["TRANSFORM", "POSITION"])
def test_a_pose(type_name: str) -> None:
    message = received(type_name, POSE)
    np.testing.assert_allclose(message.matrix, POSE, atol=1e-7)
    assert message.position.tolist() == [1, 2, 3]
    assert received(type_name, POSE[:3]).matrix.tolist() == message.matrix.tolist()


def test_a_position_without_rotation_and_with_a_quaternion() -> None:
    assert received("POSITION", [1, 2, 3]).matrix[:3, 3].tolist() == [1, 2, 3]
    np.testing.assert_allclose(
        received("POSITION", ([1, 2, 3], [0, 0, np.sqrt(0.5), np.sqrt(0.5)])).matrix, POSE, atol=1e-7
    )


@pytest.mark.parametrize("type_name", ["TDATA", "QTDATA"])
def test_poses_by_name(type_name: str) -> None:
    message = received(type_name, {"Probe": POSE, "Needle": np.eye(4)})
    assert message.names == ["Probe", "Needle"] == list(message.poses)
    np.testing.assert_allclose(message.poses["Probe"], POSE, atol=1e-7)


@table("kind", ["i1", "u1", "<i2", ">u2", "<i4", ">u4", "<f4", ">f8"])
@table("shape", [(3, 4), (2, 3, 4), (2, 3, 4, 3)])
def test_an_image(kind: str, shape: tuple[int, ...]) -> None:
    pixels = np.arange(np.prod(shape)).astype(kind).reshape(shape)
    message = received("IMAGE", pixels, matrix=POSE)
    wanted = pixels[np.newaxis] if len(shape) == 2 else pixels
    np.testing.assert_array_equal(message.array, wanted)
    assert message.array.dtype == pixels.dtype
    np.testing.assert_allclose(message.matrix, POSE, atol=1e-6)


def test_where_the_first_voxel_is() -> None:
    """The wire has the centre of the volume: 3 columns of 2 mm have it 2 mm from the first one."""
    spacing = np.diag([2.0, 3.0, 4.0, 1.0])
    content = content_of("IMAGE", np.zeros((5, 2, 3), np.uint8), spacing)
    assert content.describe()["wire_matrix"][9:] == [2.0, 1.5, 8.0]


def test_a_strided_array_and_booleans() -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(4, 6)[:, ::2]
    assert received("IMAGE", pixels).array[0].tolist() == pixels.tolist()
    assert received("IMAGE", pixels > 5).array[0].tolist() == (pixels > 5).astype(int).tolist()


def test_an_image_in_lps_is_in_ras_here() -> None:
    image = Image((1, 1, 1), 3, b"x", coordinate=LPS, wire_matrix=(*Image.IDENTITY[:9], 1.0, 2.0, 3.0))
    assert received("IMAGE", image).matrix[:3, 3].tolist() == [-1, -2, 3]


def test_texts_and_numbers() -> None:
    assert received("STRING", "Grüße").text == "Grüße"
    assert received("CLIENTINFO", "<ClientInfo/>").text == "<ClientInfo/>"
    assert received("STATUS", "fine").text == "fine"
    assert received("STATUS", 13).describe()["code"] == 13
    sensor = received("SENSOR", [1.5, 2.5], unit="mm/s")
    assert (sensor.array.tolist(), sensor.unit) == ([1.5, 2.5], "mm/s")
    assert received("NDARRAY", [[1, 2], [3, 4]]).array.tolist() == [[1, 2], [3, 4]]
    assert received("CAPABILITY", ["IMAGE", "STRING"]).describe() == {"types": ["IMAGE", "STRING"]}


def test_points_and_surfaces() -> None:
    points = [[1.0, 2, 3], [4, 5, 6], [7, 8, 10]]
    assert received("POINT", points).positions.tolist() == points
    assert received("POLYDATA", points).positions.tolist() == points
    surface = received("POLYDATA", (points, [[0, 1, 2]]))
    assert surface.describe()["polygons"] == [[0, 1, 2]]


@table("type_name", sorted(BODIES.keys() - ALIASES.keys()))
def test_every_type_takes_its_own_content_and_bytes(type_name: str) -> None:
    empty = content_of(type_name, None)
    assert content_of(type_name, empty) is empty
    data = b"".join(encode(Message(type_name, "", empty)))
    assert b"".join(encode(decode(data))) == data


@table(
    ("type_name", "value", "options", "text"),
    [
        ("TRANSFORM", np.eye(3), {}, "found shape (3, 3), expected numbers of shape (4, 4) or (3, 4)"),
        ("TRANSFORM", "text", {}, "TRANSFORM: found 'text', expected numbers"),
        ("TRANSFORM", np.ones((4, 4)), {}, "expected 0, 0, 0, 1"),
        ("TRANSFORM", np.eye(4), {"matrix": np.eye(4)}, "expected it with IMAGE only"),
        ("TRANSFORM", np.eye(4), {"unit": "mm"}, "expected it with SENSOR only"),
        ("POSITION", np.diag([2.0, 2, 2, 1]), {}, "expected an orthonormal one"),
        ("POSITION", np.diag([-1.0, 1, 1, 1]), {}, "expected an orthonormal one"),
        ("STRING", 5, {}, "STRING: found 5, expected a string"),
        ("STATUS", 1.5, {}, "STATUS: found 1.5, expected a code"),
        ("IMAGE", np.zeros(3), {}, "IMAGE: found shape (3,), float64"),
        ("IMAGE", np.zeros((2, 2), complex), {}, "complex128, expected shape"),
        ("POINT", [[1, 2]], {}, "expected numbers of shape (n, 3)"),
        ("POLYDATA", ([[1, 2, 3]], [[0, 0, 1]]), {}, "found point index 1, expected 0 to 0"),
        ("SENSOR", [1.0], {"unit": "furlong"}, "SENSOR: unit 'furlong'"),
        ("NDARRAY", [2**40], {}, "NDARRAY: found shape (1,), int64"),
        ("TDATA", [1], {}, "expected poses by name"),
        ("CAPABILITY", "IMAGE", {}, "expected type names"),
        ("COLORT", [1, 2], {}, "expected a content of igtl_gateway.wire, or bytes"),
    ],
)
def test_what_a_type_cannot_hold(type_name: str, value: object, options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConversionError) as caught:
        content_of(type_name, value, **options)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_value_types_are_types() -> None:
    assert VALUE_TYPES <= BODIES.keys()
