"""TRANSFORM and POSITION: the order of the matrix, short forms, and every bit of NaN."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.transform import Position, Transform, pack_floats, unpack_floats
from tests import strategies
from tests.tables import table
from tests.wire.contents import check_golden, f32

QUARTER_TURN = [[0.0, -1.0, 0.0, 10.0], [1.0, 0.0, 0.0, 20.0], [0.0, 0.0, 1.0, 30.0], [0.0, 0.0, 0.0, 1.0]]


def test_a_transform_is_written_column_by_column() -> None:
    data = f32(0, 1, 0, -1, 0, 0, 0, 0, 1, 10, 20, 30)
    assert check_golden(Transform.from_rows(QUARTER_TURN), data) == {"matrix": QUARTER_TURN}


def test_rows() -> None:
    rows = [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0], [9.0, 10.0, 11.0, 12.0]]
    assert Transform.from_rows(rows).rows == [*rows, [0.0, 0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("position", "data", "described"),
    [
        (
            Position((1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 0.0)),
            f32(1, 2, 3, 0, 0, 1, 0),
            {"pack": "all", "position": [1, 2, 3], "quaternion": [0, 0, 1, 0]},
        ),
        (
            Position((1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5), "quaternion3"),
            f32(1, 2, 3, 0.5, 0.5, 0.5),
            {"pack": "quaternion3", "position": [1, 2, 3], "quaternion": [0.5, 0.5, 0.5, 0.5]},
        ),
        (
            Position((1.0, 2.0, 3.0), form="position_only"),
            f32(1, 2, 3),
            {"pack": "position_only", "position": [1, 2, 3], "quaternion": [0, 0, 0, 1]},
        ),
    ],
    ids=["all", "without w", "position alone"],
)
def test_golden_bytes_of_positions(position: Position, data: bytes, described: dict[str, object]) -> None:
    assert check_golden(position, data, lambda size: size in (12, 24)) == described


@table("size", [0, 11, 13, 20, 27, 29])
def test_other_lengths(size: int) -> None:
    content = memoryview(bytes(size))
    with pytest.raises(MalformedBody) as of_position:
        Position.unpack(content)
    assert str(of_position.value) == f"POSITION content: found {counted(size, 'byte')}, expected 28, 24 or 12 bytes"
    with pytest.raises(MalformedBody) as of_transform:
        Transform.unpack(content)
    assert str(of_transform.value) == f"TRANSFORM content: found {counted(size, 'byte')}, expected 48 bytes"


@given(st.tuples(*[strategies.any32] * 3))
def test_w_is_reconstructed(xyz: tuple[float, float, float]) -> None:
    w = Position.unpack(memoryview(f32(0, 0, 0, *xyz))).quaternion[3]
    rest = 1.0 - sum(value * value for value in xyz)
    assert math.isnan(w) if math.isnan(rest) else w == pytest.approx(math.sqrt(max(rest, 0.0)), abs=1e-7)


@pytest.mark.parametrize(("value", "fits"), [(3.4028234e38, True), (3.5e38, False), (math.inf, True), (1e300, False)])
def test_numbers_beyond_float32(value: float, fits: bool) -> None:
    bodies: list[Body] = [Transform((value,) * 12), Position((value, 0.0, 0.0))]
    for body in bodies:
        if fits:
            join(body.pack())
        else:
            with pytest.raises(MalformedBody, match=r"found .*, expected (12|7) float32 numbers"):
                body.pack()


def test_a_matrix_of_another_size() -> None:
    with pytest.raises(MalformedBody, match=r"TRANSFORM matrix: found .*, expected 12 float32 numbers"):
        Transform((0.0,) * 16).pack()


THREE = struct.Struct(">3f")


@given(st.integers(0, 2), st.integers(0, 2**32 - 1), st.integers(1, 2**23 - 1), st.booleans(), st.integers(0, 5))
def test_every_bit_comes_back(place: int, word: int, payload: int, negative: bool, offset: int) -> None:
    """Any word, and each NaN, signalling ones too: a processor would make them quiet."""
    nan = negative << 31 | 0x7F800000 | payload
    for chosen in (word, nan):
        words = [0x3F800000] * 3
        words[place] = chosen
        data = struct.pack(">3I", *words)
        values = unpack_floats(THREE, memoryview(bytes(offset) + data), offset)
        assert pack_floats(THREE, values, "here") == data
        assert [value for at, value in enumerate(values) if at != place] == [1.0, 1.0]


def test_infinities_that_cancel_out_are_numbers() -> None:
    """Their sum is NaN, and none of them is."""
    values = (math.inf, -math.inf, 2.0)
    assert unpack_floats(THREE, memoryview(f32(*values))) == values
    assert pack_floats(THREE, values, "here") == f32(*values)


@pytest.mark.parametrize(("wide", "narrow"), [("7ff0000000000001", "7fc00000"), ("fff0000000000001", "ffc00000")])
def test_a_nan_whose_payload_has_no_room_stays_nan(wide: str, narrow: str) -> None:
    """Without a payload it would be infinity."""
    (value,) = struct.unpack(">d", bytes.fromhex(wide))
    assert pack_floats(THREE, (value, 1.0, 1.0), "here")[:4].hex() == narrow
