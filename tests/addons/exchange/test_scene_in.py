"""Scenes of 3D Slicer as sessions: our own, those that Slicer wrote, and those that no program should trust."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.addons.exchange.scene_in import SceneSource
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.base.errors import DamagedRecording, GatewayError, LimitExceeded
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.places import FIXTURES


@pytest.mark.parametrize("to", ["mrb", "mrml"])
def test_our_own_scene_comes_back(tmp_path: Path, to: str) -> None:
    out, back = tmp_path / "scene.mrb", tmp_path / "back.mcap"
    with SessionFile.open(FIXTURES / "ultrasound.mcap") as file:
        export_to(to, file, out, ())
    assert main(["import", str(out if to == "mrb" else next(out.glob("*.mrml"))), "-o", str(back)]) == 0
    with igtl_gateway.open(FIXTURES / "ultrasound.mcap") as old, igtl_gateway.open(back) as new:
        for key in ("TRANSFORM/ProbeToTracker", "TRANSFORM/ReferenceToTracker"):
            one, two = old[key].poses(), new[key].poses()
            assert np.array_equal(one.matrices, two.matrices)
            assert np.abs(one.stamps - two.stamps).max() <= NS_PER_MS
        images, again = old["IMAGE/Image_Probe"].images(), new["IMAGE/Image_Probe"].images()
        assert len(images) == len(again)
        for a, b in zip(images, again, strict=True):
            assert np.array_equal(a.array, b.array)
            assert a.matrix is not None
            assert b.matrix is not None
            assert np.abs(a.matrix - b.matrix).max() < 1e-4
        assert [message.content.text for message in new["STRING/Sweep"].messages()] == [
            message.content.text for message in old["STRING/Sweep"].messages()
        ]


def test_points_and_coloured_pictures_come_back(tmp_path: Path) -> None:
    out, back = tmp_path / "scene.mrb", tmp_path / "back.mcap"
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        export_to("mrb", file, out, ())
    assert main(["import", str(out), "-o", str(back)]) == 0
    with igtl_gateway.open(FIXTURES / "star.mcap") as old, igtl_gateway.open(back) as new:
        one, two = old["in:POINT/PlanPoints"].points()[0], new["POINT/PlanPoints"].points()[0]
        assert np.array_equal(one.xyz, two.xyz)
        assert one.names == two.names
        stamps = new["IMAGE/star/camera/image"].stamps
        assert np.abs(np.diff(stamps) - 1_000_000_000).max() < 20 * NS_PER_MS
        assert np.array_equal(
            new["IMAGE/star/camera/image"].images()[3].array, old["/star/camera/image"].images()[3].array
        )


BY_SLICER = """
import sys, numpy as np, slicer, vtk
from vtk.util.numpy_support import numpy_to_vtk
scene, logic = slicer.vtkMRMLScene(), slicer.vtkSlicerSequencesLogic()
scene.RegisterNodeClass(slicer.vtkMRMLMarkupsJsonStorageNode())
logic.SetMRMLScene(scene)
cache, data = slicer.vtkCacheManager(), slicer.vtkDataIOManager()
cache.SetRemoteCacheDirectory(sys.argv[2]); data.SetCacheManager(cache)
scene.SetCacheManager(cache); scene.SetDataIOManager(data)
browser = scene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "Browser")
def sequence(name):
    node = scene.AddNewNodeByClass("vtkMRMLSequenceNode", name)
    node.SetIndexName("time"); node.SetIndexUnit("s")
    return node
tool, words, pictures = sequence("Tool"), sequence("Words"), sequence("Pictures")
for n in range(5):
    moved = slicer.vtkMRMLLinearTransformNode(); matrix = vtk.vtkMatrix4x4(); matrix.SetElement(0, 3, 10.0 * n)
    moved.SetMatrixTransformToParent(matrix); tool.SetDataNodeAtValue(moved, "%.3f" % (n * 0.1))
    text = slicer.vtkMRMLTextNode(); text.SetText("line %d\\nnext" % n)
    words.SetDataNodeAtValue(text, "%.3f" % (n * 0.1))
    image = vtk.vtkImageData(); image.SetDimensions(4, 3, 1)
    image.GetPointData().SetScalars(numpy_to_vtk(np.full(12, n + 1, np.uint8), deep=1))
    volume = slicer.vtkMRMLScalarVolumeNode(); volume.SetAndObserveImageData(image); volume.SetSpacing(0.5, 0.5, 1)
    pictures.SetDataNodeAtValue(volume, "%.3f" % (n * 0.1))
browser.SetAndObserveMasterSequenceNodeID(tool.GetID())
for node in (words, pictures):
    browser.AddSynchronizedSequenceNode(node)
logic.UpdateProxyNodesFromSequences(browser)
marks = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "Landmarks")
marks.AddControlPoint([1.0, 2.0, 3.0], "nose"); marks.AddControlPoint([-4.0, 5.0, 6.5], "ear")
plain = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "RegToTracker")
matrix = vtk.vtkMatrix4x4(); matrix.SetElement(1, 3, 7.25); plain.SetMatrixTransformToParent(matrix)
for node in (tool, words, pictures, marks):
    node.AddDefaultStorageNode()
assert scene.WriteToMRB(sys.argv[1], None)
"""


@pytest.mark.skipif(find_spec("slicer") is None, reason="slicer-core is not installed")
def test_a_scene_that_slicer_wrote(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    scene, back = tmp_path / "slicer.mrb", tmp_path / "back.mcap"
    command = [sys.executable, "-c", BY_SLICER, str(scene), str(tmp_path / "cache")]
    subprocess.run(command, check=True, timeout=300, capture_output=True)
    assert main(["import", str(scene), "-o", str(back), "--epoch", "2026-01-01T00:00:00Z"]) == 0
    with igtl_gateway.open(back) as session:
        poses = session["TRANSFORM/Tool"].poses()
        assert poses.positions[:, 0].tolist() == [0, 10, 20, 30, 40]
        assert ((poses.stamps - poses.stamps[0]) // NS_PER_MS).tolist() == [0, 100, 200, 300, 400]
        assert [int(view.array.ravel()[0]) for view in session["IMAGE/Pictures"].images()] == [1, 2, 3, 4, 5]
        assert session["IMAGE/Pictures"].images()[0].spacing == (0.5, 0.5, 1.0)
        assert next(session["STRING/Words"].messages()).content.text == "line 0\nnext"
        points = session["POINT/Landmarks"].points()[0]
        assert points.xyz.tolist() == [[1, 2, 3], [-4, 5, 6.5]]
        assert points.names == ("nose", "ear")
        assert session["TRANSFORM/RegToTracker"].poses().positions[0].tolist() == [0, 7.25, 0]


# -- what no program should trust


def bundle(path: Path, document: str, more: dict[str, bytes] | None = None) -> Path:
    with zipfile.ZipFile(path, "w") as out:
        out.writestr("S/S.mrml", document)
        for name, data in (more or {}).items():
            out.writestr(name, data)
    return path


def mrml(inner: str) -> str:
    return f'<?xml version="1.0"?>\n<MRML version="Slicer5">\n{inner}\n</MRML>\n'


def pose(name: str = "T", matrix: str = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1") -> str:
    return f'<LinearTransform id="t1" name="{name}" matrixTransformToParent="{matrix}"></LinearTransform>'


def stored(name: str) -> str:
    return (
        '<Sequence id="s1" name="Q" references="storage:k1;" indexUnit="s" indexType="numeric"></Sequence>'
        f'<LinearTransformSequenceStorage id="k1" name="K" fileName="{name}"></LinearTransformSequenceStorage>'
    )


def twice(path: Path) -> Path:
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "w") as out:
        out.writestr("S/S.mrml", mrml(pose()))
        out.writestr("S/S.mrml", mrml(pose()))
    return path


def cut(path: Path) -> Path:
    bundle(path, mrml(pose()))
    path.write_bytes(path.read_bytes()[:-30])
    return path


def lying(path: Path) -> Path:
    """A stored file whose head declares another size than it has."""
    bundle(path, mrml(stored("Data/a.seq.mha")), {"S/Data/a.seq.mha": b"x" * 64})
    data = bytearray(path.read_bytes())
    at = data.rindex(b"PK\x01\x02")
    data[at + 24 : at + 28] = (1 << 20).to_bytes(4, "little")
    path.write_bytes(data)
    return path


def bomb(path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("S/S.mrml", mrml(stored("Data/a.seq.mha")))
        out.writestr("S/Data/a.seq.mha", bytes(80 << 20))
    return path


ENTITIES = '<?xml version="1.0"?><!DOCTYPE MRML [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><MRML>&b;</MRML>'


def garbled(path: Path) -> Path:
    """A bundle with one byte of a file changed."""
    bundle(path, mrml(stored("Data/a.seq.mha")), {"S/Data/a.seq.mha": b"x" * 64})
    path.write_bytes(path.read_bytes().replace(b"xxxx", b"xyxx", 1))
    return path


def pixels(name: str) -> Callable[[Path], Path]:
    """A bundle whose pictures have their pixels in another file."""
    node = stored("Data/v.seq.nhdr").replace("LinearTransformSequence", "VolumeSequence")
    header = f"NRRD0005\ntype: uchar\ndimension: 3\nsizes: 1 1 1\nencoding: raw\ndata file: {name}\n"
    return lambda path: bundle(path, mrml(node), {"S/Data/v.seq.nhdr": header.encode()})


HUGE = "1 0 0 1e300 0 1 0 0 0 0 1 0 0 0 0 1"
BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "not a zip": (cut, "zip"),
    "a damaged file": (garbled, "S/Data/a.seq.mha: found a damaged zip (Bad CRC-32"),
    "pixels that are missing": (pixels("w.raw"), "v.seq.nhdr: found 'w.raw' as its file of pixels, expected a file"),
    "pixels that are the header": (pixels("v.seq.nhdr"), "found 'v.seq.nhdr' as its file of pixels, expected a file"),
    "a name twice": (twice, "twice"),
    "a size that lies": (lying, "stored in"),
    "a bomb": (bomb, "ratio"),
    "entities": (lambda path: bundle(path, ENTITIES), "found a document type"),
    "another document": (lambda path: bundle(path, "<html></html>"), "expected <MRML>"),
    "no scene": (lambda path: bundle(path, mrml("")), "found no poses"),
    "a path that leaves": (lambda path: bundle(path, mrml(stored("../../etc/passwd"))), "below the folder"),
    "an absolute path": (lambda path: bundle(path, mrml(stored("/etc/passwd"))), "below the folder"),
    "a name in the zip that leaves": (
        lambda path: bundle(path, mrml(pose()), {"../out.txt": b"x"}),
        "below the folder",
    ),
    "a file that is missing": (lambda path: bundle(path, mrml(stored("Data/no.seq.mha"))), "found no 'S/Data/no"),
    "a matrix of words": (lambda path: bundle(path, mrml(pose(matrix="a b"))), "16 numbers"),
    "broken xml": (lambda path: bundle(path, "<MRML><a>"), "invalid XML: no element found, expected a whole document"),
    "a matrix with another last row": (
        lambda path: bundle(path, mrml(pose(matrix="1 " * 16))),
        "its last row is not 0 0 0 1",
    ),
    "a matrix of NaN": (lambda path: bundle(path, mrml(pose(matrix="nan " * 16))), "(not finite, or beyond float32)"),
    "a matrix beyond float32": (lambda path: bundle(path, mrml(pose(matrix=HUGE))), "(not finite, or beyond float32)"),
    "two scenes": (lambda path: bundle(path, mrml(pose()), {"S/T.mrml": b"<MRML/>"}), "found 2 scenes"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_scenes_are_refused_with_place_found_and_expected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    made, words = BAD[name]
    path = made(tmp_path / "bad.mrb")
    out = tmp_path / "out.mcap"
    assert main(["import", str(path), "-o", str(out)]) != 0
    said = capsys.readouterr()
    text = said.err + said.out
    assert words in text, text
    assert str(path) in text
    assert "Traceback" not in text
    assert not out.exists()
    assert not (tmp_path.parent / "out.txt").exists()


KNOWN = ("Slicer4.4.0", "Slicer5.13.0-2026", "slicer-core-5.13.1.0", "5.8")


@pytest.mark.parametrize("version", [*KNOWN, "Slicer99", "Slicer5.14.0", "Holo"])
def test_a_version_that_is_not_known_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str], version: str) -> None:
    path = bundle(tmp_path / "v.mrb", mrml(pose()).replace("Slicer5", version))
    assert main(["import", str(path), "-o", str(tmp_path / "v.mcap")]) == 0
    text = capsys.readouterr().out
    assert (f"found the version '{version}', known are those up to Slicer5.13" not in text) == (version in KNOWN)


def test_a_link_out_of_the_folder_of_a_scene_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene" / "Data").mkdir(parents=True)
    (tmp_path / "secret.seq.mha").write_text("x")
    (tmp_path / "scene" / "Data" / "a.seq.mha").symlink_to(tmp_path / "secret.seq.mha")
    document = tmp_path / "scene" / "scene.mrml"
    document.write_text(mrml(stored("Data/a.seq.mha")))
    with pytest.raises(DamagedRecording, match="a link out of the folder"):
        SceneSource(document)


def test_a_document_is_bounded(tmp_path: Path) -> None:
    path = bundle(tmp_path / "many.mrb", mrml(pose() * 50))
    with limits_in_force(FileLimits(count=20)), pytest.raises(LimitExceeded):
        SceneSource(path)


def test_a_point_without_a_position_is_left_out(tmp_path: Path) -> None:
    node = (
        '<MarkupsFiducial id="m1" name="M" references="storage:k1;"></MarkupsFiducial>'
        '<MarkupsJsonStorage id="k1" name="K" fileName="m.mrk.json"></MarkupsJsonStorage>'
    )
    controls = [{"position": [1, 2, 3]}, {"position": [0, 0, 0], "positionStatus": "undefined"}]
    content = {"markups": [{"type": "Fiducial", "coordinateSystem": "RAS", "controlPoints": controls}]}
    path = bundle(tmp_path / "m.mrb", mrml(node), {"S/m.mrk.json": json.dumps(content).encode()})
    assert main(["import", str(path), "-o", str(tmp_path / "m.mcap")]) == 0
    with igtl_gateway.open(tmp_path / "m.mcap") as session:
        assert session["POINT/M"].points()[0].xyz.tolist() == [[1, 2, 3]]


def kept(inner: str, values: list[str]) -> dict[str, bytes]:
    """A scene in the scene, and the nodes of sequences that name it."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as out:
        out.writestr("w/w.mrml", mrml(inner))
    nodes = '<SequenceStorage id="k1" name="K" fileName="w.seq.mrb"></SequenceStorage>' + "".join(
        f'<Sequence id="s{at}" name="Q{at}" references="storage:k1;" indexUnit="s" indexType="numeric" '
        f'indexValues="{each}"></Sequence>'
        for at, each in enumerate(values)
    )
    return {"nodes": nodes.encode(), "S/w.seq.mrb": data.getvalue()}


WORD = '<Text id="w1" name="W" text="x"></Text>'


def test_what_multiplies_in_a_scene_is_refused(tmp_path: Path) -> None:
    """One item at many times, one file in many sequences, many documents, and many small bombs."""
    made = kept(WORD, ["w1:0; w1:1;"])
    path = bundle(tmp_path / "two.mrb", mrml(made.pop("nodes").decode()), made)
    with pytest.raises(DamagedRecording, match="'w1' at two indexes, expected one"):
        SceneSource(path)
    made = kept(WORD + "<A/>" * 5000, ["w1:0;"] * 100)
    path = bundle(tmp_path / "many.mrb", mrml(made.pop("nodes").decode()), made)
    source = SceneSource(path)
    assert len(source._inner) == 1, "one file is read once"
    source.close()
    with limits_in_force(FileLimits(fields=99)), pytest.raises(LimitExceeded, match="sequences: found 100"):
        SceneSource(path)
    with limits_in_force(FileLimits(free=60_000)), pytest.raises(LimitExceeded, match="bytes of the documents"):
        SceneSource(path)
    path = bundle(tmp_path / "still.mrb", mrml(pose() + "".join(pose().replace("t1", f"t{n}") for n in range(2, 32))))
    with limits_in_force(FileLimits(topics=30)), pytest.raises(LimitExceeded, match="no sequence moves: found 31"):
        SceneSource(path)
    with zipfile.ZipFile(tmp_path / "bombs.mrb", "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("S/S.mrml", mrml(pose()))
        for number in range(4):
            out.writestr(f"S/{number}", bytes(20 << 20))
    with pytest.raises(LimitExceeded, match="unpacked bytes of all files"):
        SceneSource(tmp_path / "bombs.mrb")


def test_markups_of_another_shape_are_refused(tmp_path: Path) -> None:
    node = (
        '<MarkupsFiducial id="m1" name="M" references="storage:k1;"></MarkupsFiducial>'
        '<MarkupsJsonStorage id="k1" name="K" fileName="Data/m.mrk.json"></MarkupsJsonStorage>'
    )
    point = {"position": [1, 2]}, {"position": [1, 2, float("nan")]}, {"position": [1, 1e300, 2]}
    bad: tuple[object, ...] = (
        {"markups": []},
        *({"markups": [{"type": "Fiducial", "controlPoints": [each]}]} for each in point),
        [1],
    )
    for content in bad:
        path = bundle(tmp_path / "m.mrb", mrml(node), {"S/Data/m.mrk.json": json.dumps(content).encode()})
        source = SceneSource(path)
        with pytest.raises(GatewayError, match=r"m\.mrk\.json: .*found .*expected"):
            list(source.items())
        source.close()


def marks_of(kind: str, *points: list[float]) -> tuple[str, dict[str, bytes]]:
    """A node of markups of a kind, and its file."""
    node = (
        f'<Markups{kind} id="m1" name="{kind}" references="storage:k1;"></Markups{kind}>'
        '<MarkupsJsonStorage id="k1" name="K" fileName="m.mrk.json"></MarkupsJsonStorage>'
    )
    controls = [{"position": each, "label": f"P{at}"} for at, each in enumerate(points)]
    content = {"markups": [{"type": kind, "coordinateSystem": "RAS", "controlPoints": controls}]}
    return node, {"S/m.mrk.json": json.dumps(content).encode()}


@pytest.mark.parametrize(
    ("kind", "stream"),
    [("Line", "TRAJ/Line"), *((kind, f"POINT/{kind}") for kind in ("Angle", "Curve", "ClosedCurve", "Plane", "ROI"))],
)
def test_markups_of_every_kind_are_imported(tmp_path: Path, kind: str, stream: str) -> None:
    node, files = marks_of(kind, [1, 2, 3], [4, 5, 6])
    path = bundle(tmp_path / "m.mrb", mrml(node), files)
    assert main(["import", str(path), "-o", str(tmp_path / "m.mcap")]) == 0
    with igtl_gateway.open(tmp_path / "m.mcap") as session:
        (message,) = session[stream].messages()
    if kind == "Line":
        assert message.content.elements["entry"].tolist() == [[1, 2, 3]]
        assert message.content.elements["target"].tolist() == [[4, 5, 6]]
    else:
        assert message.content.elements["position"].tolist() == [[1, 2, 3], [4, 5, 6]]


def test_what_is_not_imported_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    others = '<Model id="o1" name="Liver"/><Table id="o2" name="Doses"/><Segmentation id="o3" name="Organs"/>'
    path = bundle(tmp_path / "o.mrb", mrml(pose() + others))
    assert main(["import", str(path), "-o", str(tmp_path / "o.mcap")]) == 0
    told = capsys.readouterr().out
    for name, kind, why in (
        ("Liver", "Model", "models are not imported"),
        ("Doses", "Table", "tables are not imported"),
        ("Organs", "Segmentation", "segmentations are not imported"),
    ):
        (line,) = [line for line in told.splitlines() if name in line]
        assert kind in line and why in line
    path = bundle(tmp_path / "only.mrb", mrml(others))
    assert main(["import", str(path), "-o", str(tmp_path / "only.mcap")]) == 2
    assert "found only models, tables, segmentations, expected poses, pictures, points or strings" in (
        capsys.readouterr().err
    )
