"""Hypothesis strategies for OpenIGTLink messages and ROS messages: valid ones, odd ones, broken ones.

Numbers are drawn small and often at the edges: what breaks a codec is the shape of a message, not its bulk.
Tables of strategies are made once: to make them costs more than to draw from them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.convert import common_msgs, igtl_msgs, rosmsg
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.structs import OCTETS, Struct
from igtl_gateway.wire import Item, Message, Raw, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.colort import ENTRIES, MAP_RGB, MAP_U8, MAP_U16, MAPS, ColorTable
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.image import SCALARS, Image
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.ndarray import NDARRAY_SCALARS, NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Attribute, Cells, PolyData
from igtl_gateway.wire.query import (
    QUERIES,
    EmptyQuery,
    GetBind,
    QueryReply,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
)
from igtl_gateway.wire.sensor import PREFIXES, UNITS, Sensor, unit_word
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.trajectory import Trajectories
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video

# -- numbers and strings ----------------------------------------------------------------------------------------

finite32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
any32 = st.floats(width=32)
finite64 = st.floats(allow_nan=False, allow_infinity=False)
any64 = st.floats() | st.sampled_from([0.0, -0.0, 1e-300, 1e300, 1e38, math.inf, -math.inf, math.nan])
metres = st.floats(min_value=-1e4, max_value=1e4, allow_subnormal=False)
u16 = st.integers(0, 0xFFFF)
u32 = st.sampled_from([0, 1, 2, 3, 4, 255, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1]) | st.integers(0, 2**32 - 1)
small = st.integers(0, 6)

ascii_text = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=12)


def fixed_text(width: int) -> st.SearchStrategy[str]:
    """What a fixed-width field may hold: any bytes that do not end in NUL, as the codec decodes them."""
    return st.binary(max_size=width).map(
        lambda data: data.rstrip(b"\x00").decode("utf-8", "surrogateescape")
    ) | ascii_text.map(lambda text: text[:width])


# -- OpenIGTLink bodies -----------------------------------------------------------------------------------------


def transforms(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Transform]:
    return st.tuples(*[numbers] * 12).map(Transform)


def positions(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Position]:
    return st.builds(Position, st.tuples(*[numbers] * 3), st.tuples(*[numbers] * 4))


mib = st.sampled_from([0, 3, 4, 17, 106, 1013, 1014, 1015, 2025, 65535])
strings = st.builds(String, st.binary(max_size=40), mib)


@st.composite
def statuses(draw: st.DrawFn) -> Status:
    terminated = draw(st.booleans())
    data = draw(st.binary(max_size=30))
    if not terminated:
        data = data.rstrip(b"\x00")
    text = data.decode("utf-8", "surrogateescape")
    subcode = draw(st.integers(-(2**63), 2**63 - 1))
    return Status(draw(u16), subcode, draw(fixed_text(20)), text, terminated)


def elements(kind: type[Elements], numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Any]:
    """A list of any of the types that are lists: any text, any integers, reserved bytes too."""
    names = kind.DTYPE.names or ()
    items = [kind.DTYPE[name].base for name in names]
    # a few values, repeated: drawing each number of a matrix would take most of the time of the tests
    columns = [st.lists(_items(item, numbers), min_size=1, max_size=5) for item in items]

    def made(length: int, *few: list[Any]) -> Elements:
        array = np.zeros(length, kind.DTYPE)
        for name, item, values in zip(names, items, few, strict=True):
            array[name] = np.resize(np.array(values, item), array[name].shape)
        return kind(array)

    return st.builds(made, st.integers(0, 4), *columns)


def _items(item: np.dtype[Any], numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Any]:
    if item.kind == "S":
        return st.binary(max_size=item.itemsize)
    if item.kind == "f":
        return numbers
    info = np.iinfo(item)
    return st.sampled_from([0, int(info.max)]) | st.integers(int(info.min), int(info.max))


def points(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Points]:
    return elements(Points, numbers)


def sensors(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Sensor]:
    values = st.lists(numbers, max_size=6).map(lambda numbers: np.array(numbers, ">f8"))
    return st.builds(Sensor, values, st.integers(0, 2**64 - 1) | unit_words, st.sampled_from([0, 1, 255]))


#: Units as a careful sender writes them: no gaps, no codes that do not exist.
unit_words = st.builds(
    unit_word,
    st.sampled_from(sorted(PREFIXES)),
    st.lists(st.tuples(st.integers(1, len(UNITS)), st.integers(1, 7) | st.integers(-7, -1) | st.just(1)), max_size=6),
)


@st.composite
def nd_arrays(draw: st.DrawFn) -> NdArray:
    scalar = draw(st.sampled_from(sorted(NDARRAY_SCALARS)))
    size = tuple(draw(st.lists(small, min_size=1, max_size=4) | st.just([1] * 255) | st.just([0] + [65535] * 9)))
    length = math.prod(size) * np.dtype(NDARRAY_SCALARS[scalar]).itemsize
    data = np.resize(np.frombuffer(draw(st.binary(min_size=1, max_size=16)), np.uint8), length).tobytes()
    return NdArray(scalar, size, data)


@st.composite
def color_tables(draw: st.DrawFn) -> ColorTable:
    index, kind = draw(st.sampled_from([3, 3, 3, 5])), draw(st.sampled_from(sorted(MAPS)))
    length = ENTRIES[index] * {MAP_U8: 1, MAP_U16: 2, MAP_RGB: 3}[kind]
    table = np.resize(np.frombuffer(draw(st.binary(min_size=1, max_size=16)), np.uint8), length).tobytes()
    return ColorTable(index, kind, table)


capabilities = st.lists(fixed_text(12), max_size=5).map(lambda names: Capability(tuple(names)))


def cells(count: int) -> st.SearchStrategy[Cells]:
    """Cells over ``count`` points, of equal or of mixed length."""
    if not count:
        return st.lists(st.just([]), max_size=2).map(Cells.of)
    index = st.integers(0, count - 1)
    return st.lists(st.lists(index, max_size=6), max_size=5).map(Cells.of) | st.lists(
        st.lists(index, min_size=3, max_size=3), max_size=4
    ).map(Cells.of)


@st.composite
def attributes(draw: st.DrawFn, count: int, numbers: st.SearchStrategy[float]) -> Attribute:
    kind = draw(st.sampled_from([0, 1, 2, 3, 4, 5, 0x10, 0x11, 0x12, 0x13, 0x14, 0x15, 0x77]))
    components = draw(st.sampled_from([1, 2, 3, 4, 9, 255]))
    tuples = draw(st.sampled_from([0, count, count, count + 1]))
    name = draw(
        st.sampled_from(["", "x", "y", "RGB", "rgba", "Colors", "rgb", "normal_x", "Normals", "diameter"])
        | st.binary(max_size=20).map(lambda data: data.replace(b"\x00", b"").decode("utf-8", "surrogateescape"))
    )
    value = draw(st.lists(numbers, min_size=1, max_size=5))
    data = np.resize(np.array(value, ">f4"), components * tuples).astype(">f4")
    return Attribute(kind, name, components, data)


@st.composite
def polydatas(draw: st.DrawFn, numbers: st.SearchStrategy[float]) -> PolyData:
    count = draw(small)
    xyz = np.array(draw(st.lists(numbers, min_size=3 * count, max_size=3 * count)), ">f4").reshape(count, 3)
    sections = [draw(cells(count)) for _ in range(4)]
    names = draw(st.lists(attributes(count, numbers), max_size=4))
    vertices, lines, polygons, strips = sections
    return PolyData(xyz, vertices, lines, polygons, strips, tuple(names))


@st.composite
def images(draw: st.DrawFn, numbers: st.SearchStrategy[float], *, flat: bool = False) -> Image:
    size = (draw(small), draw(small), 1 if flat else draw(st.integers(0, 3)))
    offset = (0, 0, 0) if flat else tuple(draw(st.integers(0, n)) for n in size)
    part = tuple(n if flat else draw(st.integers(0, n - at)) for n, at in zip(size, offset, strict=True))
    scalar, components = draw(st.sampled_from(sorted(SCALARS))), draw(st.sampled_from([1, 2, 3, 4, 5, 254, 255]))
    length = math.prod(part) * components * np.dtype(SCALARS[scalar]).itemsize
    pixels = np.resize(np.frombuffer(draw(st.binary(min_size=1, max_size=16)), np.uint8), length).tobytes()
    return Image(
        size,
        scalar,
        pixels,
        components,
        draw(st.sampled_from([1, 2])),
        draw(st.sampled_from([1, 2])),
        draw(st.tuples(*[numbers] * 12)),
        (offset[0], offset[1], offset[2]),
        (part[0], part[1], part[2]),
        draw(st.sampled_from([1, 1, 0, 65535])),
    )


u8 = st.integers(0, 255)
u64 = st.sampled_from([0, 1, 2**63, 2**64 - 1]) | st.integers(0, 2**64 - 1)
commands = st.builds(Command, u32, fixed_text(128), st.binary(max_size=40), mib)


def videos(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Video]:
    triple = st.tuples(u16, u16, u16)
    return st.builds(
        Video,
        fixed_text(4),
        triple,
        st.binary(max_size=40),
        u16,
        u8,
        u8,
        st.tuples(*[numbers] * 12),
        triple,
        triple,
        u16,
    )


child_names = st.binary(max_size=24).map(lambda name: name.replace(b"\x00", b"").decode("utf-8", "surrogateescape"))


def binds(table: dict[str, st.SearchStrategy[Body]], depth: int = 3) -> st.SearchStrategy[Bind]:
    """Of known contents, of contents that no codec can read, of BIND again."""
    known = st.sampled_from(sorted(table)).flatmap(lambda kind: st.tuples(st.just(kind), table[kind].map(_content)))
    garbage = st.tuples(st.sampled_from([*table, "CUSTOM"]), st.binary(max_size=30))
    inner = st.tuples(st.just("BIND"), binds(table, depth - 1).map(_content)) if depth else st.nothing()
    child = st.builds(lambda pair, name: BindChild(pair[0], name, pair[1]), known | garbage | inner, child_names)
    return st.lists(child, max_size=3).map(lambda children: Bind(tuple(children)))


def _content(body: Body) -> bytes:
    return join(body.pack())


wanted = st.lists(st.tuples(fixed_text(12), child_names), max_size=3).map(tuple)
QUERY_BODIES: dict[type[Body], st.SearchStrategy[Body]] = {
    EmptyQuery: st.builds(EmptyQuery, st.just(b"") | st.binary(max_size=4)),
    QueryReply: st.builds(QueryReply, u8) | st.just(QueryReply(has_body=False)),
    StartTracking: st.builds(StartTracking, st.integers(-(2**31), 2**31 - 1), fixed_text(32))
    | st.just(StartTracking(has_body=False)),
    StartVideo: st.builds(StartVideo, fixed_text(4), u32, st.binary(max_size=1)),
    StartPolyData: st.builds(StartPolyData, st.none() | u64),
    GetBind: st.builds(GetBind, wanted),
    StartBind: st.builds(StartBind, u64, wanted),
}


@cache
def bodies(numbers: st.SearchStrategy[float] = any32) -> dict[str, st.SearchStrategy[Body]]:
    """Type name → strategy of its contents."""
    table = _data_bodies(numbers)
    return {
        **table,
        "BIND": binds(table),
        "COMMAND": commands,
        "RTS_COMMAND": commands,
        "VIDEO": videos(numbers),
        "CUSTOM": st.binary(min_size=1, max_size=80).map(Raw),
        **{kind: QUERY_BODIES[body] for kind, body in QUERIES.items()},
    }


def _data_bodies(numbers: st.SearchStrategy[float]) -> dict[str, st.SearchStrategy[Body]]:
    return {
        "TRANSFORM": transforms(numbers),
        "POSITION": positions(numbers),
        "QTRANS": positions(numbers),
        "STRING": strings,
        "CLIENTINFO": strings.map(lambda one: ClientInfo(one.data, one.encoding)),
        "STATUS": statuses(),
        "POINT": points(numbers),
        "POLYDATA": polydatas(numbers),
        "IMAGE": images(numbers),
        "TDATA": elements(TrackingData, numbers),
        "QTDATA": elements(QuaternionTrackingData, numbers),
        "TRAJ": elements(Trajectories, numbers),
        "IMGMETA": elements(ImageMetaList, numbers),
        "LBMETA": elements(LabelMetaList, numbers),
        "VIDEOMETA": elements(VideoMetaList, numbers),
        "SENSOR": sensors(numbers),
        "NDARRAY": nd_arrays(),
        "COLORT": color_tables(),
        "COLORTABLE": color_tables(),
        "CAPABILITY": capabilities,
        "CAPABIL": capabilities,
    }


# -- OpenIGTLink messages ---------------------------------------------------------------------------------------

items = st.builds(
    Item,
    st.binary(max_size=12).map(lambda key: key.decode("utf-8", "surrogateescape")),
    st.binary(max_size=12),
    u16,
)
full_names = ascii_text.map(lambda text: Item.of("DeviceName", text * 30))


@st.composite
def messages(draw: st.DrawFn, numbers: st.SearchStrategy[float] = any32) -> Message:
    """Any message that can be encoded."""
    table = bodies(numbers)
    # there are more names of queries than of data, and less to be found in them
    kind = draw(st.sampled_from(sorted(table.keys() - QUERIES.keys())) | st.sampled_from(sorted(QUERIES)))
    version = draw(st.sampled_from([1, 2]))
    ticks = draw(st.sampled_from([0, 1, 2**64 - 1]) | st.integers(0, 2**64 - 1))
    device = draw(fixed_text(20))
    if version == 1:
        return Message(kind, device, draw(table[kind]), ticks)
    pairs = tuple(draw(st.lists(items | full_names, max_size=3)))
    return Message(kind, device, draw(table[kind]), ticks, 2, draw(st.integers(0, 2**32 - 1)), pairs)


@st.composite
def damaged(draw: st.DrawFn, data: st.SearchStrategy[bytes], head: int) -> bytes:
    """Bytes with some words overwritten, some bits flipped, and perhaps cut or lengthened behind ``head``."""
    bent = bytearray(draw(data))
    for _ in range(draw(st.integers(0, 3))):
        if len(bent) > head:
            at = draw(st.integers(head, len(bent) - 1))
            bent[at] ^= 1 << draw(st.integers(0, 7))
    if len(bent) > head + 4 and draw(st.booleans()):
        at = draw(st.integers(head, len(bent) - 4))
        word = draw(st.sampled_from([0, 1, 255, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]))
        bent[at : at + 4] = word.to_bytes(4, draw(st.sampled_from(["little", "big"])))
    cut = draw(st.integers(0, 40))
    if cut and draw(st.booleans()):
        del bent[max(head, len(bent) - cut) :]
    return bytes(bent + draw(st.sampled_from([b"", b"", b"\x00", b"\xff" * 7])))


def resized(data: bytes) -> bytes:
    """An OpenIGTLink message with the body size that its bytes really have: damage gets past the framing."""
    return data[:42] + (len(data) - 58).to_bytes(8, "big") + data[50:]


def wire_bytes(numbers: st.SearchStrategy[float] = any32) -> st.SearchStrategy[bytes]:
    return messages(numbers).map(lambda message: join(encode(message)))


#: Messages broken in their bodies (and sometimes in their headers).
damaged_wire_bytes = damaged(wire_bytes(), 58).map(resized) | damaged(wire_bytes(), 0) | st.binary(max_size=200)


# -- ROS messages -----------------------------------------------------------------------------------------------

ros_text = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=12)
headers = st.builds(
    rosmsg.Header,
    st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1) | st.just(0),
    ros_text,
)


def ros_transforms(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[rosmsg.TransformStamped]:
    return st.builds(rosmsg.TransformStamped, headers, ros_text, st.tuples(*[numbers] * 3), st.tuples(*[numbers] * 4))


def ros_points(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[rosmsg.PointStamped]:
    return st.builds(rosmsg.PointStamped, headers, st.tuples(*[numbers] * 3))


ENCODINGS = ["mono8", "mono16", "rgb8", "bgr8", "rgba8", "bgra8", "rgb16", "bgr16", "rgba16", "bgra16",
             "bayer_rggb8", "bayer_gbrg16", "8UC1", "8SC2", "16SC1", "16UC3", "32SC1", "32FC1", "64FC2"]  # fmt: skip


@st.composite
def ros_images(draw: st.DrawFn) -> rosmsg.Image:
    """Mostly consistent pictures, with row padding; sometimes nonsense."""
    encoding = draw(st.sampled_from(ENCODINGS) | ros_text | st.sampled_from(["8UC0", "64FC999", "yuv422"]))
    height, width, pad = draw(small), draw(small), draw(small)
    step = width * 16 + pad
    if draw(st.booleans()):
        height, width, step = draw(u32), draw(u32), draw(u32)
        data = draw(st.binary(max_size=64))
    else:
        data = bytes(step * height)
    return rosmsg.Image(draw(headers), height, width, encoding, draw(st.integers(0, 255)), step, data)


@st.composite
def ros_clouds(draw: st.DrawFn) -> rosmsg.PointCloud2:
    """Clouds with x, y, z and odd further fields; sizes sometimes contradict each other."""
    sizes = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 8}
    names = st.sampled_from(
        ["rgb", "rgba", "normal_x", "normal_y", "normal_z", "intensity", "diameter", "x", "", "big"]
    )
    fields, offset = [], 0
    wanted = ["x", "y", "z", *draw(st.lists(names | ros_text, max_size=5))]
    for name in wanted:
        plain = name in ("x", "y", "z") and draw(st.integers(0, 9))
        datatype = draw(st.sampled_from([7, 8]) if plain else st.integers(0, 9))
        count = 1 if plain else draw(st.sampled_from([0, 1, 1, 2, 3, 256]))
        fields.append(rosmsg.PointField(name, offset, datatype, count))
        offset += sizes.get(datatype, 1) * max(count, 1)
    height, width, pad = draw(st.integers(0, 3)), draw(small), draw(small)
    row = offset * width + pad
    data = np.resize(np.frombuffer(draw(st.binary(min_size=8, max_size=24)), np.uint8), row * height).tobytes()
    if draw(st.integers(0, 4)) == 0:
        height, width, row = draw(u32), draw(u32), draw(u32)
        offset = draw(u32)
    return rosmsg.PointCloud2(
        draw(headers), height, width, tuple(fields), draw(st.booleans()), offset, row, data, draw(st.booleans())
    )


@st.composite
def ros_meshes(draw: st.DrawFn, numbers: st.SearchStrategy[float]) -> rosmsg.Mesh:
    count, faces = draw(small), draw(small)
    vertices = np.array(draw(st.lists(numbers, min_size=3 * count, max_size=3 * count)), float).reshape(-1, 3)
    index = st.integers(0, count) | u32 if draw(st.booleans()) else st.integers(0, max(count - 1, 0))
    triangles = np.array(draw(st.lists(index, min_size=3 * faces, max_size=3 * faces)), "<u4").reshape(-1, 3)
    return rosmsg.Mesh(triangles, vertices)


@st.composite
def ros_markers(draw: st.DrawFn, numbers: st.SearchStrategy[float]) -> rosmsg.Marker:
    count = draw(st.integers(0, 7))
    colours = draw(st.sampled_from([0, count, count, 1]))
    return rosmsg.Marker(
        draw(headers),
        draw(ros_text),
        draw(st.integers(-(2**31), 2**31 - 1)),
        draw(st.integers(-1, 12)),
        draw(st.sampled_from([0, 0, 0, 1, 2, 3])),
        draw(st.tuples(*[numbers] * 3)),
        draw(st.tuples(*[numbers] * 4)),
        draw(st.tuples(*[numbers] * 3)),
        draw(st.tuples(*[finite32] * 4)),
        np.array(draw(st.lists(numbers, min_size=3 * count, max_size=3 * count)), float).reshape(-1, 3),
        np.array(draw(st.lists(any32, min_size=4 * colours, max_size=4 * colours)), np.float32).reshape(-1, 4),
        draw(ros_text),
    )


ros_diagnostics = st.builds(
    rosmsg.DiagnosticStatus,
    st.integers(0, 127),  # "byte", which rosbags takes as signed
    ros_text,
    ros_text,
    ros_text,
    st.lists(
        st.tuples(
            st.sampled_from(["code", "subcode", "error_name"]) | ros_text,
            ros_text | st.integers(-(2**70), 2**70).map(str) | st.integers(0, 20).map(str),
        ),
        max_size=4,
    ).map(tuple),
)


@cache
def ros_messages(numbers: st.SearchStrategy[float] = any64) -> dict[str, st.SearchStrategy[rosmsg.RosMessage]]:
    """Type name → strategy of its messages."""
    table: dict[type[rosmsg.RosMessage], st.SearchStrategy[Any]] = {
        rosmsg.String: st.builds(rosmsg.String, ros_text),
        rosmsg.TransformStamped: ros_transforms(numbers),
        rosmsg.PointStamped: ros_points(numbers),
        rosmsg.Image: ros_images(),
        rosmsg.PointCloud2: ros_clouds(),
        rosmsg.Mesh: ros_meshes(numbers),
        rosmsg.Marker: ros_markers(numbers),
        rosmsg.DiagnosticStatus: ros_diagnostics,
    }
    return {kind.TYPE: strategy for kind, strategy in table.items()}


#: Words that mean something to conversions, among any others.
_words = ros_text | st.sampled_from(["TDATA", "IMAGE", "h264", "H264", "mm/s^2", "STRING", "Tool"])

#: Any bytes, and as many as small tables and pictures have.
_octets = st.binary(max_size=96) | st.sampled_from([256, 768]).map(bytes)

#: Name of a CDR type → its values; of structs and sequences of them ``of_fields`` knows.
_VALUES: dict[str, st.SearchStrategy[Any]] = {
    "bool": st.booleans(),
    "int16": st.integers(-(2**15), 2**15 - 1),
    "uint8": st.sampled_from([0, 1, 2, 3, 5, 10, 11, 13, 19]) | u8,
    "uint16": u16,
    "uint32": u32,
    "uint64": u64,
    "float32": any32,
    "float64": any64,
    "string": _words,
    "string[]": st.lists(_words, max_size=4).map(tuple),
    "uint8[4]": st.tuples(u8, u8, u8, u8),
    "uint16[3]": st.tuples(u16, u16, u16) | st.tuples(small, small, small),
    "builtin_interfaces/Time": st.integers(0, 2**32 * 10**9 // 2 - 1),
    "std_msgs/Header": headers,
}


def _numbers(name: str) -> st.SearchStrategy[Any]:
    """Values of a type that is made of equal numbers."""
    kinds = {
        f"geometry_msgs/{kind}": (columns, any64)
        for kind, columns in (("Point", 3), ("Pose", 7), ("Twist", 6), ("Wrench", 6))
    }
    base, bracket, count = name.partition("[")
    columns, number = kinds.get(base, (1, _VALUES.get(base, st.integers(-100, 100))))
    if not bracket or count != "]":
        size = int(count.rstrip("]")) if bracket else columns
        return st.lists(number, min_size=size, max_size=size).map(tuple)
    dtype = np.dtype(base if columns == 1 else "float64")
    rows = st.lists(st.lists(number, min_size=columns, max_size=columns), max_size=4)
    return rows.map(lambda values: np.array(values, dtype).reshape((-1, columns) if columns > 1 else -1))


STRUCTS: dict[str, type[Struct]] = {
    kind.TYPE: kind
    for kind in (
        *(kind for module in (igtl_msgs, common_msgs) for kind in vars(module).values()),
        *MULTI_ARRAYS.values(),
    )
    if isinstance(kind, type) and issubclass(kind, Struct) and hasattr(kind, "TYPE")
}


def of_fields(kind: type[Struct]) -> st.SearchStrategy[Any]:
    """Messages that have field tables: any values that the fields hold."""

    def value(name: str) -> st.SearchStrategy[Any]:
        if name in _VALUES:
            return _VALUES[name]
        if name in STRUCTS:
            return of_fields(STRUCTS[name])
        if name.removesuffix("[]") in STRUCTS:
            return st.lists(of_fields(STRUCTS[name.removesuffix("[]")]), max_size=3).map(tuple)
        return _numbers(name)

    return st.builds(kind, *(_octets if cdr is OCTETS else value(cdr.name) for cdr in kind.FIELDS))


@cache
def packed(kind: str) -> st.SearchStrategy[bytes]:
    """CDR bytes of one type: mostly good, sometimes damaged, sometimes garbage."""
    messages: st.SearchStrategy[Any] = of_fields(STRUCTS[kind]) if kind in STRUCTS else ros_messages()[kind]
    good: st.SearchStrategy[bytes] = messages.map(_pack)
    return good | damaged(good, 4) | st.binary(max_size=60).map(lambda data: b"\x00\x01\x00\x00" + data)


_pack: Callable[[rosmsg.RosMessage], bytes] = lambda message: message.pack()  # noqa: E731
