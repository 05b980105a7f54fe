"""Messages are compared by value, in millimetres, degrees, points and pixels."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import FrameTransform as Frame
from igtl_gateway.convert.common_msgs import PoseArray, PoseStamped, TFMessage
from igtl_gateway.convert.rosmsg import Header, Image, PointCloud2, PointField, PointStamped, RosMessage, String
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.stream_units import StreamUnits
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.replay.compare import EXACT, Delta, LeafDecoder, Tolerance, Undecodable, compare_values, first_byte
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image as IgtlImage
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.text import String as IgtlString
from igtl_gateway.wire.tracking import TRACKING_DTYPE, TrackingData
from igtl_gateway.wire.trajectory import Trajectories
from igtl_gateway.wire.transform import Position, Transform
from tests.places import FIXTURES

HEADER = Header(5_000_000_000, "world")
UNIT = (0.0, 0.0, 0.0, 1.0)
HALF = math.radians(1.0) / 2
ONE_DEGREE = (0.0, 0.0, math.sin(HALF), math.cos(HALF))


@cache
def definition(ros_type: str) -> str:
    found = RosTypes().find(ros_type)
    assert found
    return found.text(ros_type)


def ros(message: RosMessage) -> Entry:
    return Entry(1, 1, Kind.ROS_IN, "/topic", message.TYPE, (message.pack(),))


def igtl(content: Body, igtl_type: str, ticks: int = 0) -> Entry:
    data = join(encode(Message(igtl_type, "Device", content, ticks)))
    return Entry(1, 1, Kind.IGTL_OUT, f"{igtl_type}/Device", igtl_type, (data,))


def compared(one: Entry, other: Entry, tolerance: Tolerance = EXACT, lengths: LengthUnits = LengthUnits()) -> Delta:
    definitions = {} if "/" not in one.type else {one.type: definition(one.type)}
    decoder = LeafDecoder(definitions, StreamUnits(Config(ros_unit=lengths.ros, igtl_unit=lengths.igtl)))
    return compare_values(decoder.leaves(one), decoder.leaves(other), tolerance)


def moved(by: float) -> Transform:
    return Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 10.0, 20.0, 30.0 + by))


def turned() -> Transform:
    c, s = math.cos(2 * HALF), math.sin(2 * HALF)
    return Transform((c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0, 10.0, 20.0, 30.0))


def test_equal_messages_have_no_difference() -> None:
    assert compared(ros(PoseStamped(HEADER, (1.0, 2.0, 3.0, *UNIT))), ros(PoseStamped(HEADER, (1.0, 2.0, 3.0, *UNIT))))\
        == Delta(stamps_ns=[0])  # fmt: skip


@pytest.mark.parametrize(
    ("one", "other", "mm", "deg", "path"),
    [
        (igtl(moved(0), "TRANSFORM"), igtl(moved(0.5), "TRANSFORM"), 0.5, 0.0, "content.matrix"),
        (igtl(moved(0), "TRANSFORM"), igtl(turned(), "TRANSFORM"), 0.0, 1.0, "content.matrix"),
        (
            igtl(Position((0.0, 0.0, 0.0), UNIT), "POSITION"),
            igtl(Position((3.0, 4.0, 0.0), ONE_DEGREE), "POSITION"),
            *(5.0, 1.0, "content.pose"),
        ),
        (
            ros(PoseStamped(HEADER, (0.0, 0.0, 0.0, *UNIT))),
            ros(PoseStamped(HEADER, (0.003, 0.004, 0.0, *ONE_DEGREE))),
            *(5.0, 1.0, "pose"),
        ),
        (
            ros(PointStamped(HEADER, (0.0, 0.0, 0.0))),
            ros(PointStamped(HEADER, (0.0, 0.0, 0.001))),
            *(1.0, 0.0, "point"),
        ),
        (
            ros(TFMessage((Frame(HEADER, "tool", (0.0, 0.0, 0.0, *UNIT)),))),
            ros(TFMessage((Frame(HEADER, "tool", (0.0, 0.002, 0.0, *UNIT)),))),
            *(2.0, 0.0, "transforms[0].transform"),
        ),
        (
            ros(PoseArray(HEADER, np.array([(0.0, 0.0, 0.0, *UNIT)] * 3))),
            ros(PoseArray(HEADER, np.array([(0.0, 0.0, 0.0, *UNIT)] * 2 + [(0.0, 0.0, 0.007, *UNIT)]))),
            *(7.0, 0.0, "poses[2]"),
        ),
    ],
)
def test_poses_differ_in_millimetres_and_degrees(one: Entry, other: Entry, mm: float, deg: float, path: str) -> None:
    delta = compared(one, other)
    assert delta.mm == pytest.approx(mm, abs=1e-5)
    assert delta.deg == pytest.approx(deg, abs=1e-4)
    assert delta.field == path
    assert compared(one, other, Tolerance(mm * 1.01, deg * 1.01)).field == ""
    assert compared(one, other, Tolerance(mm * 0.99, deg * 0.99)).field == path


def test_a_tool_among_others_is_named() -> None:
    elements = np.zeros(2, TRACKING_DTYPE)
    elements["name"] = [b"a", b"b"]
    other = elements.copy()
    other["matrix"][1][9] = 2.5
    delta = compared(igtl(TrackingData(elements), "TDATA"), igtl(TrackingData(other), "TDATA"))
    assert (delta.field, delta.mm) == ("content.elements[1].matrix", 2.5)


def test_units_are_those_of_the_recording() -> None:
    lengths = LengthUnits("mm", "m")
    point = compared(ros(PointStamped(HEADER, (0, 0, 0))), ros(PointStamped(HEADER, (0, 0, 2.0))), lengths=lengths)
    pose = compared(igtl(moved(0), "TRANSFORM"), igtl(moved(1), "TRANSFORM"), lengths=lengths)
    assert (point.mm, pose.mm) == (2.0, 1000.0)


def test_a_quaternion_and_its_negative_are_one_rotation_but_not_one_value() -> None:
    one = ros(PoseStamped(HEADER, (0.0, 0.0, 0.0, *UNIT)))
    other = ros(PoseStamped(HEADER, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)))
    assert compared(one, other).field == "pose" and compared(one, other).deg == 0
    assert compared(one, other, Tolerance(deg=0.001)).field == ""


def test_what_is_no_number_is_infinitely_far_from_a_number_and_equal_to_itself() -> None:
    one = ros(PointStamped(HEADER, (0.0, 0.0, math.nan)))
    assert compared(one, one).field == ""
    delta = compared(one, ros(PointStamped(HEADER, (0.0, 0.0, 0.0))), Tolerance(1e9, 1e9))
    assert delta.field and delta.mm == math.inf


def image(pixels: bytes, encoding: str = "rgb8", step: int = 8) -> Image:
    return Image(HEADER, 2, 2, encoding, 0, step, pixels)


def test_images_differ_in_pixels_and_what_stands_between_rows_counts_as_bytes() -> None:
    one = image(bytes(12), step=6)
    delta = compared(ros(one), ros(replace(one, data=bytes(5) + b"\x07" + bytes(5) + b"\x01")))
    assert (delta.elements, delta.of, delta.what, delta.largest) == (2, 4, "pixels", 7.0)
    assert delta.field == "data[1]" and delta.other == [0, 0, 7]
    deep = Image(HEADER, 1, 2, "mono16", 0, 4, struct.pack("<HH", 1, 1000))
    delta = compared(ros(deep), ros(replace(deep, data=struct.pack("<HH", 1, 400))))
    assert (delta.elements, delta.of, delta.largest) == (1, 2, 600.0)


def test_openigtlink_images_differ_in_pixels_and_place() -> None:
    one = IgtlImage((2, 2, 1), 3, bytes(4))
    delta = compared(igtl(one, "IMAGE"), igtl(replace(one, pixels=b"\0\0\0\x09"), "IMAGE"))
    assert (delta.field, delta.elements, delta.of, delta.largest) == ("content.data[3]", 1, 4, 9.0)
    matrix = (*one.wire_matrix[:9], 0.0, 0.0, 2.0)
    delta = compared(igtl(one, "IMAGE"), igtl(replace(one, wire_matrix=matrix), "IMAGE"))
    assert (delta.field, delta.mm) == ("content.wire_matrix", 2.0)
    coarse = (2.0, *one.wire_matrix[1:])
    delta = compared(igtl(one, "IMAGE"), igtl(replace(one, wire_matrix=coarse), "IMAGE"), Tolerance(1.0, 1.0))
    assert delta.field == "content.spacing[0]"


@pytest.mark.parametrize("turn", [0, 1, 2])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_pixels_of_each_axis_have_a_length_whatever_way_it_points(axis: int, turn: int) -> None:
    matrix = [0.0] * 12
    for column in range(3):
        matrix[3 * column + (column + turn) % 3] = 1.5
    longer = [*matrix]
    longer[3 * axis + (axis + turn) % 3] = 1.75
    one = IgtlImage((2, 2, 1), 3, bytes(4))
    delta = compared(
        igtl(replace(one, wire_matrix=tuple(matrix)), "IMAGE"),
        igtl(replace(one, wire_matrix=tuple(longer)), "IMAGE"),
        Tolerance(1e-6, 1e-6),
    )
    assert (delta.field, delta.one, delta.other) == (f"content.spacing[{axis}]", 1.5, 1.75)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_landmarks_and_trajectories_differ_in_millimetres(row: int) -> None:
    rows = np.arange(9.0).reshape(3, 3)
    far = rows.copy()
    far[row] += (3.0, 4.0, 0.0)
    delta = compared(igtl(Points.of(rows), "POINT"), igtl(Points.of(far), "POINT"), Tolerance(4.9))
    assert (delta.field, delta.mm) == (f"content.elements[{row}].position", 5.0)
    assert compared(igtl(Points.of(rows), "POINT"), igtl(Points.of(far), "POINT"), Tolerance(5.1)).field == ""
    ways = [np.zeros(3, Trajectories.DTYPE) for _ in range(3)]
    ways[1]["entry"][row], ways[2]["target"][row] = (0.0, 3.0, 4.0), (6.0, 0.0, 8.0)
    for way, name, mm in ((ways[1], "entry", 5.0), (ways[2], "target", 10.0)):
        delta = compared(igtl(Trajectories(ways[0]), "TRAJ"), igtl(Trajectories(way), "TRAJ"))
        assert (delta.field, delta.mm) == (f"content.elements[{row}].{name}", mm)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (2, -3, 6)])
@pytest.mark.parametrize("degrees", [0.5, 30.0, 120.0])
@pytest.mark.parametrize("start", [UNIT, (0.5, -0.5, 0.5, 0.5), (0.6, 0.0, 0.8, 0.0)])
def test_rotations_differ_by_their_angle_about_any_axis(
    axis: tuple[int, int, int], degrees: float, start: tuple[float, float, float, float]
) -> None:
    half, length = math.radians(degrees) / 2, math.hypot(*axis)
    x, y, z, w = start
    a, b, c = (math.sin(half) * each / length for each in axis)
    d = math.cos(half)
    turned = (
        *(d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x),
        *(d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z),
    )
    one, other = (ros(PoseStamped(HEADER, (1.0, 2.0, 3.0, *each))) for each in (start, turned))
    delta = compared(one, other)
    assert delta.deg == pytest.approx(degrees, rel=1e-6) and delta.mm == 0
    one, other = (igtl(Position((1.0, 2.0, 3.0), each), "POSITION") for each in (start, turned))
    assert compared(one, other).deg == pytest.approx(degrees, rel=1e-4)


def cloud(points: np.ndarray[tuple[int, int], np.dtype[np.float32]], first: str = "x") -> PointCloud2:
    fields = tuple(PointField(name, 4 * at, 7) for at, name in enumerate((first, "y", "z", "intensity")))
    return PointCloud2(HEADER, 1, len(points), fields, False, 16, 16 * len(points), points.tobytes(), True)


def test_clouds_differ_in_points_and_in_their_other_fields() -> None:
    points = np.zeros((5, 4), np.float32)
    far, bright = points.copy(), points.copy()
    far[2, :2] = 0.003, 0.004
    bright[1, 3] = 1.0
    delta = compared(ros(cloud(points)), ros(cloud(far)))
    assert (delta.field, delta.elements, delta.of) == ("points[2]", 1, 5)
    assert delta.mm == pytest.approx(5.0)
    assert compared(ros(cloud(points)), ros(cloud(far)), Tolerance(5.01)).field == ""
    delta = compared(ros(cloud(points)), ros(cloud(bright)), Tolerance(5.01))
    assert delta.field == "data[1]" and delta.mm == 0
    assert compared(ros(cloud(points)), ros(cloud(points[:4]))).field == "width"
    assert compared(ros(cloud(points)), ros(cloud(points, "u"))).field == "fields[0].name"


def test_texts_and_all_else_give_path_and_both_values() -> None:
    delta = compared(ros(String("yes")), ros(String("no")))
    assert (delta.field, delta.one, delta.other, delta.measure) == ("data", "yes", "no", "")
    delta = compared(igtl(IgtlString.of("yes"), "STRING"), igtl(IgtlString.of("no"), "STRING"))
    assert (delta.field, delta.one, delta.other) == ("content.string", "yes", "no")


def test_stamps_are_told_apart_from_values() -> None:
    one, other = (ros(PointStamped(Header(ns, "world"), (0.0, 0.0, 0.0))) for ns in (5_000, 9_000))
    assert compared(one, other) == Delta(stamps_ns=[4_000])
    unset = ros(PointStamped(Header(0, "world"), (0.0, 0.0, 0.0)))
    assert compared(one, unset).field == "header.stamp"
    delta = compared(igtl(moved(0), "TRANSFORM", 1 << 32), igtl(moved(0), "TRANSFORM", 3 << 32))
    assert delta == Delta(stamps_ns=[2_000_000_000])


def test_padding_has_no_value() -> None:
    """CDR of foreign nodes: what stands between the fields is undefined."""
    entry = ros(PoseStamped(Header(5, "a"), (1.0, 2.0, 3.0, *UNIT)))
    data = bytearray(entry.data())
    pad = data.index(b"a\0") + 2
    assert (pad - 4) % 8 and data[pad] == 0
    data[pad] = 0xAA
    assert compared(entry, replace(entry, payload=(bytes(data),))) == Delta(stamps_ns=[0])


def test_notes_are_compared_by_code_level_and_stream() -> None:
    def note(level: Level, text: str) -> Entry:
        return Entry(1, 1, Kind.NOTE, payload=(Note(level, "code", text, "/s").pack(),))

    assert compared(note(Level.INFO, "one"), note(Level.INFO, "another")).field == ""
    assert compared(note(Level.INFO, "one"), note(Level.WARN, "one")).field == "level"


@pytest.mark.parametrize(
    "entry",
    [
        Entry(1, 1, Kind.ROS_IN, "/t", "unheard_of/msg/Thing", (b"\0\1\0\0",)),
        Entry(1, 1, Kind.ROS_IN, "/t", "std_msgs/msg/String", (b"\0\1\0\0\xff\xff",)),
        Entry(1, 1, Kind.IGTL_IN, "T/d", "T", (b"short",)),
        Entry(1, 1, Kind.NOTE, payload=(b"{",)),
    ],
)
def test_what_cannot_be_read_is_said(entry: Entry) -> None:
    with pytest.raises(Undecodable):
        list(LeafDecoder({"std_msgs/msg/String": definition("std_msgs/msg/String")}).leaves(entry))
    assert first_byte(b"abc", b"abd") == ("byte 2", "63", "64")
    assert first_byte(b"ab", b"abc") == ("byte 2", "", "63")


def test_every_message_of_every_type_can_be_taken_apart() -> None:
    with SessionFile.open(FIXTURES / "every-type.mcap") as file:
        decoder = LeafDecoder(file.definitions)
        unreadable = []
        for entry in file.entries():
            try:
                leaves = list(decoder.leaves(entry))
            except Undecodable:
                unreadable.append(entry)
                continue
            delta = compare_values(iter(leaves), iter(leaves))
            assert (delta.field, delta.mm, delta.deg, delta.elements) == ("", 0, 0, 0)
        assert {entry.kind for entry in unreadable} <= {Kind.IGTL_IN}, "only what the gateway refused"
        assert len(unreadable) < 10
