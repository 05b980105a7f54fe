#!/bin/sh
# slicer-core: a line break in the label or description of a landmark becomes a further landmark in .fcsv.
#
# Expected: the writer puts such texts into quotes, as it does with commas, and the reader reads what it wrote.
#           Guess before the run: the text ends at the line break, and the number of points stays.
# Found: one point more is read for each line break, at coordinates that were never set, without a report; the label is
#        cut.  The same list in .mrk.json comes back whole.
# Versions: slicer-core 5.13.31053.0 (storage nodes of 3D Slicer), vtk 9.6.2.
# Concerns: who keeps targets, entry points or registration landmarks as .fcsv: a registration of four points gets a
#           fifth one, a robot a target that nobody placed.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0
cd "$folder"
cat > run.py <<'PYTHON'
import sys
from importlib.metadata import version

import slicer
import vtk

scene = slicer.vtkMRMLScene()
marks = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "Targets")
for label, place in (("comma, label", (1.5, 2.5, 3.5)), ("two\nlines", (10, 20, 30))):
    marks.AddControlPoint(vtk.vtkVector3d(*place), label)
marks.SetNthControlPointDescription(0, "seen in the scan,\nto be checked")


def places(storage, path):
    """Write with a storage node, read with it; (label, place) of each point."""
    scene.AddNode(storage)
    storage.SetFileName(path)
    assert storage.WriteData(marks)
    read = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode")
    assert storage.ReadData(read)
    found = []
    for number in range(read.GetNumberOfControlPoints()):
        place = [0.0, 0.0, 0.0]
        read.GetNthControlPointPosition(number, place)
        found.append((read.GetNthControlPointLabel(number), *(round(each, 6) for each in place)))
    return found


print("slicer-core", version("slicer-core"))
print("fcsv    ", fcsv := places(slicer.vtkMRMLMarkupsFiducialStorageNode(), "marks.fcsv"))
print("mrk.json", json := places(slicer.vtkMRMLMarkupsJsonStorageNode(), "marks.mrk.json"))
whole = [("comma, label", 1.5, 2.5, 3.5), ("two\nlines", 10.0, 20.0, 30.0)]
sys.exit(json != whole or len(fcsv) != 4 or ("two", 10.0, 20.0, 30.0) not in fcsv)
PYTHON
venv/bin/python run.py
