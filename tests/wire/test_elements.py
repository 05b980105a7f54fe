"""What all lists share: views on the received bytes, equality by type and bytes, descriptions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.wire.body import Raw
from igtl_gateway.wire.elements import Elements, describe_matrix
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.trajectory import Trajectories

LISTS = [Points, TrackingData, QuaternionTrackingData, Trajectories, ImageMetaList, LabelMetaList, VideoMetaList]
lists = pytest.mark.parametrize("kind", LISTS, ids=[kind.NAME for kind in LISTS])


def test_these_are_all_lists() -> None:
    assert set(LISTS) == {kind for kind in BODIES.values() if issubclass(kind, Elements)}


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


def test_received_bytes_are_not_copied() -> None:
    data = np.zeros(3 * Points.DTYPE.itemsize, np.uint8)
    points = Points.unpack(data.data)
    assert np.shares_memory(points.elements, data)
    (only,) = points.pack()
    assert np.shares_memory(np.frombuffer(only, np.uint8), data)


def test_no_elements_are_no_bytes() -> None:
    assert Points.unpack(memoryview(b"")).pack() == []
    assert Points.MAY_BE_EMPTY
    assert Points.unpack(memoryview(b"")).describe() == {"elements": []}


def test_text_is_described_up_to_its_nul() -> None:
    tools = TrackingData(np.array([(b"a\0junk", 2, 9, [0] * 12), (b"\xff", 1, 0, [0] * 12)], TrackingData.DTYPE))
    described = tools.describe()["elements"]
    assert [(each["name"], each["type"], "reserved" in each) for each in described] == [
        ("a", 2, False),
        ("\ufffd", 1, False),
    ]


def test_a_matrix_is_described_by_rows() -> None:
    assert describe_matrix(list(range(12))) == [[0, 3, 6, 9], [1, 4, 7, 10], [2, 5, 8, 11], [0, 0, 0, 1]]


def test_a_part_of_an_element_is_refused() -> None:
    with pytest.raises(MalformedBody) as error:
        Points.unpack(memoryview(bytes(137)))
    assert str(error.value) == "POINT content: found 137 bytes, expected a multiple of 136"
