"""What a message costs, from its first bytes: the rows of types, odd cells of surfaces, parts of volumes."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.cost import AT_ONCE_NS, cost_ns
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import Item
from igtl_gateway.wire.polydata import Attribute, Cells, PolyData
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import String
from igtl_gateway.wire.traits import traits_of
from tests import strategies
from tests.tables import table
from tests.wire.handmade import field


def stated(kind: bytes, size: int, content: bytes = b"", version: int = 1) -> bytes:
    """A message of version 1 that states a size, and of which there are at least 600 bytes."""
    head = struct.pack(">H", version) + field(kind, 12) + bytes(28) + struct.pack(">QQ", size, 0)
    return head + content.ljust(600, b"\0")


@table("kind", sorted(BODIES.keys() - {"POLYDATA", "IMAGE", "VIDEO"}))
def test_a_type_costs_what_its_traits_state_for_each_byte(kind: str) -> None:
    each = traits_of(BODIES[kind]).ns_per_byte
    assert cost_ns(stated(kind.encode(), 1_000_000)) == (5 if each is None else each) * 1_000_000


def test_types_without_a_codec_and_pictures() -> None:
    assert cost_ns(stated(b"UNHEARDOF", 1_000_000)) == 5_000_000
    assert cost_ns(stated(b"VIDEO", 1_000_000)) == 1_000_000 == AT_ONCE_NS
    # a name ends at its first NUL
    assert (
        cost_ns(stated(b"TDATA\0junk", 1000)) == cost_ns(stated(b"TDATA", 1000)) != cost_ns(stated(b"TDATAjunk", 1000))
    )


def test_what_is_short_costs_nothing() -> None:
    assert cost_ns(stated(b"TDATA", 10**9)[:511]) == 0
    assert cost_ns(stated(b"TDATA", 10**9)[:512]) > 0


def surface(cells: Cells, attributes: int = 0) -> bytes:
    """A message of 1000 points."""
    rows = tuple(Attribute.of(0, "a", np.zeros((1000, 1))) for _ in range(attributes))
    return join(encode(Message("POLYDATA", "S", PolyData(np.zeros((1000, 3), ">f4"), polygons=cells, attributes=rows))))


@table("kind", ["vertices", "lines", "polygons", "triangle_strips"])
def test_odd_cells_of_any_kind_cost_more(kind: str) -> None:
    for cells, each in (([[0, 1, 2]] * 50, 15), ([[0, 1, 2]] * 49 + [[0, 1, 2, 3]], 200)):
        more: dict[str, Any] = {kind: Cells.of(cells)}
        content = replace(PolyData(np.zeros((1000, 3), ">f4")), **more)
        data = join(encode(Message("POLYDATA", "S", content)))
        assert cost_ns(data) == each * (len(data) - 58)


def test_each_attribute_of_a_surface_costs() -> None:
    data = surface(Cells.of([[0, 1, 2]] * 50), attributes=3)
    assert cost_ns(data) == 15 * (len(data) - 58) + 3 * 10_000
    # more attributes than bytes: the number is a lie
    head = struct.pack(">10I", *[0] * 9, 2**32 - 1)
    assert cost_ns(stated(b"POLYDATA", 700, head)) == 15 * 700 + 700 * 10_000


def test_a_part_of_a_volume_costs_the_copy_of_the_whole() -> None:
    part = Image((100, 200, 300), 5, bytes(20), num_components=2, subvol_size=(5, 1, 1))
    data = join(encode(Message("IMAGE", "CT", part)))
    assert len(data) < 512
    assert cost_ns(data) == 2 * 100 * 200 * 300 * 2 * 2
    whole = Image((10, 20, 30), 5, bytes(12_000))
    data = join(encode(Message("IMAGE", "CT", whole)))
    assert cost_ns(data) == len(data) - 58


@table(("scalar", "size"), [(2, 1), (3, 1), (15, 1), (4, 2), (5, 2), (6, 4), (7, 4), (10, 4), (11, 8), (99, 1)])
def test_the_whole_of_a_volume_has_the_size_of_its_type(scalar: int, size: int) -> None:
    fields = (
        struct.pack(">HBBBB3H", 1, 1, scalar, 2, 1, 100, 100, 100) + bytes(48) + struct.pack(">6H", 0, 0, 0, 1, 1, 1)
    )
    assert cost_ns(stated(b"IMAGE", 80, fields)) == 2 * 1_000_000 * size


def test_metadata_cost_by_item_and_by_byte() -> None:
    items = tuple(Item.of(f"key{number:02}", "x" * 20) for number in range(30))
    data = join(encode(Message("STRING", "S", String(b"a" * 600), 0, 2, 7, items)))
    body = len(data) - 58
    each = traits_of(String).ns_per_byte
    assert cost_ns(data) == (5 if each is None else each) * body + 30 * 6_000 + 30 * 25 * 20


def test_the_content_begins_behind_the_extended_header() -> None:
    cells = Cells.of([[0, 1, 2]] * 49 + [[0, 1, 2, 3]])
    content = PolyData(np.zeros((100, 3), ">f4"), polygons=cells)
    data = join(encode(Message("POLYDATA", "S", content, 0, 2)))
    assert cost_ns(data) == 200 * (len(data) - 58)


@given(strategies.damaged_wire_bytes, st.integers(0, 600))
def test_any_bytes_have_a_cost(data: bytes, more: int) -> None:
    assert cost_ns(data + bytes(more)) >= 0
    assert cost_ns(memoryview(data)) == cost_ns(data)
