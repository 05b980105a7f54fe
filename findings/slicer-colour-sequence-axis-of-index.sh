#!/bin/sh
# slicer-core: the times of a sequence of colour pictures have the name of an axis that is not that of the frames.
#
# Expected: in an NRRD whose axes are colour, columns, rows, slices and frames, the fields of the frames are those of
#           axis 4, so that "axis 4 index values" gives their times.  Guess before the run: axis 4 works, axis 3 does not.
# Found: the reverse: "axis 3 index values" gives the times, and with axis 4 the index is the number of the frame.
# Versions: slicer-core 5.13.31053.0, VTK 9.6.2.
# Concerns: who reads or writes .seq.nrrd of colour pictures by the numbers of its axes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0 numpy==2.4.6
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import slicer


def indexes(axis):
    head = f"""NRRD0005
type: uint8
dimension: 5
space: left-posterior-superior
sizes: 3 4 2 1 3
space directions: none (1,0,0) (0,1,0) (0,0,1) none
kinds: RGB-color domain domain domain list
labels: "" "" "" "" "time"
units: "" "" "" "" "s"
encoding: raw
space origin: (0,0,0)
axis {axis} index type:=numeric
axis {axis} index values:=0.000 0.250 0.500

"""
    with open("colours.seq.nrrd", "wb") as file:
        file.write(head.encode() + bytes(72))
    scene = slicer.vtkMRMLScene()
    sequence = scene.AddNewNodeByClass("vtkMRMLSequenceNode")
    storage = scene.AddNewNodeByClass("vtkMRMLVolumeSequenceStorageNode")
    storage.SetFileName("colours.seq.nrrd")
    assert storage.ReadData(sequence) == 1
    return [sequence.GetNthIndexValue(n) for n in range(sequence.GetNumberOfDataNodes())]


third, fourth = indexes(3), indexes(4)
print(f"axis 3: {third}; axis 4: {fourth}")
sys.exit(third != ["0.000", "0.250", "0.500"] or fourth != ["0", "1", "2"])
PYTHON
"$folder/venv/bin/python" run.py
