"""Clouds: places, colours, points with names."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.canvas import Options
from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.convert.igtl_msgs import LabeledPoint, PointList
from igtl_gateway.convert.rosmsg import Header, PointCloud2, PointField, PointStamped

from .conftest import Draw

HEADER = Header(0, "camera")
FLOAT32, UINT32, FLOAT64, UINT16 = 7, 6, 8, 4


def cloud(
    points: np.ndarray[Any, Any], *, rows: int = 1, pad: int = 0, big: bool = False, dense: bool = True
) -> PointCloud2:
    """Of a structured array of points."""
    ros = {"f4": FLOAT32, "u4": UINT32, "f8": FLOAT64, "u2": UINT16}
    fields, offset, layout = [], 0, []
    for name in points.dtype.names or ():
        kind = points.dtype[name]
        fields.append(PointField(name, offset, ros[kind.str[1:]]))
        layout.append((name, kind.newbyteorder(">" if big else "<")))
        offset += kind.itemsize
    data, columns = points.astype(layout).tobytes(), len(points) // rows
    step = columns * offset
    padded = b"".join(data[row * step : (row + 1) * step] + bytes(pad) for row in range(rows))
    return PointCloud2(HEADER, rows, columns, tuple(fields), big, offset, step + pad, padded, dense)


def points(count: int, **more: Any) -> np.ndarray[Any, Any]:
    """Points along a line, with further fields."""
    values = {axis: np.arange(count, dtype=np.float32) * (number + 1) for number, axis in enumerate("xyz")} | more
    made = np.empty(count, [(name, value.dtype) for name, value in values.items()])
    for name, value in values.items():
        made[name] = value
    return made


@pytest.mark.parametrize("big", [False, True], ids=["little", "big"])
@pytest.mark.parametrize("kind", ["u4", "f4"])
def test_packed_colours(kind: str, big: bool, draw: Draw) -> None:
    words = np.array([0x00FF0000, 0x0000FF00, 0x000000FF, 0x00102030], np.uint32)
    row = draw(cloud(points(4, rgb=words.view(kind)), rows=2, pad=8, big=big)).one("topic")
    assert row["Points3D:colors"] == [0xFF0000FF, 0x00FF00FF, 0x0000FFFF, 0x102030FF]
    assert row["Points3D:positions"] == [[k, 2.0 * k, 3.0 * k] for k in range(4)]
    assert row["CoordinateFrame:frame"] == ["camera"]


def test_alpha_is_that_of_rgba(draw: Draw) -> None:
    row = draw(cloud(points(1, rgba=np.array([0x80112233], np.uint32)))).one("topic")
    assert row["Points3D:colors"] == [0x11223380]


def test_points_without_a_place_are_left_out_with_their_colours(draw: Draw) -> None:
    said = points(3, rgb=np.array([1, 2, 3], np.uint32))
    said["y"][1] = np.nan
    row = draw(cloud(said, dense=True)).one("topic")
    assert row["Points3D:positions"] == [[0.0, 0.0, 0.0], [2.0, 4.0, 6.0]]
    assert row["Points3D:colors"] == [0x1FF, 0x3FF]


def test_a_field_gives_the_colours_where_asked_for(draw: Draw) -> None:
    said = points(300, rgb=np.zeros(300, np.uint32), depth=np.arange(300, dtype=np.float64))
    later = points(300, rgb=np.zeros(300, np.uint32), depth=np.arange(300, dtype=np.float64) + 150)
    drawn = draw(cloud(said), cloud(later), options=Options(colour_by="depth"))
    first, second = (row["Points3D:colors"] for row in drawn.rows("topic"))
    assert len(set(first)) > 100
    assert first[200] == second[50]  # one scale for all clouds: equal numbers, equal colours
    assert any("coloured by depth" in line for line in drawn.log())


def test_intensity_gives_the_colours_where_there_are_none(draw: Draw) -> None:
    row = draw(cloud(points(300, intensity=np.arange(300).astype("u2")))).one("topic")
    assert row["Points3D:colors"][10] != row["Points3D:colors"][290]


def test_a_few_points_are_points_and_many_are_a_cloud(draw: Draw) -> None:
    drawn = draw(("/few", cloud(points(5))), ("/many", cloud(points(5000))))
    assert {topic: shown.what for topic, shown in drawn.view.seen.shown.items()} == {
        "/few": EntityKind.POINTS,
        "/many": EntityKind.CLOUD,
    }


def test_the_box_is_that_of_most_points(draw: Draw) -> None:
    said = points(2000)
    said["x"][7] = 1e6
    shown = draw(cloud(said)).view.seen.shown["/topic"]
    assert shown.high[0] < 2000 < shown.low[0] + 2500


@pytest.mark.parametrize(
    "broken",
    [
        PointCloud2(HEADER, 1, 4, (PointField("x", 0, 7),), False, 4, 16, bytes(16), True),
        PointCloud2(
            HEADER, 1, 9, tuple(PointField(n, 4 * k, 7) for k, n in enumerate("xyz")), False, 12, 12, b"", True
        ),
        PointCloud2(HEADER, 1, 1, tuple(PointField(n, 9, 7) for n in "xyz"), False, 12, 12, bytes(12), True),
    ],
    ids=["fields", "bytes", "offset"],
)
def test_a_cloud_that_is_none_costs_itself(broken: PointCloud2, draw: Draw) -> None:
    drawn = draw(broken, cloud(points(1)))
    assert (drawn.count("topic"), drawn.view.counts.refused) == (2, {"/topic": 1})


def test_an_empty_cloud_is_a_row(draw: Draw) -> None:
    assert draw(cloud(points(0))).one("topic")["Points3D:positions"] == []


def test_points_carry_their_names_colours_and_sizes(draw: Draw) -> None:
    listed = (
        LabeledPoint("Nasion", "g", (255, 128, 0, 255), (0.1, 0.2, 0.3), 0.004, ""),
        LabeledPoint("Inion", "g", (0, 0, 0, 0), (0.4, 0.5, 0.6), 0.0, ""),
    )
    row = draw(PointList(HEADER, listed)).one("topic")
    assert row["Points3D:labels"] == ["Nasion", "Inion"]
    assert row["Points3D:colors"][0] == 0xFF8000FF
    assert row["Points3D:colors"][1] & 0xFF == 0xFF
    assert row["Points3D:radii"][0] == pytest.approx(0.002)
    assert row["Points3D:radii"][1] > 0


def test_a_single_point(draw: Draw) -> None:
    assert draw(PointStamped(HEADER, (1.0, 2.0, 3.0))).one("topic")["Points3D:positions"] == [[1.0, 2.0, 3.0]]
