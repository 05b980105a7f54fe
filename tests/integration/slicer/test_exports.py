"""What 3D Slicer's own storage nodes read of every export for it: places, values, times, poses, points, numbers.

The truth is the recording, by the decoder and the conversions of the gateway; positions are in RAS, millimetres.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.addons.exchange.csv_out import export_csv
from igtl_gateway.addons.exchange.folder import FileNames
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, ROS_KINDS, chosen_entries
from igtl_gateway.addons.exchange.sequence_out import export_sequence
from igtl_gateway.addons.exchange.surface_out import export_ply, export_surface_of, export_vtk
from igtl_gateway.addons.exchange.volume_out import export_nrrd
from igtl_gateway.api.placement import ImagePlacement
from igtl_gateway.base.errors import GatewayError, UnsupportedRecording
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, LPS, RAS, SCALARS, Image
from igtl_gateway.wire.polydata import PolyData
from tests import slicer
from tests.addons.exchange import plus
from tests.addons.exchange.itk import MICROMETRE, OBLIQUE, corners, orientations, orthonormal
from tests.addons.exchange.memory import InMemory, sent
from tests.addons.exchange.test_volume_out import image_of, values_of
from tests.places import ROOT

pytestmark = pytest.mark.slow

FIXTURES = sorted((ROOT / "fixtures").glob("*.mcap"))
#: Files of a stream that are judged: the others differ in values only.
EACH = 3
_FLIPPED = np.array([-1.0, -1.0, 1.0])


@pytest.fixture(name="scene")
def _scene(tmp_path: Path) -> Any:
    return slicer.new_scene(tmp_path / "cache")


def judge_volume(scene: Any, path: Path, image: Image) -> None:
    """Slicer has the voxels of a picture at their places: it turns the slices of a left-handed one round."""
    node = "ScalarVolume" if image.num_components == 1 else "VectorVolume"
    found = slicer.read(scene, node, "VolumeArchetype", path, SingleFile=1)
    voxels = slicer.voxels(found).reshape((*image.dimensions[::-1], -1))
    expected, placed = values_of(image), slicer.ijk_to_ras(found)
    if ImagePlacement.of_image(image):
        indices = np.array([*itertools.product(*((0, count - 1) for count in image.dimensions))], float)
        places = corners(image) * _FLIPPED
        if is_left_handed(image):
            expected = expected[::-1]
            indices[:, 2] = image.dimensions[2] - 1 - indices[:, 2]
        assert np.abs(indices @ placed[:3, :3].T + placed[:3, 3] - places).max() < MICROMETRE, path
    assert np.array_equal(voxels, expected, equal_nan=voxels.dtype.kind == "f"), path
    scene.Clear(True)


def is_left_handed(image: Image) -> bool:
    """Whether the third axis of a picture is opposite to that of a right-handed system."""
    i, j, k = np.array(image.wire_matrix, float).reshape(4, 3)[:3]
    return bool(np.cross(i, j) @ k < 0)


@pytest.mark.parametrize("fixture", FIXTURES, ids=lambda path: path.stem)
def test_slicer_reads_each_exported_image_of_a_fixture(scene: Any, tmp_path: Path, fixture: Path) -> None:
    names, judged = FileNames(), Counter[str]()
    with SessionFile.open(fixture) as file:
        account = export_nrrd(file, tmp_path / "out", ())
        written: set[bool] = set()
        for entry in chosen_entries(file, (*IGTL_KINDS, *ROS_KINDS), (), on_input=lambda _: written.clear()):
            image = image_of(entry)
            if image is None or (written and not entry.kind.is_input):
                continue
            if entry.kind.is_input:
                written.add(True)
            stream = names.of(entry)
            if judged[stream] < EACH:
                judge_volume(scene, sorted((tmp_path / "out").glob(f"{stream}.*.nrrd"))[judged[stream]], image)
            judged[stream] += 1
    assert sum(judged.values()) == account.files


@pytest.mark.parametrize("fixture", FIXTURES, ids=lambda path: path.stem)
@pytest.mark.parametrize(("export", "suffix"), [(export_vtk, "vtk"), (export_ply, "ply")], ids=["vtk", "ply"])
def test_slicer_reads_each_exported_surface_of_a_fixture(
    scene: Any, tmp_path: Path, fixture: Path, export: Any, suffix: str
) -> None:
    from igtl_gateway.addon.reading import recorded_units

    names, judged = FileNames(), Counter[str]()
    with SessionFile.open(fixture) as file:
        account = export(file, tmp_path / "out", ())
        units = recorded_units(file)
        for entry in chosen_entries(file, (*IGTL_KINDS, *ROS_KINDS), ()):
            try:
                content = export_surface_of(entry, units.of(entry.kind, entry.channel, entry.type)).content
            except GatewayError:
                continue
            stream = names.of(entry)
            paths = sorted((tmp_path / "out").glob(f"{stream}.*.{suffix}"))
            if judged[stream] < EACH and len(content.points):
                judge_model(scene, paths[judged[stream]], content)
            judged[stream] += 1
    assert sum(judged.values()) == account.files


_CORNERS = np.array([[10.0, 20.0, 30.0], [40.0, 20.0, 30.0], [10.0, 60.0, 30.0]])
_SPACED = "\n".join(" ".join(map(str, each)) for each in _CORNERS.tolist())
_ARRAY = '<DataArray type="{}" Name="{}" NumberOfComponents="{}" format="ascii">{}</DataArray>'
_TEXT = _ARRAY.replace("Components", "Tuples")
_SPACE_OF_VTP = f"<FieldData>{_TEXT.format('String', 'SPACE', 1, '82 65 83 0')}</FieldData>"
#: Suffix → a file of other programs, and what states its space, at "@".
OF_OTHERS = {
    "vtk": (
        f"# vtk DataFile Version 3.0\n@\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n{_SPACED}\nPOLYGONS 1 4\n3 0 1 2\n",
        "SPACE=RAS",
    ),
    "ply": (
        "ply\nformat ascii 1.0\n@element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n{_SPACED}\n3 0 1 2\n",
        "comment SPACE=RAS\n",
    ),
    "stl": (
        "solid a@\nfacet normal 0 0 1\nouter loop\nvertex "
        + _SPACED.replace("\n", "\nvertex ")
        + "\nendloop\nendfacet\nendsolid a\n",
        " SPACE=RAS",
    ),
    "obj": ("@v " + _SPACED.replace("\n", "\nv ") + "\nf 1 2 3\n", "# SPACE=RAS\n"),
    "vtp": (
        '<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>@'
        '<Piece NumberOfPoints="3" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" NumberOfPolys="1">'
        f"<Points>{_ARRAY.format('Float32', 'Points', 3, _SPACED)}</Points>"
        f"<Polys>{_ARRAY.format('Int32', 'connectivity', 1, '0 1 2')}"
        f"{_ARRAY.format('Int32', 'offsets', 1, '3')}</Polys></Piece></PolyData></VTKFile>",
        _SPACE_OF_VTP,
    ),
}


@pytest.mark.parametrize("suffix", OF_OTHERS)
def test_a_surface_of_other_programs_is_lps_unless_it_states_its_space(scene: Any, tmp_path: Path, suffix: str) -> None:
    """What the reference of formats states about our points in files of other programs."""
    text, space = OF_OTHERS[suffix]
    stated, silent = tmp_path / f"stated.{suffix}", tmp_path / f"silent.{suffix}"
    stated.write_text(text.replace("@", space), "ascii")
    silent.write_text(text.replace("@", "-" if suffix == "vtk" else ""), "ascii")
    points = slicer.values_of(slicer.read(scene, "Model", "Model", stated).GetPolyData().GetPoints().GetData())
    assert sorted(points.tolist()) == sorted(_CORNERS.tolist())
    with pytest.raises(AssertionError, match="coordinate system information"):
        slicer.read(scene, "Model", "Model", silent)
    turned = slicer.read_with_log(scene, "Model", "Model", silent)[0].GetPolyData().GetPoints().GetData()
    assert sorted(slicer.values_of(turned).tolist()) == sorted((_CORNERS * _FLIPPED).tolist())


def judge_model(scene: Any, path: Path, content: PolyData) -> None:
    """Slicer has the points in RAS, and in a VTK file the cells and attributes."""
    data = slicer.read(scene, "Model", "Model", path).GetPolyData()
    assert np.array_equal(slicer.values_of(data.GetPoints().GetData()), content.points), path
    assert data.GetNumberOfPolys() == content.polygons.count, path
    if path.suffix == ".vtk":
        assert data.GetNumberOfCells() == sum(cells.count for cells in content.cells), path
    scene.Clear(True)


@pytest.mark.parametrize("fixture", FIXTURES, ids=lambda path: path.stem)
def test_slicer_reads_each_exported_table_of_a_fixture(scene: Any, tmp_path: Path, fixture: Path) -> None:
    with SessionFile.open(fixture) as file:
        export_csv(file, tmp_path / "out", ())
    for path in sorted((tmp_path / "out").iterdir()):
        with path.open(encoding="utf-8", newline="") as stream:
            header, *rows = csv.reader(stream)
        if any(set(cell) & set('"\n\r') for row in rows for cell in row):
            continue  # VTK takes doubled quotes and breaks in a quoted cell for its end (docs/how-to/slicer.md)
        found = slicer.read(scene, "Table", "Table", path).GetTable()
        assert [found.GetColumnName(column) for column in range(found.GetNumberOfColumns())] == header, path
        assert found.GetNumberOfRows() == len(rows), path
        for at in {*range(min(EACH, len(rows))), *range(max(0, len(rows) - EACH), len(rows))}:
            cells = [found.GetValue(at, column).ToString() for column in range(len(header))]
            assert cells == rows[at], (path, at)
        scene.Clear(True)


@pytest.mark.parametrize("fixture", ["ultrasound", "star", "lego"])
def test_slicer_reads_each_transform_of_an_exported_sequence(scene: Any, tmp_path: Path, fixture: str) -> None:
    """Slicer reads the first transform of such a file, with times of three decimals, and no status of its items."""
    with SessionFile.open(ROOT / "fixtures" / f"{fixture}.mcap") as file:
        images = sorted({channel.topic for channel in file.channels if channel.type == "IMAGE"})
        for number, stream in enumerate(sorted({each.topic for each in file.channels if each.type == "TRANSFORM"})):
            path = tmp_path / f"{number}.igs.mha"
            try:
                export_sequence(file, path, (*images[:1], stream))
            except UnsupportedRecording:
                continue  # a part of an image
            judge_transforms(scene, path)


def judge_transforms(scene: Any, path: Path) -> None:
    """Slicer has the times and poses of the transform of a sequence."""
    found = plus.read(path)
    frames = [found.frames[number] for number in range(found.count)]
    name = next(key.removesuffix("Status") for key in frames[0] if key.endswith("TransformStatus"))
    sequence = slicer.read(scene, "Sequence", "LinearTransformSequence", path)
    assert (sequence.GetIndexName(), sequence.GetIndexUnit()) == ("time", "s")
    # times of one millisecond are one item
    assert len(slicer.items(sequence)) == len({f"{float(fields['Timestamp']):.3f}" for fields in frames}), path
    for index, node in slicer.items(sequence):
        fields = min(frames, key=lambda each: abs(float(each["Timestamp"]) - float(index)))
        assert abs(float(fields["Timestamp"]) - float(index)) < 0.0006, path
        if fields[f"{name}Status"] == "OK":
            expected = np.array(fields[name].split(), float).reshape(4, 4)
            assert np.abs(slicer.to_parent(node) - expected).max() < 1e-6, (path, index)
    scene.Clear(True)


def generated() -> list[Image]:
    """Pictures of every type, byte order, number of components, orientation and anisotropic spacing."""
    random = np.random.default_rng(7)
    placed = [orthonormal(turned) for turned in (OBLIQUE, *orientations()[:48:5])]
    found = []
    for number, (scalar, components) in enumerate(
        [*((scalar, 1) for scalar in SCALARS), (3, 3), (3, 4), (10, 3), (4, 2)]
    ):
        size = [(5, 4, 3), (7, 1, 2), (6, 5, 1)][number % 3]
        for order in (LITTLE_ENDIAN, BIG_ENDIAN):
            dtype = np.dtype(SCALARS[scalar]).newbyteorder(">" if order == BIG_ENDIAN else "<")
            count = math.prod(size) * components
            values = random.integers(0, 120, count).astype(dtype)
            spacing = np.array([0.5, 1.25, 3.0])
            axes = (placed[number % len(placed)] * spacing).T
            matrix = (*axes.ravel().tolist(), 12.5, -70.25, 31.0)
            coordinate = (RAS, LPS)[number % 2]
            found.append(Image(size, scalar, values.tobytes(), components, order, coordinate, matrix))
    return found


def test_slicer_reads_pictures_of_every_kind(scene: Any, tmp_path: Path) -> None:
    pictures = generated()
    items = [sent(100 * number, "Scan", "IMAGE", picture) for number, picture in enumerate(pictures)]
    account = export_nrrd(InMemory(items), tmp_path / "out", ())
    paths = sorted((tmp_path / "out").iterdir())
    assert len(paths) == len(pictures) == account.files
    for path, picture in zip(paths, pictures, strict=True):
        judge_volume(scene, path, picture)
