"""Lists of what peers have, colour tables, capabilities, bound messages: columns, strings, times, limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks, ticks_to_ns
from igtl_gateway.convert import igtl_msgs, lists
from igtl_gateway.convert.columns import MAX_ROWS
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.geometry import IDENTITY
from igtl_gateway.convert.igtl_msgs import BoundMessage, ImageMeta, LabelMeta, MetadataItem, VideoMeta
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.colort import ENTRIES, MAPS, ColorTable
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.tracking import TrackingData
from tests import strategies
from tests.tables import table

ITEMS = (MetadataItem("key", 3, "value"),)
TO = ToRosContext("Device", 7, "base", "", metadata=ITEMS)
HEADER = Header(7, "base")

BOTH: dict[type[Body], tuple[Any, Any]] = {
    ImageMetaList: (lists.images_to_ros, lists.images_to_igtl),
    LabelMetaList: (lists.labels_to_ros, lists.labels_to_igtl),
    VideoMetaList: (lists.videos_to_ros, lists.videos_to_igtl),
    ColorTable: (lists.colors_to_ros, lists.colors_to_igtl),
    Capability: (lists.capability_to_ros, lists.capability_to_igtl),
    Bind: (lists.bind_to_ros, lists.bind_to_igtl),
}


def published(content: Body, to: ToRosContext = TO) -> Any:
    """As a subscriber reads it."""
    message = BOTH[type(content)][0](content, to)
    assert (message.header, message.metadata) == (HEADER, ITEMS)
    return type(message).unpack(message.pack())


def sent(message: Any, kind: type[Body], warnings: list[str] | None = None, lengths: LengthUnits | None = None) -> Any:
    """The content as a peer reads it."""
    to = ToIgtlContext(lengths or LengthUnits())
    outgoing = BOTH[kind][1](message, to)
    assert isinstance(outgoing.content, kind)
    assert (outgoing.stamp_ns, outgoing.frame_id) == (message.header.stamp_ns, message.header.frame_id)
    assert outgoing.metadata == message.metadata
    assert [code for code, _ in to.warnings] == (warnings or [])
    return kind.unpack(memoryview(join(outgoing.content.pack())))


texts = strategies.ros_text.map(lambda text: text[:4])  # at most 16 bytes
sizes = st.tuples(strategies.u16, strategies.u16, strategies.u16)
u8 = st.integers(0, 255)
# all values of the seconds and the fraction, beyond 2038 too
times = st.integers(0, (1 << 32) * 10**9 - 1)


def elements_of(kind: Any, **fields: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Lists as a careful sender makes them."""

    def make(rows: list[dict[str, Any]]) -> Any:
        elements = np.zeros(len(rows), kind.DTYPE)
        for element, row in zip(elements, rows, strict=True):
            for field, value in row.items():
                element[field] = value.encode() if isinstance(value, str) else value
        return kind(elements)

    return st.lists(st.fixed_dictionaries(fields), max_size=3).map(make)


image_lists = elements_of(
    ImageMetaList,
    **dict.fromkeys(("name", "device_name", "modality", "patient_name", "patient_id"), texts),
    ticks=times.map(ns_to_ticks),
    size=sizes,
    scalar_type=u8,
)
label_lists = elements_of(
    LabelMetaList, name=texts, device_name=texts, owner=texts, label=u8, rgba=st.tuples(u8, u8, u8, u8), size=sizes
)
video_lists = elements_of(
    VideoMetaList,
    **dict.fromkeys(("name", "device_name", "patient_name", "patient_id"), texts),
    zoom_level=st.integers(-(2**15), 2**15 - 1),
    focal_length=strategies.finite32,
    size=sizes,
    matrix=st.tuples(*[strategies.finite32] * 12),
    scalar_type=u8,
)


@given(image_lists | label_lists | video_lists)
def test_lists_of_a_careful_sender_come_back_as_they_were(content: Any) -> None:
    assert unsigned(sent(published(content), type(content))) == unsigned(content)


@pytest.mark.parametrize("kind", [ImageMetaList, LabelMetaList, VideoMetaList])
def test_longer_lists_than_anybody_reads_are_refused(kind: Any) -> None:
    with pytest.raises(ConversionError, match=f"{kind.NAME}: found 10001 elements"):
        published(kind(np.zeros(MAX_ROWS + 1, kind.DTYPE)))


def test_more_types_than_anybody_has_are_refused() -> None:
    published(Capability(("TRANSFORM",) * MAX_ROWS))
    with pytest.raises(ConversionError, match="CAPABILITY: found 10001 elements"):
        published(Capability(("TRANSFORM",) * (MAX_ROWS + 1)))


def unsigned(content: Any) -> Any:
    """With positive zeros only: a vector of no length has no direction."""
    if isinstance(content, VideoMetaList):
        elements = content.elements.copy()
        elements["matrix"] += 0.0
        return VideoMetaList(elements)
    return content


def ros_ns(ticks: int) -> int:
    """The time in ROS: both count 2³² seconds, and the last tick, rounded up, is beyond them."""
    return ticks_to_ns(ticks) % (NS_PER_S << 32)


@given(st.sampled_from(["IMGMETA", "LBMETA", "VIDEOMETA"]).flatmap(lambda kind: strategies.bodies()[kind]))
def test_whatever_the_texts_the_numbers_come_back(content: Any) -> None:
    try:
        back = BOTH[type(content)][1](published(content), ToIgtlContext()).content
    except ConversionError:
        assert isinstance(content, VideoMetaList)
        assert not np.isfinite(content.elements["matrix"]).all()
        return
    assert len(back) == len(content)
    for name in content.DTYPE.names:
        wanted, found = content.elements[name], back.elements[name]
        if name == "ticks":
            assert list(map(ros_ns, found.tolist())) == list(map(ros_ns, wanted.tolist()))
        elif name == "focal_length":
            assert np.allclose(found, wanted, rtol=1e-15, atol=0.0, equal_nan=True)
        elif name == "matrix":
            assert np.array_equal(found, wanted)
        elif name != "reserved" and wanted.dtype.kind != "S":
            assert found.tobytes() == wanted.tobytes()


def test_a_video_without_a_place_is_on_offer_all_the_same() -> None:
    content = VideoMetaList(np.zeros(2, VideoMetaList.DTYPE))
    content.elements["matrix"][0] = np.array([np.nan, np.inf, 0, 1e38] * 3)
    content.elements["name"] = [b"lost", b"found"]
    lost, found = published(content).videos
    assert (lost.name, found.name) == ("lost", "found")
    assert all(np.isnan(lost.direction))
    assert found.direction == IDENTITY


def test_an_image_golden() -> None:
    content = ImageMetaList(np.zeros(1, ImageMetaList.DTYPE))
    element = content.elements[0]
    element["name"], element["device_name"], element["modality"] = b"n\x00junk", b"d" * 20, b"CT"
    element["patient_name"], element["patient_id"] = "é".encode(), b"\xff"
    element["ticks"], element["size"], element["scalar_type"] = 5 << 32 | 0x80000000, (1, 2, 3), 5
    (image,) = published(content).images
    assert image == ImageMeta("n", "d" * 20, "CT", "é", "\ufffd", 5_500_000_000, (1, 2, 3), 5)


def test_a_label_golden() -> None:
    content = LabelMetaList(np.zeros(1, LabelMetaList.DTYPE))
    element = content.elements[0]
    element["name"], element["device_name"], element["owner"] = b"n", b"d", b"o"
    element["label"], element["rgba"], element["size"] = 9, (1, 2, 3, 4), (5, 6, 7)
    assert published(content).labels == (LabelMeta("n", "d", 9, (1, 2, 3, 4), (5, 6, 7), "o"),)


@pytest.mark.parametrize(("lengths", "unit"), [(LengthUnits(), 1000), (LengthUnits("mm", "mm"), 1)])
def test_a_video_golden(lengths: LengthUnits, unit: float) -> None:
    content = VideoMetaList(np.zeros(1, VideoMetaList.DTYPE))
    element = content.elements[0]
    element["name"], element["device_name"], element["patient_name"], element["patient_id"] = b"n", b"d", b"p", b"i"
    element["zoom_level"], element["focal_length"], element["scalar_type"] = -2, 35.0, 3
    element["size"], element["matrix"] = (4, 5, 6), (0, 2, 0, -0.5, 0, 0, 0, 0, 3, 10, -20, 30)
    message = published(content, ToRosContext("Device", 7, "base", "", lengths, metadata=ITEMS))
    assert message.videos == (
        VideoMeta(
            *("n", "d", "p", "i", -2, 35.0 / unit, (4, 5, 6), (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
            spacing=(2.0 / unit, 0.5 / unit, 3.0 / unit),
            center=(10.0 / unit, -20.0 / unit, 30.0 / unit),
            scalar_type=3,
        ),
    )
    assert sent(message, VideoMetaList, lengths=lengths) == content


@pytest.mark.parametrize("place", [0, 9])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e300])
def test_a_video_that_is_nowhere_is_not_sent(place: int, bad: float) -> None:
    content = VideoMetaList(np.zeros(1, VideoMetaList.DTYPE))
    content.elements["matrix"] = np.arange(1, 13)
    message = published(content)
    (video,) = message.videos
    fields = {name: getattr(video, name) for name in VideoMeta.__slots__}
    fields |= {"spacing": (bad, 1.0, 1.0)} if place == 0 else {"center": (bad, 0.0, 0.0)}
    with pytest.raises(ConversionError, match=r"found .* expected finite numbers"):
        sent(igtl_msgs.VideoMetaList(HEADER, (VideoMeta(**fields),)), VideoMetaList)


@pytest.mark.parametrize(
    ("kind", "message", "field", "kept"),
    [
        (ImageMetaList, lambda text: ImageMeta(text, "", "", "", "", 0, (0, 0, 0), 0), "name", 63),
        (ImageMetaList, lambda text: ImageMeta("", text, "", "", "", 0, (0, 0, 0), 0), "device_name", 19),
        (ImageMetaList, lambda text: ImageMeta("", "", text, "", "", 0, (0, 0, 0), 0), "modality", 31),
        (LabelMetaList, lambda text: LabelMeta("", "", 0, (0, 0, 0, 0), (0, 0, 0), text), "owner", 19),
    ],
)
def test_texts_are_cut_between_characters_and_it_is_told(kind: Any, message: Any, field: str, kept: int) -> None:
    holder: Any = igtl_msgs.ImageMetaList if kind is ImageMetaList else igtl_msgs.LabelMetaList

    def bytes_of(text: str, warnings: list[str]) -> bytes:
        (value,) = sent(holder(HEADER, (message(text),)), kind, warnings).elements[field].tolist()
        assert isinstance(value, bytes)
        return value

    assert bytes_of("x" * kept, []) == b"x" * kept
    assert bytes_of("x" * (kept + 1), ["text_cut"]) == b"x" * kept
    assert bytes_of("x" * (kept - 1) + "é", ["text_cut"]) == b"x" * (kept - 1)
    assert bytes_of("a\x00b", ["text_cut"]) == b"a"


@pytest.mark.parametrize("ns", [0, 1, 2**31 * 10**9, 4_000_000_000 * 10**9 + 123_456_789])
def test_the_time_of_a_scan_beyond_2038_survives_the_signed_seconds_of_ros(ns: int) -> None:
    content = ImageMetaList(np.zeros(1, ImageMetaList.DTYPE))
    content.elements["ticks"] = ns_to_ticks(ns)
    assert sent(published(content), ImageMetaList) == content


# -- COLORT ------------------------------------------------------------------------------------------------------------


@table("index_type", ENTRIES)
@table("map_type", MAPS)
@table("big", [False, True])
def test_colour_tables(index_type: int, map_type: int, big: bool) -> None:
    kind, values = MAPS[map_type]
    wanted = (np.arange(ENTRIES[index_type] * values) % 65_521).astype(kind)
    table = wanted.astype(wanted.dtype.newbyteorder(">" if big else "<")).tobytes()
    message = igtl_msgs.ColorTable(HEADER, index_type, map_type, big, table, ITEMS)
    content = sent(igtl_msgs.ColorTable.unpack(message.pack()), ColorTable)
    assert content.array.reshape(-1).tolist() == wanted.tolist()
    assert sent(published(content), ColorTable) == content


@pytest.mark.parametrize(
    ("index_type", "map_type", "size"), [(4, 3, 256), (3, 4, 256), (3, 3, 255), (3, 5, 511), (5, 19, 65536)]
)
def test_colour_tables_that_contradict_themselves_are_refused(index_type: int, map_type: int, size: int) -> None:
    with pytest.raises(ConversionError, match=r"igtl_msgs/msg/ColorTable: .*found .* expected"):
        sent(igtl_msgs.ColorTable(HEADER, index_type, map_type, False, bytes(size)), ColorTable)


# -- CAPABILITY and BIND -----------------------------------------------------------------------------------------------


@given(st.lists(texts.filter(lambda text: len(text.encode()) <= 12), max_size=3))
def test_capabilities_there_and_back(types: list[str]) -> None:
    content = Capability(tuple(types))
    assert published(content).types == tuple(types)
    assert sent(published(content), Capability) == content


def test_a_type_name_is_not_cut() -> None:
    assert sent(igtl_msgs.Capability(HEADER, ("GET_POLYDATA",)), Capability).types == ("GET_POLYDATA",)
    for message, kind in (
        (igtl_msgs.Capability(HEADER, ("GET_POLYDATAX",)), Capability),
        (igtl_msgs.Bind(HEADER, (BoundMessage("GET_POLYDATAX", "", b""),)), Bind),
    ):
        with pytest.raises(ConversionError, match="found the type 'GET_POLYDATAX', expected at most 12 bytes"):
            sent(message, kind)


def test_the_contents_of_bound_messages_are_not_copied() -> None:
    tool = join(TrackingData(np.ones(1, TrackingData.DTYPE)).pack())
    content = Bind(
        (BindChild("TDATA", "Tracker é", tool), BindChild("CUSTOM", "", b"abc"), BindChild("STATUS", "x" * 20, b""))
    )
    message = lists.bind_to_ros(content, TO)
    assert message.children[0].content is tool
    assert [(child.type, child.name) for child in published(content).children] == [
        ("TDATA", "Tracker é"),
        ("CUSTOM", ""),
        ("STATUS", "x" * 20),
    ]
    assert sent(published(content), Bind) == content


def test_names_of_bound_messages_are_cut_to_what_readers_hold() -> None:
    message = igtl_msgs.Bind(HEADER, (BoundMessage("A", "x" * 21, b""), BoundMessage("B", "a\x00b", b"")))
    assert [child.name for child in sent(message, Bind, ["text_cut"]).children] == ["x" * 20, "a"]
