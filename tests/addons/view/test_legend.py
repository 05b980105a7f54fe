"""Legends: what colours mean, and which side of the patient is where."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.canvas import Options
from igtl_gateway.addons.view.legend import side
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.rosmsg import Header, PointCloud2, PointField

from .conftest import Draw, Drawn

RAS = ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))
LPS = ((-1.0, 0, 0), (0, -1.0, 0), (0, 0, 1.0))
SAGITTAL = ((0, -1.0, 0), (0, 0, -1.0), (1.0, 0, 0))
OBLIQUE = ((0.8, -0.6, 0.0), (0.6, 0.8, 0.0), (0.0, 0.0, -1.0))


def head(*directions: tuple[float, ...]) -> Volume:
    """10 x 20 x 30 voxels of 1 x 2 x 3 mm whose first voxel's centre is at the origin."""
    voxels = np.arange(6000, dtype=np.uint8).tobytes()
    flat = tuple(part for row in directions for part in row)
    return Volume(Header(0, "head"), (10, 20, 30), 3, 1, False, 1, flat, (0.001, 0.002, 0.003), (0.0, 0.0, 0.0), voxels)


def labels(drawn: Drawn, path: str, positions: str) -> dict[str, list[float]]:
    row = drawn.one(path)
    kind = positions.partition(":")[0]
    return dict(zip(row[f"{kind}:labels"], row[positions], strict=True))


@pytest.mark.parametrize(
    ("direction", "letter"),
    [
        ((1, 0, 0), "R"),
        ((-0.9, 0.4, 0.1), "L"),
        ((0, 2, 0), "A"),
        ((0.1, -0.3, 0.2), "P"),
        ((0, 0, 1e-9), "S"),
        ((0, 0.1, -1), "I"),
    ],
)
def test_sides_have_the_letters_of_radiology(direction: tuple[float, ...], letter: str) -> None:
    assert side(np.array(direction)) == letter


@pytest.mark.parametrize(
    ("directions", "left", "right", "top", "bottom"),
    [
        (RAS, "R", "L", "A", "P"),
        (LPS, "R", "L", "A", "P"),
        (OBLIQUE, "R", "L", "A", "P"),
        (SAGITTAL, "A", "P", "S", "I"),
    ],
)
def test_a_slice_is_lettered_on_its_four_sides(
    directions: tuple[tuple[float, ...], ...], left: str, right: str, top: str, bottom: str, draw: Draw
) -> None:
    drawn = draw(head(*directions))
    sides = labels(drawn, "topic/slice/sides", "Points2D:positions")
    assert set(sides) == {left, right, top, bottom}
    assert sides[left][0] < sides[top][0] == sides[bottom][0] < sides[right][0]
    assert sides[top][1] < sides[left][1] == sides[right][1] < sides[bottom][1]


@pytest.mark.parametrize("directions", [RAS, LPS, OBLIQUE, SAGITTAL])
def test_a_volume_is_lettered_on_its_six_faces(directions: tuple[tuple[float, ...], ...], draw: Draw) -> None:
    faces = labels(draw(head(*directions)), "topic/plane/sides", "Points3D:positions")
    assert set(faces) == set("RLAPSI")
    for axis, (positive, negative) in enumerate((("R", "L"), ("A", "P"), ("S", "I"))):
        assert faces[positive][axis] > faces[negative][axis]


def cloud() -> PointCloud2:
    values = np.arange(1200, dtype=np.float32).reshape(300, 4) / 1000
    fields = tuple(PointField(name, 4 * number, 7, 1) for number, name in enumerate(("x", "y", "z", "intensity")))
    return PointCloud2(Header(0, "camera"), 1, 300, fields, False, 16, 4800, values.tobytes(), True)


@pytest.mark.parametrize(("field", "unit"), [("intensity", ""), ("z", " m")])
def test_a_cloud_that_is_coloured_by_numbers_has_a_legend_with_range_and_unit(
    field: str, unit: str, draw: Draw
) -> None:
    drawn = draw(cloud(), cloud(), options=Options(colour_by=field))
    numbers = drawn.one("topic/legend/numbers")["LineStrips3D:labels"]
    assert numbers[0].startswith(f"{field} 0.01")
    assert [float(each.split()[-1 - bool(unit)]) for each in numbers] == pytest.approx([0.015, 0.6, 1.187], abs=0.01)
    assert all(each.endswith(unit) for each in numbers)
    assert len(set(drawn.one("topic/legend")["LineStrips3D:colors"])) == 32
    assert drawn.view.seen.shown["/topic"].scale.startswith(f"{field}: blue 0.01")
    assert drawn.count("topic") == 2
