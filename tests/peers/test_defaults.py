"""What the C++ library sends by default and what it reads of what we send, type by type: the library itself judges.

`igtl_defaults.cpp` packs every class as its constructor leaves it, with one element as *its* constructor leaves it, and
attributes of every type.  All of it is accepted and right here, or a warning states what is missing.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.profiles import BY_NAME
from igtl_gateway.convert.trajectories import trajectories_to_lines
from igtl_gateway.convert.volumes import image_to_volume
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.polydata import CELL, NORMAL, RGBA, SCALAR, TENSOR, VECTOR, Attribute, Cells, PolyData
from igtl_gateway.wire.query import StartBind
from igtl_gateway.wire.trajectory import Trajectories
from igtl_gateway.wire.transform import Position, Transform
from tests.peers import reference
from tests.peers.reference import ReferencePeer
from tests.peers.test_reference import accepted, listener, read_message

pytestmark = pytest.mark.skipif(reference.available() is not None, reason=str(reference.available()))

#: Those that the constructors of the C++ library leave uninitialised, in whole or in part.
_JUNK = ("BIND", "GET_BIND", "STT_BIND")
_COMPONENTS = {SCALAR: 1, VECTOR: 3, NORMAL: 3, TENSOR: 9, RGBA: 4}


@pytest.fixture(scope="module")
def sent() -> dict[str, bytes]:
    """Case → the message as the library packs it."""
    program = reference.build(source=Path(__file__).with_name("igtl_defaults.cpp"))
    lines = subprocess.run([program], capture_output=True, text=True, check=True).stdout.splitlines()
    return {name: bytes.fromhex(data) for name, _, data in (line.rpartition(" ") for line in lines)}


def test_every_default_is_accepted_and_written_back(sent: dict[str, bytes]) -> None:
    assert len(sent) > 50 and {"TRANSFORM", "BIND", "STT_BIND", "IMAGE/pixels", "POLYDATA/20"} <= sent.keys()
    wrong = [name for name, data in sent.items() if join(encode(decode(data))) != data]
    assert wrong == []


def test_what_the_library_leaves_uninitialised_means_nothing(sent: dict[str, bytes]) -> None:
    contents = [decode(sent[name]).content for name in _JUNK]
    assert [content.children for content in contents] == [(), (), ()]  # type: ignore[attr-defined]
    bind, _, start = contents
    assert isinstance(bind, Bind) and isinstance(start, StartBind)
    assert b"\xa5" * 4 in sent["BIND"], "the library does not write them any more"


def test_the_values_are_those_of_the_constructors(sent: dict[str, bytes]) -> None:
    contents = {name: decode(data).content for name, data in sent.items()}
    assert contents["TRANSFORM"] == Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert contents["POSITION"] == Position((0.0, 0.0, 0.0))
    for name, content in contents.items():
        if isinstance(content, Elements):
            assert len(content) == ("/" in name), name


def test_a_path_with_both_ends_and_the_default_type_is_said(sent: dict[str, bytes]) -> None:
    content, context = decode(sent["TRAJ/both ends"]).content, ToRosContext("Plan", 5, "ct", "")
    assert isinstance(content, Trajectories)
    trajectories_to_lines(content, context)
    ((_, text),) = context.warnings
    assert "'path' has the type 2 (target only, the default of the C++ library)" in text


def test_coordinate_zero_is_said(sent: dict[str, bytes]) -> None:
    content, context = decode(sent["IMAGE/coordinate 0"]).content, ToRosContext("CT", 5, "ct", "")
    assert isinstance(content, Image)
    image_to_volume(content, context)
    assert [code for code, _ in context.warnings] == ["coordinate_zero"]


@pytest.mark.parametrize("kind", range(5))
@pytest.mark.parametrize("cell", [0, CELL])
def test_attributes_of_the_library_have_its_values(sent: dict[str, bytes], kind: int, cell: int) -> None:
    content = decode(sent[f"POLYDATA/{cell + kind}"]).content
    assert isinstance(content, PolyData)
    (attribute,) = content.attributes
    expected = [[10.0 * row + k for k in range(_COMPONENTS[kind])] for row in range(1, 2 if cell else 4)]
    assert attribute.values.tolist() == expected


# -- the other direction: the library reads what a peer on it is sent ------------------------------------------------


@pytest.fixture(scope="module")
def reader() -> Iterator[Any]:
    """The C++ peer as a client, and our end of its connection."""
    with (
        listener() as server,
        ReferencePeer.client("127.0.0.1", server.getsockname()[1]) as peer,
        accepted(server) as link,
    ):
        yield peer, link


_POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], ">f4")
_LAST = Attribute.of(SCALAR, "last", np.array([[7.0], [8.0], [9.0]]))


@pytest.mark.parametrize("profile", ["slicer", "plus", "plus-v1"])
@pytest.mark.parametrize(
    ("kind", "components"),
    [
        *((CELL | SCALAR, count) for count in (1, 2, 3, 4, 8, 9)),
        *((SCALAR, count) for count in (1, 3, 9)),
        *(
            (base | cell, count)
            for base, count in ((VECTOR, 3), (NORMAL, 3), (TENSOR, 9), (RGBA, 4))
            for cell in (0, CELL)
        ),
        *((VECTOR, 2), (CELL | VECTOR, 2), (RGBA, 3), (CELL | RGBA, 3)),
    ],
)
def test_the_library_reads_the_attributes_that_it_is_sent(
    reader: Any, profile: str, kind: int, components: int
) -> None:
    """And those behind it: it takes nine floats a tuple of most types, and the count of scalars from the head."""
    peer, link = reader
    tuples = 2 if kind & CELL else 3
    values = np.arange(tuples * components, dtype=">f4").reshape(tuples, components) + 1
    cells = Cells.of([[0, 1, 2], [0, 2, 1]])
    content = PolyData(_POINTS, polygons=cells, attributes=(Attribute.of(kind, "a", values), _LAST))
    adapted, warning = BY_NAME[profile].adapt[PolyData](content)
    assert not warning
    link.sendall(join(encode(Message("POLYDATA", "Mesh", adapted))))
    first, last = peer.receive("POLYDATA")["content"]["attributes"]
    assert last == {"type": 0, "ncomponents": 1, "n": 3, "name": "last", "data": [7.0, 8.0, 9.0]}
    taken = {VECTOR: 3, RGBA: 4}.get(kind & ~CELL, components)
    expected = np.full((tuples, taken), float(kind & ~CELL == RGBA))
    expected[:, :components] = values
    assert (first["type"], first["n"], first["ncomponents"]) == (kind, tuples, taken)
    assert first["data"] == expected.reshape(-1).tolist()


# -- any values, both ways -------------------------------------------------------------------------------------------

_F32 = st.floats(-1e6, 1e6, width=32)
_BYTE = st.integers(0, 255)
_TOOL = st.sampled_from([1, 2, 3, 4])


def _text(width: int) -> st.SearchStrategy[str]:
    return st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=width - 1)


def _floats(count: int) -> st.SearchStrategy[list[float]]:
    return st.lists(_F32, min_size=count, max_size=count)


def _rows(**fields: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.builds(lambda rows: {"elements": rows}, st.lists(st.fixed_dictionaries(fields), max_size=4))


_RGBA = st.lists(_BYTE, min_size=4, max_size=4)
_SIZE = st.lists(st.integers(0, 65_535), min_size=3, max_size=3)
_MATRIX = st.builds(lambda v: [v[:4], v[4:8], v[8:], [0.0, 0.0, 0.0, 1.0]], _floats(12))
_PLACED = {"name": _text(64), "group": _text(32), "rgba": _RGBA, "diameter": _F32, "owner": _text(20)}
_UNIT = st.builds(
    lambda prefix, units: {"prefix": prefix, "units": [list(one) for one in units]},
    st.sampled_from([0, 3, 0xB]),
    st.lists(st.tuples(st.integers(1, 27), st.integers(-7, 7)), min_size=6, max_size=6),
)

#: Type → any content of it, with the keys of ``describe``.
_ANY: dict[str, st.SearchStrategy[dict[str, Any]]] = {
    "TRANSFORM": st.fixed_dictionaries({"matrix": _MATRIX}),
    "POSITION": st.fixed_dictionaries({"pack": st.just("all"), "position": _floats(3), "quaternion": _floats(4)}),
    "STATUS": st.fixed_dictionaries(
        {"code": st.integers(0, 19), "subcode": st.integers(-(2**63), 2**63 - 1), "error_name": _text(20),
         "status_string": _text(90)}
    ),
    "STRING": st.builds(lambda text: {"encoding": 3, "string": text}, _text(300)),
    "POINT": _rows(**_PLACED, position=_floats(3)),
    "TRAJ": _rows(**_PLACED, type=st.sampled_from([1, 2, 3]), entry=_floats(3), target=_floats(3)),
    "TDATA": _rows(name=_text(20), type=_TOOL, matrix=_MATRIX),
    "QTDATA": _rows(name=_text(20), type=_TOOL, position=_floats(3), quaternion=_floats(4)),
    "LBMETA": _rows(name=_text(64), device_name=_text(20), label=_BYTE, rgba=_RGBA, size=_SIZE, owner=_text(20)),
    "SENSOR": st.fixed_dictionaries(
        {"unit_decoded": _UNIT, "values": st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=5)}
    ),
    "NDARRAY": st.builds(
        lambda data, scalar: {"scalar_type": scalar, "size": [len(data)], "data": data},
        st.lists(st.integers(0, 100), min_size=1, max_size=9),
        st.sampled_from([2, 3, 4, 5, 6, 7, 10, 11]),
    ),
    "STT_TDATA": st.fixed_dictionaries({"resolution": st.integers(0, 10_000), "coordinate_name": _text(32)}),
    "RTS_TDATA": st.fixed_dictionaries({"status": st.integers(0, 1)}),
}  # fmt: skip


@pytest.mark.parametrize("kind", _ANY)
def test_any_values_are_equal_here_and_in_the_library(reader: Any, kind: str) -> None:
    peer, link = reader

    @settings(max_examples=25, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(_ANY[kind])
    def check(content: dict[str, Any]) -> None:
        peer.send(kind, "Any", content)
        data = read_message(link)
        message = decode(data)
        shown = message.content.describe()
        assert {key: shown.get(key) for key in content} == content
        again = join(encode(message))
        link.sendall(again)
        read = peer.receive(kind)
        assert read["crc_ok"]
        found = read["content"] or {"elements": []}
        assert {key: found.get(key) for key in content} == content

    check()
