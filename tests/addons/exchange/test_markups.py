"""Markups that are damaged, huge or of other versions; what 3D Slicer writes is in the integration tests."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.exchange.formats import format_of, open_source
from igtl_gateway.addons.exchange.markups import read_markups
from igtl_gateway.base.errors import DamagedRecording, LimitExceeded, UnsupportedRecording
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force

POINT: dict[str, Any] = {"label": "F-1", "position": [1.0, 2.0, 3.0], "positionStatus": "defined"}
FCSV = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z,label\n"


def document(**changed: Any) -> str:
    markup = {
        "type": "Fiducial",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": [POINT],
        **changed,
    }
    return json.dumps({"markups": [markup]})


def point(**changed: Any) -> str:
    return document(controlPoints=[POINT, {**POINT, **changed}])


BAD = [
    ("{", DamagedRecording, "found invalid JSON: .*, expected a whole document"),
    *(
        (
            json.dumps({"@schema": schema, "markups": []}),
            UnsupportedRecording,
            "@schema: found .*, expected markups-schema-v1",
        )
        for schema in ("https://x/markups-schema-v2.0.0.json#", "https://x/markups-schema-v10.0.0.json#", "mine", 7)
    ),
    ('{"markups": 1}', DamagedRecording, "markups: found 1, expected a list"),
    ('{"markups": [1]}', DamagedRecording, "markup 0: found 1, expected an object"),
    (document(type="Spline"), UnsupportedRecording, "type: found 'Spline', expected one of Fiducial"),
    (document(coordinateSystem="ABC"), UnsupportedRecording, "coordinateSystem: found 'ABC', expected LPS or RAS"),
    (document(coordinateUnits="m"), UnsupportedRecording, "coordinateUnits: found 'm', expected mm"),
    (document(controlPoints=None), DamagedRecording, "controlPoints: found nothing, expected a list"),
    (point(position=[1, 2]), DamagedRecording, r"control point 1: position: found \[1, 2\], expected 3 numbers"),
    (point(position=[1, 2, "3"]), DamagedRecording, "control point 1: position: .*expected 3 numbers"),
    (point(position=[1, 2, True]), DamagedRecording, "control point 1: position: .*expected 3 numbers"),
    (point(position=None), DamagedRecording, "control point 1: position: found nothing"),
    (point(position=[1, 2, float("nan")]), DamagedRecording, "control point 1: position: .*expected finite numbers"),
    (point(position=[1, 2, 1e39]), DamagedRecording, "control point 1: position: .*expected finite numbers"),
    (point(label=7), DamagedRecording, "control point 1: label: found 7, expected text"),
    (document(type="ROI", size=[1, 2]), DamagedRecording, r"size: found \[1, 2\], expected 3 numbers"),
]
BAD_TABLES = [
    (FCSV.replace("4.11", "Holo"), "version: found 'Holo', expected 4 or 5"),
    (FCSV.replace("4.11", "slicer-core-9.11"), "version: found 'slicer-core-9.11', expected 4 or 5"),
    (FCSV.replace("4.11", "9.11"), "version: found '9.*', expected 4 or 5"),
    (FCSV + "1,1,2\n", "line 4: found '1,1,2', expected numbers for x, y and z"),
    (FCSV + "1,1,2,x,F\n", "line 4: .*expected numbers"),
    (FCSV + "1,1,2,inf,F\n", "line 4: .*expected finite numbers"),
    (FCSV.replace("LPS", "IJK"), "CoordinateSystem: found 'IJK', expected LPS or RAS"),
    (FCSV.replace("id,x,y,z", "id,r,a,s"), "columns: found id, r, a, s, label, expected x, y and z"),
]


@pytest.mark.parametrize(("text", "error", "match"), BAD)
def test_bad_markups_are_refused_with_their_place(
    tmp_path: Path, text: str, error: type[Exception], match: str
) -> None:
    path = tmp_path / "bad.mrk.json"
    path.write_text(text)
    with pytest.raises(error, match=match) as raised:
        read_markups(path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(("text", "match"), BAD_TABLES)
def test_bad_tables_of_points_are_refused_with_their_place(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "bad.fcsv"
    path.write_text(text)
    with pytest.raises((DamagedRecording, UnsupportedRecording), match=match):
        read_markups(path)


def test_huge_and_deep_markups_meet_the_limits(tmp_path: Path) -> None:
    path = tmp_path / "huge.mrk.json"
    path.write_text('{"markups": ' + "[" * 100_000)
    with pytest.raises(LimitExceeded):
        read_markups(path)
    path.write_text(document(controlPoints=[POINT] * 100))
    with limits_in_force(FileLimits(count=50)), pytest.raises(LimitExceeded):
        read_markups(path)
    path.write_text(FCSV + "1,1,2,3," * 100_000)
    with pytest.raises(LimitExceeded, match="characters of a line"):
        read_markups(path)
    path.write_text(FCSV + "1,1,2,3,F\n" * 100)
    with limits_in_force(FileLimits(count=50)), pytest.raises((LimitExceeded, DamagedRecording)):
        read_markups(path)


def test_several_markups_of_a_file_have_devices_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "A plan with a long name.mrk.json"
    path.write_text(json.dumps({"markups": [json.loads(document())["markups"][0]] * 2}))
    with closing(open_source(path)) as source:
        list(source.items())
    assert [row.stream for row in source.rows] == ["A plan with a long 1", "A plan with a long 2"]


@pytest.mark.parametrize(
    ("name", "start", "what"),
    [
        ("a.vtk", b"# vtk DataFile Version 5.1\n", "a model of VTK, which has no times"),
        ("a.vtp", b'<?xml version="1.0"?>\n<VTKFile type="PolyData">', "a model of VTK, which has no times"),
        ("a.ply", b"ply\nformat ascii 1.0\n", "a model of PLY, which has no times"),
        ("a.stl", b"\0" * 84, "a model of STL, which has no times"),
        ("a.obj", b"v 1 2 3\n", "a model of OBJ, which has no times"),
        ("a.csv", b"a,b\n1,2\n", "a table, which `import` takes by a recipe"),
    ],
)
def test_models_and_tables_are_refused_by_name(tmp_path: Path, name: str, start: bytes, what: str) -> None:
    path = tmp_path / name
    path.write_bytes(start)
    assert format_of(start) is None
    with pytest.raises(UnsupportedRecording, match=f"found {what}"):
        open_source(path)
