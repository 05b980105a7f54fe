#!/bin/sh
# slicer-core: an attribute of a node whose name has a colon comes back from a saved scene under another name and value.
#
# Expected: names and values of attributes are escaped in the scene file (values are: ";" becomes "%3B"), so that
#           "OpenIGTLink.us:depth" = "50" comes back.  Guess before the run: a semicolon in a name breaks the list, a
#           colon is escaped.
# Found: neither is escaped in a name.  With a colon the attribute "OpenIGTLink.us" = "depth:50" is there after loading,
#        and overwrites one that had this name; with a semicolon it is lost, or becomes two.  Nothing is reported.
# Versions: slicer-core 5.13.31053.0 (the scene of 3D Slicer), vtk 9.6.2.
# Concerns: who sends OpenIGTLink metadata with keys such as "us:depth" or "0018:1164" to 3D Slicer, which keeps each key
#           as an attribute "OpenIGTLink.KEY", and saves the scene.
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

SAVED = {"OpenIGTLink.us": "on", "OpenIGTLink.us:depth": "50", "OpenIGTLink.gain": "a;b:c", "OpenIGTLink.x;y": "1"}
scene = slicer.vtkMRMLScene()
node = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Probe")
for name, value in SAVED.items():
    node.SetAttribute(name, value)
scene.Commit("scene.mrml")
other = slicer.vtkMRMLScene()
other.SetURL("scene.mrml")
other.Connect()
loaded = other.GetFirstNodeByClass("vtkMRMLLinearTransformNode")
found = {name: loaded.GetAttribute(name) for name in loaded.GetAttributeNames()}
print("slicer-core", version("slicer-core"))
print("saved ", SAVED)
print("loaded", found)
sys.exit(
    found.get("OpenIGTLink.us") != "depth:50"
    or "OpenIGTLink.us:depth" in found
    or found.get("OpenIGTLink.gain") != "a;b:c"
    or "OpenIGTLink.x;y" in found
)
PYTHON
venv/bin/python run.py
