"""Columns of poses against the decoder of single messages, to the last bit."""

from __future__ import annotations

import math
import random
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.api.columns import name_igtl_fields, table_rows
from igtl_gateway.api.igtl_columns import crcs, pose_columns, pose_rows
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.bulk import block_of
from igtl_gateway.wire import decode
from igtl_gateway.wire.header import crc64
from igtl_gateway.wire.message import Item, Message, encode
from igtl_gateway.wire.registry import describe_content
from igtl_gateway.wire.transform import Position, Transform


def packed(message: Message) -> bytes:
    return b"".join(bytes(part) for part in encode(message))


def rotation(turn: random.Random) -> tuple[float, ...]:
    x, y, z, w = (turn.gauss(0, 1) for _ in range(4))
    size = math.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / size, y / size, z / size, w / size
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)),
        (2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)),
        (2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)),
    )
    return (*columns[0], *columns[1], *columns[2], 10.0 * x, 20.0 * y, 30.0)


def transforms() -> list[bytes]:
    turn = random.Random(17)
    found = [packed(Message("TRANSFORM", "A", Transform(rotation(turn)))) for _ in range(200)]
    half_turns = [(1, 0, 0, 0, -1, 0, 0, 0, -1), (-1, 0, 0, 0, 1, 0, 0, 0, -1), (-1, 0, 0, 0, -1, 0, 0, 0, 1)]
    odd = [(2, 0, 0, 0, 2, 0, 0, 0, 2), (1, 0, 0, 0, 1, 0, 0, 0, -1), (0,) * 9, (math.nan,) * 9, (math.inf,) * 9]
    for nine in (*half_turns, *odd):
        found.append(packed(Message("TRANSFORM", "A", Transform((*map(float, nine), 1.0, 2.0, 3.0)))))
    metadata = (Item.of("key", "value"),)
    found.insert(3, packed(Message("TRANSFORM", "A", Transform(rotation(turn)), 0, 2, 7, metadata)))
    broken = bytearray(found[5])
    broken[70] ^= 1
    found.insert(6, bytes(broken))
    found.insert(9, found[0][:80])
    return found


def positions() -> list[bytes]:
    found = []
    for form in ("all", "quaternion3", "position_only"):
        found.append(packed(Message("POSITION", "A", Position((1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5), form))))
    found.append(packed(Message("POSITION", "A", Position((1.0, 2.0, 3.0), (0.0, 0.0, 3.0, 4.0)))))
    found.append(packed(Message("POSITION", "A", Position((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 0.0)))))
    return found


@pytest.mark.parametrize("unit", ["mm", "m", "um"])
@pytest.mark.parametrize(("igtl_type", "messages"), [("TRANSFORM", transforms()), ("POSITION", positions())])
def test_columns_are_the_cells_of_single_messages(igtl_type: str, messages: list[bytes], unit: str) -> None:
    given_entries = [
        Entry(number, number, Kind.IGTL_IN, f"{igtl_type}/A", igtl_type, (data,))
        for number, data in enumerate(messages, 1)
    ]
    found = pose_rows(block_of(given_entries), igtl_type)
    columns = pose_columns(found, unit)
    expected = []
    for index, data in enumerate(messages):
        try:
            expected.append((index, decode(data).content))
        except Exception:
            continue
    assert found.rows.tolist() == [index for index, _ in expected]
    for row, (_, content) in enumerate(expected):
        (cells,) = table_rows(name_igtl_fields(describe_content(content), unit))
        assert [column.name for column in columns] == list(cells)
        for column in columns:
            value = column.text(row) if column.is_text else column.values[row]
            if column.valid is not None and not column.valid[row]:
                value = ""
            assert np.array_equal(value, cells[column.name], equal_nan=not isinstance(value, str))


def test_a_quaternion_of_any_length_is_a_rotation_and_zero_is_not() -> None:
    found = pose_rows(
        block_of(
            [
                Entry(number, number, Kind.IGTL_IN, "POSITION/A", "POSITION", (data,))
                for number, data in enumerate(positions(), 1)
            ]
        ),
        "POSITION",
    )
    assert np.allclose(found.matrices[3, :3, :3], [[0.28, -0.96, 0.0], [0.96, 0.28, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(found.matrices[4, :3, :3]).all()
    assert found.matrices[4, :3, 3].tolist() == [1.0, 2.0, 3.0]


def test_a_signalling_nan_is_a_number_like_another(recwarn: pytest.WarningsRecorder) -> None:
    """Numpy warns of its conversion, on the terminal of an export."""
    data = bytearray(packed(Message("TRANSFORM", "A", Transform((1.0,) * 12))))
    data[58:62] = b"\x7f\xa0\0\0"
    data[50:58] = crc64(bytes(data[58:])).to_bytes(8, "big")
    found = pose_rows(block_of([Entry(1, 1, Kind.IGTL_IN, "TRANSFORM/A", "TRANSFORM", (bytes(data),))]), "TRANSFORM")
    assert math.isnan(found.matrices[0, 0, 0])
    assert not len(recwarn)


@given(st.lists(st.binary(min_size=48, max_size=48), min_size=1, max_size=8))
def test_crcs_of_a_table_are_those_of_the_library(bodies: list[bytes]) -> None:
    rows = np.frombuffer(b"".join(bodies), np.uint8).reshape(-1, 48)
    assert crcs(rows).tolist() == [crc64(body) for body in bodies]


def test_long_bodies_have_their_crc() -> None:
    body = struct.pack(">300B", *(index % 256 for index in range(300)))
    assert crcs(np.frombuffer(body, np.uint8).reshape(1, -1)).tolist() == [crc64(body)]
