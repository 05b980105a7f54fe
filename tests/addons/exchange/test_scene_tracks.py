"""Tracks of a scene: which messages are kept, their indexes, headers that an NRRD reader reads, bundles of items."""

from __future__ import annotations

import io
import zipfile
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addon.igtl import Image
from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addons.exchange.scene_tracks import (
    ItemTrack,
    Pace,
    PictureTrack,
    PoseTrack,
    Track,
    index_text,
    picture_header,
)
from tests.tables import table

S, MS = 1_000_000_000, 1_000_000


# -- what is kept -----------------------------------------------------------------------------------------------------


@table(
    ("rate", "count", "most", "span_ns", "period_ns"),
    [
        (0.0, 10, 10, S, 0),
        (0.0, 11, 10, S, S // 10),
        (0.0, 11, 3, S, 333_333_334),  # rounded up, so that there are at most three
        (20.0, 11, 10, S, S // 20),
        (20.0, 1, 10, S, S // 20),
        (1e12, 1, 10, S, 1),
    ],
)
def test_the_pace_of_a_stream(rate: float, count: int, most: int, span_ns: int, period_ns: int) -> None:
    assert Pace.of(rate, count, most, span_ns).period_ns == period_ns


@given(st.lists(st.integers(0, 10**10), min_size=1, max_size=60), st.integers(1, 9))
def test_a_thinned_stream_has_at_most_its_number(times: list[int], most: int) -> None:
    times.sort()
    pace = Pace.of(0.0, len(times), most, times[-1] - times[0] + 1)
    kept = [time_ns for time_ns in times if pace.passes(time_ns)]
    assert kept[0] == times[0]
    if len(times) <= most:
        assert kept == times
    else:
        assert len(kept) <= most + 1  # periods begin at multiples, not at the first message
        assert len({time_ns // pace.period_ns for time_ns in times}) == len(kept), "the first of each period"


def test_why_a_message_is_left_out() -> None:
    assert Pace(50 * MS).why == "thinned to 20 Hz, the first of each 50 ms"
    assert [Pace(0).passes(5)] * 3 == [True] * 3


# -- indexes ----------------------------------------------------------------------------------------------------------


def track(*times_ns: int) -> Track:
    made = Track("in:TRANSFORM/Tool", "TRANSFORM", "Tool")
    for time_ns in times_ns:
        made.add_time(Entry(1, time_ns, Kind.IGTL_IN, source_ns=time_ns + 3), 0)
    return made


@table(
    ("times_ns", "order", "ms", "lost"),
    [
        ([S, S + 20 * MS], [0, 1], [0, 20], 0),
        ([S + MS // 2 - 1, S + MS // 2], [0, 1], [0, 1], 0),  # rounded to the nearest
        ([S, S + 1, S + 2], [2], [0], 2),  # of one millisecond, the last counts
        ([S + 40 * MS, S + 20 * MS], [1, 0], [20, 40], 0),  # in the order of time
        ([], [], [], 0),
    ],
)
def test_each_message_has_a_millisecond(times_ns: list[int], order: list[int], ms: list[int], lost: int) -> None:
    made = track(*times_ns)
    assert made.arrange(np.array(times_ns, np.int64), S) == lost
    assert (made.order.tolist(), made.ms.tolist()) == (order, ms)


def test_what_is_from_before_a_part_is_at_its_begin_and_not_counted() -> None:
    times = [2 * S, 3 * S, 9 * S, 9 * S + 5 * MS]
    made = track(*times)
    assert made.carried(9 * S).tolist() == [True, True, False, False]
    assert made.arrange(np.array(times, np.int64), 9 * S, 9 * S) == 0
    assert (made.order.tolist(), made.ms.tolist()) == ([2, 3], [0, 5]), "what is of the part comes before it"
    alone = track(2 * S, 3 * S, 9 * S + 5 * MS)
    assert alone.arrange(np.array([2 * S, 3 * S, 9 * S + 5 * MS], np.int64), 9 * S, 9 * S) == 0
    assert (alone.order.tolist(), alone.ms.tolist()) == ([1, 2], [0, 5]), "the last one from before"


@given(st.lists(st.integers(0, 20 * MS), max_size=30))
def test_indexes_ascend_and_the_sum_closes(times: list[int]) -> None:
    made = track(*times)
    lost = made.arrange(np.array(times, np.int64), 0)
    assert (np.diff(made.ms) > 0).all() and len(made.order) + lost == len(times)
    for number, ms in zip(made.order.tolist(), made.ms.tolist(), strict=True):
        assert abs(times[number] - ms * MS) <= MS // 2


def test_a_track_has_the_stamps_of_its_messages_or_of_their_headers() -> None:
    made = track(S, 2 * S)
    assert made.stream_times().stamps.tolist() == [S + 3, 2 * S + 3]
    made.stamps[1] = 7
    assert made.stream_times().stamps.tolist() == [0, 7] and made.stream_times().times.tolist() == [S, 2 * S]


def test_indexes_as_text() -> None:
    assert [index_text(ms) for ms in (0, 7, 999, 1000, 61_005)] == ["0.000", "0.007", "0.999", "1.000", "61.005"]


def test_poses_lie_one_behind_the_other() -> None:
    made = PoseTrack("a", "TRANSFORM", "a")
    assert made.matrices().shape == (0, 4, 4)
    made.parts += [np.ones((2, 4, 4)), np.zeros((1, 4, 4))]
    assert made.matrices()[:, 0, 0].tolist() == [1.0, 1.0, 0.0]


# -- pictures ---------------------------------------------------------------------------------------------------------

MATRIX = (0.5, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0, 10.0, 20.0, 30.0)


def picture(scalar: int = 3, components: int = 1, matrix: tuple[float, ...] = MATRIX, **more: Any) -> Image:
    size = {2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 4, 10: 4, 11: 8}[scalar]
    return Image((2, 3, 1), scalar, bytes(range(6 * components * size)), components, wire_matrix=matrix, **more)


def pictures(*images: Image) -> PictureTrack:
    made = PictureTrack("a", "IMAGE", "a", stream=io.BytesIO())
    for image in images:
        made.add(image)
    return made


def test_pixels_are_one_behind_the_other() -> None:
    made = pictures(picture(), picture())
    assert isinstance(made.stream, io.BytesIO) and made.stream.getvalue() == bytes(range(6)) * 2
    assert made.frame_bytes == 6 and PictureTrack("a", "IMAGE", "a").frame_bytes == 0


@table(
    "other",
    [picture(5), picture(2), picture(components=3), picture(5, endian=1), picture(coordinate=2)],
)
def test_a_picture_of_another_kind_does_not_fit(other: Image) -> None:
    made = pictures(picture())
    assert made.mismatch(picture(matrix=(1.0,) * 12)) == ""
    assert made.mismatch(other) == "size or pixel type differs from the first one of (2, 3, 1)"
    assert PictureTrack("a", "IMAGE", "a").mismatch(other) == ""


def test_places_of_pictures() -> None:
    """P of the wire is the centre; an invalid matrix has the place of the picture before it."""
    moved = (*MATRIX[:9], 11.0, 20.0, 30.0)
    made = pictures(picture(), picture(matrix=(0.0,) * 12), picture(matrix=moved))
    first, second, third = made.placed()
    assert first[:3, :3].tolist() == [[0.5, 0, 0], [0, 0.25, 0], [0, 0, 1]]
    assert first[:3, 3].tolist() == [9.75, 19.75, 30.0] and first[3].tolist() == [0, 0, 0, 1]
    assert (second == first).all() and third[0, 3] == 10.75
    assert made.moves() and not pictures(picture(), picture()).moves()
    assert (pictures(picture(matrix=(0.0,) * 12)).placed()[0] == np.eye(4)).all()


@table(
    ("scalar", "components", "endian", "numpy_type"),
    [
        (2, 1, 2, "i1"), (3, 1, 1, "u1"), (4, 1, 2, "<i2"), (5, 1, 1, ">u2"), (6, 1, 2, "<i4"), (7, 1, 2, "<u4"),
        (10, 1, 2, "<f4"), (11, 1, 1, ">f8"), (3, 3, 2, "u1"), (3, 4, 2, "u1"), (5, 2, 2, "<u2"),
    ],
)  # fmt: skip
def test_a_reader_of_nrrd_reads_the_pictures(scalar: int, components: int, endian: int, numpy_type: str) -> None:
    nrrd = pytest.importorskip("nrrd", reason="pynrrd is the referee")
    made = pictures(*[picture(scalar, components, endian=endian)] * 2)
    assert isinstance(made.stream, io.BytesIO)
    pixels = made.stream.getvalue()
    stream = io.BytesIO(picture_header(made, made.placed()[0], ["0.000", "0.020"], 2) + pixels)
    header = nrrd.read_header(stream)
    data = nrrd.read_data(header, stream)
    lead = [components] if components > 1 else []
    assert header["sizes"].tolist() == [*lead, 2, 3, 1, 2]
    pixel = {1: [], 3: ["RGB-color"], 4: ["RGBA-color"]}.get(components, ["vector"])
    assert header["kinds"] == [*pixel, "domain", "domain", "domain", "list"]
    assert data.tobytes(order="F") == np.frombuffer(pixels, numpy_type).astype(data.dtype).tobytes()
    assert header["axis 3 index values"] == "0.000 0.020"
    assert np.allclose(header["space origin"], [-9.75, -19.75, 30.0]), "the file is in LPS"


def test_pixels_may_be_in_another_file() -> None:
    made = pictures(picture())
    lines = picture_header(made, np.eye(4), ["0.000"], 1, "a.raw").decode().splitlines()
    assert "data file: a.raw" in lines and "space directions: (-1,0,0) (0,-1,0) (0,0,1) none" in lines
    assert not picture_header(made, np.eye(4), ["0.000"], 1, "a.raw").endswith(b"\n\n")


# -- items ------------------------------------------------------------------------------------------------------------


def items(tag: str = "Model", storage: str = "ModelStorage") -> tuple[ItemTrack, io.BytesIO]:
    stream = io.BytesIO()
    made = ItemTrack(
        "a", "POLYDATA", "a", name="Liver", tag=tag, storage=storage, suffix="vtk", file="Data/Liver.seq.mrb",
        stream=zipfile.ZipFile(stream, "w"), empty=({"e": 1}, b"empty"),
    )  # fmt: skip
    return made, stream


def kept(made: ItemTrack, stream: io.BytesIO, order: list[int], ms: list[int], *, begin_empty: bool = False) -> str:
    made.order, made.ms = np.array(order, np.int64), np.array(ms, np.int64)
    return made.close(begin_empty)


def scene_of(stream: io.BytesIO) -> tuple[ElementTree.Element, dict[str, bytes]]:
    with zipfile.ZipFile(stream) as opened:
        files = {name: opened.read(name) for name in opened.namelist()}
    return ElementTree.fromstring(files.pop("Liver/Liver.mrml")), files


def test_items_are_a_scene_with_a_file_each() -> None:
    made, stream = items()
    for number in range(3):
        made.add({"n": number}, (b"part ", str(number).encode()))
    words = kept(made, stream, [0, 2], [0, 1500])
    root, files = scene_of(stream)
    assert files["Liver/Data/Liver_2.vtk"] == b"part 2"
    nodes = {node.attrib["id"]: node for node in root}
    models = [node for node in root if node.tag == "Model"]
    assert [node.attrib["n"] for node in models] == ["0", "2"]
    assert words == ";".join(f"{node.attrib['id']}:{at}" for node, at in zip(models, ("0.000", "1.500"), strict=True))
    for node, name in zip(models, ("Data/Liver_0.vtk", "Data/Liver_2.vtk"), strict=True):
        storage = nodes[node.attrib["references"].removeprefix("storage:").rstrip(";")]
        assert (storage.attrib["fileName"], storage.attrib["coordinateSystem"]) == (name, "RAS")


def test_before_the_first_item_there_is_an_empty_one() -> None:
    made, stream = items()
    made.add({"n": 0}, (b"x",))
    words = kept(made, stream, [0], [20], begin_empty=True)
    root, files = scene_of(stream)
    assert [word.rpartition(":")[2] for word in words.split(";")] == ["0.000", "0.020"]
    assert files["Liver/Data/Liver_1.vtk"] == b"empty"
    assert [node.attrib.get("e") for node in root if node.tag == "Model"] == ["1", None]


def test_strings_have_no_files() -> None:
    made, stream = items("Text", "")
    made.add({"text": "a"})
    kept(made, stream, [0], [0])
    root, files = scene_of(stream)
    assert files == {} and "references" not in root[0].attrib


def test_lines_have_units_in_their_scene() -> None:
    made, stream = items("MarkupsLine", "")
    made.add({})
    kept(made, stream, [0], [0])
    root, _ = scene_of(stream)
    assert root[0].attrib["id"] == "vtkMRMLSelectionNodeSingleton"


def test_the_extent_of_items() -> None:
    made, _ = items()
    made.see(np.zeros((0, 3)))
    assert np.isinf(made.low).all()
    made.see(np.array([[1.0, 2.0, 3.0], [-1.0, 5.0, 0.0]]))
    made.see(np.array([[0.0, -9.0, 1.0]]))
    assert (made.low.tolist(), made.high.tolist()) == ([-1.0, -9.0, 0.0], [1.0, 5.0, 3.0])
