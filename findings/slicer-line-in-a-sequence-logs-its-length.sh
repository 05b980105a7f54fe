#!/bin/sh
# slicer-core: a line of two points that goes into a sequence logs warnings about its own length.
#
# Expected: no line in the log: the line is complete, and its length is known.
#           Guess before the run: three warnings for each line of two points, none for a line of one point, none for
#           points, a curve or a plane, and none if the measurement of the length is off.
# Found: the guess. Two warnings are that the measurement has no node, one that there is no selection node; one beside the
#        sequence does not help, because a sequence keeps its items in a scene of its own.
# Versions: slicer-core 5.13.31053.0 (3D Slicer without its windows), vtk 9.6.2.
# Concerns: who records or writes needle paths, plans or distances over time: the log grows by lines for each item, and a
#           check of "no warnings" fails on good data.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0
cd "$folder"
cat > run.py <<'PYTHON'
import os
import sys
import tempfile
from importlib.metadata import version

import slicer
import vtk


def lines_of_log(kind, points, measured=True, selection=False):
    """Put one node into a sequence; return the number of lines that are logged meanwhile."""
    scene = slicer.vtkMRMLScene()
    if selection:
        scene.AddNewNodeByClass("vtkMRMLSelectionNode")
    node = scene.AddNewNodeByClass(f"vtkMRMLMarkups{kind}Node")
    for number in range(points):
        node.AddControlPoint(vtk.vtkVector3d(10.0 * number, number * number, 0))
    if not measured:
        node.GetMeasurement("length").SetEnabled(False)
    sequence = scene.AddNewNodeByClass("vtkMRMLSequenceNode")
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as log:
        os.dup2(log.fileno(), 2)
        try:
            sequence.SetDataNodeAtValue(node, "0.000")
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        log.seek(0)
        return [line.split(b"|")[-1].decode().strip() for line in log if b"|" in line]


print("slicer-core", version("slicer-core"))
found = {
    "line of two points": lines_of_log("Line", 2),
    "the same, a selection node beside it": lines_of_log("Line", 2, selection=True),
    "line of one point": lines_of_log("Line", 1),
    "line of two points, length not measured": lines_of_log("Line", 2, measured=False),
    "two landmarks": lines_of_log("Fiducial", 2),
    "curve of four points": lines_of_log("Curve", 4),
}
for name, lines in found.items():
    print(f"{name}: {len(lines)} lines")
    for line in lines:
        print(f"    {line[:150]}")
expected = [3, 3, 0, 0, 0, 0]
sys.exit([len(lines) for lines in found.values()] != expected)
PYTHON
venv/bin/python run.py
