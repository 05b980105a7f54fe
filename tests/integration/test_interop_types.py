"""Every type of message that Debian's C++ library has, over TCP, between it and our edge and codec.

One list of cases, each a content as JSON and the same as our class.  Toward us: the library encodes the JSON, and
what we decode is described by the same JSON and encoded to the same bytes again.  From us: we encode the class,
and what the library unpacks, CRC checked, is that JSON.  pyigtl goes through the cases of the types that it has.
"""

from __future__ import annotations

import json
import queue
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any

import numpy as np
import pytest
from fastcrc import crc64

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks, ticks_to_ns
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.colort import ColorTable
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.metalists import IMAGE_META_DTYPE, LABEL_META_DTYPE, ImageMetaList, LabelMetaList
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.point import POINT_DTYPE, Points
from igtl_gateway.wire.polydata import Attribute, Cells, PolyData
from igtl_gateway.wire.query import EmptyQuery, GetBind, QueryReply, StartBind, StartTracking
from igtl_gateway.wire.registry import BODIES, describe_content, read_child
from igtl_gateway.wire.sensor import Sensor, parse_unit
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import (
    QTRACKING_DTYPE,
    TRACKING_DTYPE,
    QuaternionTrackingData,
    TrackingData,
)
from igtl_gateway.wire.trajectory import TRAJECTORY_DTYPE, Trajectories
from igtl_gateway.wire.transform import Position, Transform
from tests.peers import only, pyigtl_peer, reference
from tests.peers.pyigtl_peer import PyigtlPeer
from tests.peers.reference import ENCODERS, ReferencePeer
from tests.tables import table
from tests.timing import WAIT_S

#: A name that fills its field, and a stamp whose fraction no conversion may touch.
DEVICE, SEC, FRAC = "TwentyBytesOfTheName", 1_700_000_000, 0xFEDCBA98

needs_reference = pytest.mark.skipif(reference.available() is not None, reason=str(reference.available()))


# ── the cases ──────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Case:
    """A message in both forms.

    Attributes:
        content: with the corpus' keys; what only one side knows (such as the CRC of the pixels) is left out.
        shown: content as both sides describe it, where that is not the same.
        to_us, from_us: False where the library cannot (``reference.LEFT_OUT``).
    """

    name: str
    type: str
    content: dict[str, Any]
    body: Body
    shown: dict[str, Any] = field(default_factory=dict)
    to_us: bool = field(default=True, kw_only=True)
    from_us: bool = field(default=True, kw_only=True)

    def __str__(self) -> str:
        return f"{self.type}-{self.name}"

    def check(self, described: dict[str, Any]) -> None:
        expected = self.content | self.shown
        assert only(described, expected) == expected


#: At the edges of float32.
TINY, HUGE, INF = 2.0**-149, float(np.finfo(np.float32).max), float("inf")
ROWS = [[0.0, -1.0, 0.0, 100.5], [1.0, 0.0, 0.0, -200.25], [0.0, 0.0, 1.0, 4096.0], [0.0, 0.0, 0.0, 1.0]]
COLUMNS = (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 100.5, -200.25, 4096.0)
ODD_ROWS = [[TINY, HUGE, INF, -INF], [-TINY, -HUGE, 0.5, 0.25], [1.5, 2.5, 3.5, 4.5], [0.0, 0.0, 0.0, 1.0]]
ODD_COLUMNS = (TINY, -TINY, 1.5, HUGE, -HUGE, 2.5, INF, 0.5, 3.5, -INF, 0.25, 4.5)

#: The longest strings that the library reads in fields of 64, 32 and 20 bytes.
LONG, MIDDLE, SHORT = "Trochanter major, µ" + "n" * 43, "Fiducials of the left side, 2nd", "Größe von Körper"


def status(code: int, subcode: int, error_name: str, text: str) -> dict[str, Any]:
    return {
        "code": code,
        "subcode": subcode,
        "error_name": error_name,
        "status_string": text,
        "nul_terminated": True,
    }


def string(text: str, encoding: int) -> dict[str, Any]:
    return {"encoding": encoding, "string": text, "string_hex": text.encode().hex()}


def sensor(unit: str, prefix: int, units: list[list[int]], values: list[float]) -> dict[str, Any]:
    units = units + [[0, 0]] * (6 - len(units))
    return {
        "length": len(values),
        "status": 0,
        "unit": unit,
        "unit_decoded": {"prefix": prefix, "units": units},
        "values": values,
    }


def image(dimensions: list[int], scalar_type: int, data: list[float], **others: Any) -> dict[str, Any]:
    whole = {"subvol_offset": [0, 0, 0], "subvol_size": dimensions, "num_components": 1, "endian": 2, "coordinate": 1}
    return {
        "dimensions": dimensions,
        "scalar_type": scalar_type,
        "wire_matrix": list(COLUMNS),
        "data": data,
        **whole,
        **others,
    }


def array(kind: type[Elements], dtype: np.dtype[np.void], *elements: tuple[Any, ...]) -> Elements:
    return kind(np.array([tuple(t.encode() if isinstance(t, str) else t for t in row) for row in elements], dtype))


#: The numbers of each scalar type, at both ends of its range.
NUMBERS: dict[int, tuple[str, list[float]]] = {
    2: ("i1", [-128, 127]),
    3: ("u1", [0, 255]),
    4: ("i2", [-32768, 32767]),
    5: ("u2", [1, 65535]),
    6: ("i4", [-(2**31), 2**31 - 1]),
    7: ("u4", [1, 2**32 - 1]),
    10: ("f4", [TINY, HUGE]),
    11: ("f8", [5e-324, 1.7976931348623157e308]),
}
BASIC = [
    Case("quarter turn", "TRANSFORM", {"matrix": ROWS}, Transform(COLUMNS)),
    Case("edges", "TRANSFORM", {"matrix": ODD_ROWS}, Transform(ODD_COLUMNS)),
    Case(
        "whole",
        "POSITION",
        {"pack": "all", "position": [1.5, -2.5, 3.5], "quaternion": [0.5, -0.5, 0.5, 0.5]},
        Position((1.5, -2.5, 3.5), (0.5, -0.5, 0.5, 0.5)),
    ),
    Case(
        "without w",
        "POSITION",
        {"pack": "quaternion3", "position": [1.5, -2.5, 3.5], "quaternion": [0.5, -0.5, 0.5, 0.5]},
        Position((1.5, -2.5, 3.5), (0.5, -0.5, 0.5, 0.5), "quaternion3"),
        to_us=False,
    ),
    Case(
        "without rotation",
        "POSITION",
        {"pack": "position_only", "position": [1.5, -2.5, 3.5], "quaternion": [0.0, 0.0, 0.0, 1.0]},
        Position((1.5, -2.5, 3.5), form="position_only"),
        to_us=False,
    ),
    Case("ascii", "STRING", string("hello", 3), String(b"hello")),
    Case("empty", "STRING", string("", 3), String(b"")),
    Case("UTF-8", "STRING", string('Größe 5 µm, 手術 "\\\n', 106), String.of('Größe 5 µm, 手術 "\\\n')),
    Case("longest", "STRING", string("x" * 65_535, 3), String(b"x" * 65_535)),
    Case("error", "STATUS", status(13, -(2**63), SHORT, "not yet"), Status(13, -(2**63), SHORT, "not yet")),
    Case("bare", "STATUS", status(1, 0, "", ""), Status(1, 0, "", "")),
]
IMAGES = [
    Case(
        f"{code} {order}",
        "IMAGE",
        image([2, 1, 1], scalar_type, numbers, endian=endian),
        Image((2, 1, 1), scalar_type, np.array(numbers, order + code).tobytes(), endian=endian, wire_matrix=COLUMNS),
    )
    for scalar_type, (code, numbers) in NUMBERS.items()
    for endian, order in ((2, "<"), (1, ">"))
] + [
    Case(
        "colours",
        "IMAGE",
        image([3, 2, 1], 3, list(range(18)), num_components=3, coordinate=2),
        Image((3, 2, 1), 3, bytes(range(18)), 3, coordinate=2, wire_matrix=COLUMNS),
    ),
    Case(
        "sub-volume",
        "IMAGE",
        image([9, 8, 7], 3, list(range(6)), subvol_offset=[6, 6, 6], subvol_size=[3, 2, 1]),
        Image((9, 8, 7), 3, bytes(range(6)), wire_matrix=COLUMNS, subvol_offset=(6, 6, 6), subvol_size=(3, 2, 1)),
    ),
]
CORNERS = [[0.0, 0.0, 0.0], [1.5, 0.0, TINY], [1.5, -2.5, HUGE], [0.0, -2.5, 0.0]]


def attribute(kind: int, components: int, count: int, name: str) -> tuple[dict[str, Any], Attribute]:
    data = [0.25 * index - 1 for index in range(components * count)]
    fields = {"type": kind, "ncomponents": components, "n": count, "name": name, "data": data}
    return fields, Attribute.of(kind, name, np.array(data).reshape(count, components))


#: The types of attributes that the library does not break.
ATTRIBUTES = [
    attribute(0x00, 5, 4, "five"),
    attribute(0x01, 3, 4, "vectors"),
    attribute(0x02, 3, 4, "normals"),
    attribute(0x03, 9, 4, "tensors"),
    attribute(0x13, 9, 6, "tensors of cells"),
]
CELLS = {
    "vertices": [[0], [1, 2, 3]],
    "lines": [[0, 1, 2]],
    "polygons": [[0, 1, 2, 3], [3, 2, 1]],
    "triangle_strips": [[0, 1, 3, 2]],
}
SURFACES = [
    Case(
        "all sections",
        "POLYDATA",
        {"num_points": 4, "points": CORNERS, **CELLS, "attributes": [fields for fields, _ in ATTRIBUTES]},
        PolyData(
            np.array(CORNERS, ">f4"),
            Cells.of(CELLS["vertices"]),
            Cells.of(CELLS["lines"]),
            Cells.of(CELLS["polygons"]),
            Cells.of(CELLS["triangle_strips"]),
            tuple(attribute for _, attribute in ATTRIBUTES),
        ),
    ),
    Case(
        "points only",
        "POLYDATA",
        {"num_points": 4, "points": CORNERS, **{section: [] for section in CELLS}, "attributes": []},
        PolyData(np.array(CORNERS, ">f4")),
    ),
]
LISTS = [
    Case(
        "two",
        "POINT",
        {
            "elements": [
                {
                    "name": LONG,
                    "group": MIDDLE,
                    "rgba": [255, 128, 1, 0],
                    "position": [1.5, TINY, -HUGE],
                    "diameter": 2.5,
                    "owner": SHORT,
                },
                {"name": "", "group": "", "rgba": [0] * 4, "position": [0.0] * 3, "diameter": 0.0, "owner": ""},
            ]
        },
        array(
            Points,
            POINT_DTYPE,
            (LONG, MIDDLE, (255, 128, 1, 0), (1.5, TINY, -HUGE), 2.5, SHORT),
            ("", "", (0,) * 4, (0,) * 3, 0, ""),
        ),
    ),
    Case(
        "ascii",
        "POINT",
        {
            "elements": [
                {
                    "name": "Target",
                    "group": "Fiducial",
                    "rgba": [255, 128, 1, 200],
                    "position": [1.5, -2.5, 4096.0],
                    "diameter": 2.5,
                    "owner": "CT",
                }
            ]
        },
        array(Points, POINT_DTYPE, ("Target", "Fiducial", (255, 128, 1, 200), (1.5, -2.5, 4096), 2.5, "CT")),
    ),
    Case(
        "each type",
        "TRAJ",
        {
            "elements": [
                {
                    "name": LONG,
                    "group": MIDDLE,
                    "type": kind,
                    "rgba": [1, 2, 3, 4],
                    "entry": [1.5, TINY, -HUGE],
                    "target": [4.5, 5.5, 6.5],
                    "diameter": 2.5,
                    "owner": SHORT,
                }
                for kind in (1, 2, 3)
            ]
        },
        array(
            Trajectories,
            TRAJECTORY_DTYPE,
            *(
                (LONG, MIDDLE, kind, 0, (1, 2, 3, 4), (1.5, TINY, -HUGE), (4.5, 5.5, 6.5), 2.5, SHORT)
                for kind in (1, 2, 3)
            ),
        ),
    ),
    Case(
        "each type",
        "TDATA",
        {
            "elements": [
                {"name": SHORT, "type": 1, "matrix": ROWS},
                *({"name": f"Tool {kind}", "type": kind, "matrix": ODD_ROWS} for kind in (2, 3, 4)),
            ]
        },
        array(
            TrackingData,
            TRACKING_DTYPE,
            (SHORT, 1, 0, COLUMNS),
            *((f"Tool {kind}", kind, 0, ODD_COLUMNS) for kind in (2, 3, 4)),
        ),
    ),
    Case(
        "each type",
        "QTDATA",
        {
            "elements": [
                {"name": SHORT, "type": kind, "position": [1.5, TINY, -HUGE], "quaternion": [0.5, -0.5, 0.5, 0.5]}
                for kind in (1, 2, 3, 4)
            ]
        },
        array(
            QuaternionTrackingData,
            QTRACKING_DTYPE,
            *((SHORT, kind, 0, (1.5, TINY, -HUGE), (0.5, -0.5, 0.5, 0.5)) for kind in (1, 2, 3, 4)),
        ),
    ),
    Case(
        "each scalar type",
        "IMGMETA",
        {
            "elements": [
                {
                    "name": LONG,
                    "device_name": SHORT,
                    "modality": MIDDLE,
                    "patient_name": LONG[::-1],
                    "patient_id": LONG[1:],
                    "timestamp": {"sec": SEC, "nanosec": 0},  # of fractions see below
                    "size": [1, 512, 65535],
                    "scalar_type": scalar_type,
                }
                for scalar_type in NUMBERS
            ]
        },
        array(
            ImageMetaList,
            IMAGE_META_DTYPE,
            *(
                (LONG, SHORT, MIDDLE, LONG[::-1], LONG[1:], SEC << 32, (1, 512, 65535), scalar_type, 0)
                for scalar_type in NUMBERS
            ),
        ),
    ),
    Case(
        "two",
        "LBMETA",
        {
            "elements": [
                {
                    "name": LONG,
                    "device_name": SHORT,
                    "label": label,
                    "rgba": [255, 128, 1, 0],
                    "size": [1, 512, 65535],
                    "owner": "CT",
                }
                for label in (0, 255)
            ]
        },
        array(
            LabelMetaList,
            LABEL_META_DTYPE,
            *((LONG, SHORT, label, 0, (255, 128, 1, 0), (1, 512, 65535), "CT") for label in (0, 255)),
        ),
    ),
]
NO_ELEMENTS = [
    Case("empty", case.type, {"elements": []}, type(case.body)(case.body.elements[:0]))
    for case in LISTS
    if isinstance(case.body, Elements)
]
READINGS = [1.5, -5e-324, 1.7976931348623157e308, INF]
SENSORS = [
    Case("without unit", "SENSOR", sensor("0" * 16, 0, [], READINGS), Sensor(np.array(READINGS))),
    Case(
        "acceleration",
        "SENSOR",
        sensor("b0443e0000000000", 0xB, [[0x01, 1], [0x03, -2]], READINGS),
        Sensor(np.array(READINGS), parse_unit("mm/s^2")),
    ),
    Case(
        "six factors",
        "SENSOR",
        sensor("f05c290c5bf40c4d", 0xF, [[0x01, 7], [0x02, -7], [0x03, 1], [0x1B, -1], [0x10, 3], [0x04, -3]], [0.0]),
        Sensor(np.array([0.0]), 0xF05C290C5BF40C4D),
    ),
    Case("nothing", "SENSOR", sensor("0" * 16, 0, [], []), Sensor(np.array([]))),
    Case("most", "SENSOR", sensor("0" * 16, 0, [], [0.1] * 255), Sensor(np.full(255, 0.1))),
]
ARRAYS = [
    Case(
        code,
        "NDARRAY",
        {"scalar_type": scalar_type, "size": [1, 2], "data": numbers},
        NdArray(scalar_type, (1, 2), np.array(numbers, ">" + code).tobytes()),
    )
    for scalar_type, (code, numbers) in NUMBERS.items()
] + [
    Case(
        "complex",
        "NDARRAY",
        {"scalar_type": 13, "size": [2], "data": [1.5, -2.5, INF, 5e-324]},
        NdArray(13, (2,), np.array([1.5, -2.5, INF, 5e-324], ">f8").tobytes()),
    ),
    Case(
        "rows of different length",
        "NDARRAY",
        {"scalar_type": 4, "size": [2, 3, 4], "data": list(range(24))},
        NdArray(4, (2, 3, 4), np.arange(24, dtype=">i2").tobytes()),
    ),
    Case("a length of 0", "NDARRAY", {"scalar_type": 11, "size": [3, 0], "data": []}, NdArray(11, (3, 0), b"")),
]


def wide_table(name: str, map_type: int, code: str, values: int) -> Case:
    """For indices of 16 bits: too many values to be listed."""
    table = (np.arange(65_536 * values) % 251).astype(code)
    summary = {"count": len(table), "crc64": f"{crc64.ecma_182(table.tobytes()):016x}"}
    content = {"index_type": 5, "map_type": map_type, "table": table.tolist()}
    return Case(f"{name} of u16", "COLORT", content, ColorTable(5, map_type, table.tobytes()), {"table": summary})


GREYS = list(range(255, -1, -1))
WIDE_GREYS = [257 * grey - 1 if grey else 0 for grey in GREYS]
TABLES = [
    Case("u8", "COLORT", {"index_type": 3, "map_type": 3, "table": GREYS}, ColorTable(3, 3, bytes(GREYS))),
    Case(
        "u16",
        "COLORT",
        {"index_type": 3, "map_type": 5, "table": WIDE_GREYS},
        ColorTable(3, 5, np.array(WIDE_GREYS, ">u2").tobytes()),
    ),
    *(wide_table(*kind) for kind in (("u8", 3, "u1", 1), ("u16", 5, ">u2", 1), ("colours", 19, "u1", 3))),
]
NAMES = ["TRANSFORM", "GET_CAPABIL", "TwelveLetter"]
CAPABILITIES = [
    Case("some", "CAPABILITY", {"types": NAMES}, Capability(tuple(NAMES))),
    Case("empty", "CAPABILITY", {"types": []}, Capability(())),
]


def bind(name: str, *children: tuple[str, Case]) -> Case:
    """A BIND of other cases under these names."""
    packed = [(title, case, join(case.body.pack())) for title, case in children]
    content = [
        {"type": case.type, "name": title, "size": len(data), "content": case.content} for title, case, data in packed
    ]
    body = Bind(tuple(BindChild(case.type, title, data) for title, case, data in packed))
    return Case(name, "BIND", {"children": content}, body)


def query_of_bind(name: str, *wanted: tuple[str, str]) -> list[Case]:
    """GET_BIND and STT_BIND; the library only writes them, and no interval."""
    content = {"children": [{"type": kind, "name": title} for kind, title in wanted]}
    return [
        Case(name, "GET_BIND", content, GetBind(wanted), from_us=False),
        Case(name, "STT_BIND", content, StartBind(0, wanted), from_us=False),
    ]


ODD_SIZE = Case("odd", "STRING", string("odd", 3), String(b"odd"))
ASKED = Case("asked", "GET_STATUS", {}, EmptyQuery())
NESTED = bind("inner", ("", ODD_SIZE), ("Inner", BASIC[0]))
BINDS = [
    bind("one", (DEVICE, BASIC[0])),
    bind("each type once", *((f"{number}", case) for number, case in enumerate(LISTS))),
    bind("odd sizes", ("a", ODD_SIZE), ("bb", ASKED), ("ccc", ODD_SIZE), ("", BASIC[-1])),
    bind("others", ("Force", SENSORS[1]), ("Matrix", ARRAYS[0]), ("Table", TABLES[0]), ("Picture", IMAGES[-1])),
    bind("nested", ("outer", NESTED), ("after", ODD_SIZE)),
]
QUERIES = [
    *(Case("asks", name, {}, EmptyQuery()) for name in reference.WITHOUT_CONTENT),
    *(
        Case(title, name, {"resolution": resolution, "coordinate_name": frame}, StartTracking(resolution, frame))
        for name in ("STT_TDATA", "STT_QTDATA")
        for title, resolution, frame in (("as fast as possible", 0, ""), ("slow", 2**31 - 1, MIDDLE), ("odd", -1, "µ"))
    ),
    *(
        Case(f"{code}", name, {"status": code}, QueryReply(code))
        for name in ("RTS_TDATA", "RTS_QTDATA", "RTS_BIND")
        for code in (0, 1, 255)
    ),
    *query_of_bind("even names", ("TRANSFORM", "Probe"), ("GET_CAPABIL", "NineteenBytesOfName")),
    *query_of_bind("odd names", ("TRANSFORM", "Needle")),
]
CASES = [
    *BASIC, *IMAGES, *SURFACES, *LISTS, *NO_ELEMENTS, *SENSORS, *ARRAYS, *TABLES, *CAPABILITIES, *BINDS, *QUERIES
]  # fmt: skip


def test_every_type_of_the_library_is_among_the_cases() -> None:
    assert {case.type for case in CASES} == ENCODERS.keys()
    assert ENCODERS.keys() <= BODIES.keys()


# ── the links ──────────────────────────────────────────────────────────────────────────────────────────────────────


class Ours:
    """Our end of a link: an edge that listens and the codec."""

    def __init__(self) -> None:
        self._frames: queue.Queue[Buffer] = queue.Queue()
        self._link: queue.Queue[int] = queue.Queue()
        self._faults: list[Note] = []
        self._edge = TcpEdge(
            on_frame=lambda _, frame: self._frames.put(frame),
            on_link=self._changed,
            on_note=lambda _, note: self._faults.append(note),
            clock=SystemClock(),
        )
        _, self.port = self._edge.listen("127.0.0.1", 0)
        self._edge.start()

    def _changed(self, number: int, up: bool, note: Note) -> None:
        if up:
            self._link.put(number)

    def wait_peer(self) -> None:
        self.link = self._link.get(timeout=WAIT_S)

    def send(self, case: Case) -> None:
        buffers = encode(Message(case.type, DEVICE, case.body, SEC << 32 | FRAC))
        self._edge.send([self.link], buffers, case.type, True)

    def receive(self) -> tuple[Message, bytes]:
        """The next message and its bytes; raises for a wrong CRC."""
        frame = self._frames.get(timeout=WAIT_S)
        return decode(frame), bytes(frame)

    def __enter__(self) -> Ours:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._edge.stop()
        assert not self._faults


@pytest.fixture(scope="module")
def cpp() -> Iterator[tuple[Ours, ReferencePeer]]:
    """One link for all cases: each also proves that the one before left the stream in step."""
    with Ours() as ours, ReferencePeer.client("127.0.0.1", ours.port) as peer:
        ours.wait_peer()
        yield ours, peer


@pytest.fixture(scope="module")
def py() -> Iterator[tuple[Ours, PyigtlPeer]]:
    with Ours() as ours, PyigtlPeer.client("127.0.0.1", ours.port) as peer:
        ours.wait_peer()
        yield ours, peer


def clean(body: Body) -> Body:
    """Without what stands in reserved bytes, of which the library writes none."""
    if isinstance(body, Bind):
        children = (replace(child, content=join(clean(read_child(child)).pack())) for child in body.children)
        return replace(body, children=tuple(children))
    if not isinstance(body, Elements) or "reserved" not in (body.DTYPE.names or ()):
        return body
    elements = body.elements.copy()
    elements["reserved"] = 0
    return replace(body, elements=elements)


# ── the C++ library ────────────────────────────────────────────────────────────────────────────────────────────────


@needs_reference
@table("case", [case for case in CASES if case.to_us], ids=str)
def test_what_the_library_encodes_is_what_we_decode(cpp: tuple[Ours, ReferencePeer], case: Case) -> None:
    ours, peer = cpp
    peer.send(case.type, DEVICE, case.content, SEC, FRAC)
    message, frame = ours.receive()
    assert (message.type, message.device_name, message.ticks) == (case.type, DEVICE, SEC << 32 | FRAC)
    case.check(describe_content(message.content))
    assert join(encode(message)) == frame
    if case.from_us:
        assert type(message.content) is type(case.body)
        assert join(clean(message.content).pack()) == join(case.body.pack())


@needs_reference
@table("case", [case for case in CASES if case.from_us], ids=str)
def test_what_we_encode_is_what_the_library_unpacks(cpp: tuple[Ours, ReferencePeer], case: Case) -> None:
    ours, peer = cpp
    ours.send(case)
    got = peer.receive(case.type, timeout_s=WAIT_S)
    assert got["crc_ok"]
    assert (got["device_name"], got["timestamp"]) == (DEVICE, {"sec": SEC, "frac": FRAC})
    case.check(got["content"])
    case.check(describe_content(case.body))


@needs_reference
@pytest.mark.parametrize("nanosec", [1, 500_000_000, 999_999_999])
def test_scan_times_are_as_good_as_the_librarys_arithmetic(cpp: tuple[Ours, ReferencePeer], nanosec: int) -> None:
    ours, peer = cpp
    (case,) = (case for case in LISTS if case.type == "IMGMETA")
    stamp_ns = SEC * NS_PER_S + nanosec
    first = case.content["elements"][0] | {"timestamp": {"sec": SEC, "nanosec": nanosec}}
    peer.send("IMGMETA", DEVICE, {"elements": [first]})
    images = ours.receive()[0].content
    assert isinstance(images, ImageMetaList)
    assert abs(ticks_to_ns(int(images.elements["ticks"][0])) - stamp_ns) <= reference.STAMP_NS

    images = ImageMetaList(images.elements.copy())
    images.elements["ticks"] = ns_to_ticks(stamp_ns)
    ours.send(replace(case, body=images))
    (element,) = peer.receive("IMGMETA", timeout_s=WAIT_S)["content"]["elements"]
    told = element["timestamp"]
    assert abs(told["sec"] * NS_PER_S + told["nanosec"] - stamp_ns) <= reference.STAMP_NS


# ── pyigtl ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def suits_pyigtl(case: Case) -> bool:
    """Of its types, not empty, ASCII, no part of a volume, small enough to arrive in one piece (it loses others)."""
    part = case.content.get("subvol_size") != case.content.get("dimensions")
    text = json.dumps(case.content, ensure_ascii=False)
    return case.type in pyigtl_peer.CODECS and text.isascii() and len(text) < 4096 and case.name != "empty" and not part


PYIGTL_CASES = [case for case in CASES if suits_pyigtl(case)]


def check_pyigtl(case: Case, described: dict[str, Any]) -> None:
    """All values that pyigtl gives are right (numpy has no byte order for single bytes)."""
    told = described.keys() - ({"endian"} if case.content.get("scalar_type") in (2, 3) else set())
    expected = {key: value for key, value in case.content.items() if key in told}
    assert expected
    assert only(described, expected) == expected


@table("case", [case for case in PYIGTL_CASES if case.content.get("endian", 2) == 2], ids=str)
def test_what_pyigtl_encodes_is_what_we_decode(py: tuple[Ours, PyigtlPeer], case: Case) -> None:
    ours, peer = py
    peer.send(case.type, DEVICE, case.content, SEC, FRAC)
    message, frame = ours.receive()
    assert (message.type, message.device_name) == (case.type, DEVICE)
    assert message.ticks == pytest.approx(SEC << 32 | FRAC, abs=2**32 * 1e-6, rel=0)
    case.check(describe_content(message.content))
    assert join(encode(message)) == frame


@table("case", PYIGTL_CASES, ids=str)
def test_what_we_encode_is_what_pyigtl_reads(py: tuple[Ours, PyigtlPeer], case: Case) -> None:
    ours, peer = py
    ours.send(case)
    got = peer.receive(case.type, timeout_s=WAIT_S)
    assert got["device_name"] == DEVICE
    check_pyigtl(case, got["content"])


def test_pyigtl_has_cases_of_all_its_types() -> None:
    assert {case.type for case in PYIGTL_CASES} == pyigtl_peer.CODECS.keys()
