#!/bin/sh
# slicer-core: a scene that it has written logs an error when it reads it: the orientation of a slice node.
#
# Expected: a scene with one vtkMRMLSliceNode, written by Commit, is read by Connect without a line in the log.
#           Guess before the run: no line.
# Found: Commit writes orientation="Reformat", and Connect logs "GetSliceOrientationPreset: invalid orientation preset
#        name: Reformat".  The plane (sliceToRAS) is read as it was.
# Versions: slicer-core 5.13.31053.0, VTK 9.6.2.
# Concerns: who writes scenes for 3D Slicer by its own example, and counts the lines of its log as faults.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0 numpy==2.4.6
cd "$folder"
cat > run.py <<'PYTHON'
import slicer

scene = slicer.vtkMRMLScene()
node = scene.AddNewNodeByClass("vtkMRMLSliceNode")
node.SetLayoutName("Red")
scene.Commit("scene.mrml")
again = slicer.vtkMRMLScene()
again.SetURL("scene.mrml")
again.Connect()
PYTHON
"$folder/venv/bin/python" run.py 2> log.txt
echo "written: $(grep -o 'orientation="[A-Za-z]*"' scene.mrml)"
echo "log: $(grep -o 'GetSliceOrientationPreset.*' log.txt | head -n 1)"
grep -q 'orientation="Reformat"' scene.mrml
grep -q "invalid orientation preset name: Reformat" log.txt
