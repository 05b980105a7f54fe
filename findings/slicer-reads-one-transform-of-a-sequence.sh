#!/bin/sh
# slicer-core: of a tracked sequence with several transforms, the reader of sequences of transforms gives the first one.
#
# Expected: a .seq.mha with ProbeToTracker and ReferenceToTracker in each frame gives both, or a message.
# Found: one sequence node, with the name that comes first in the file; ReadData returns 1 and there is no message.
#        Frames whose status is INVALID are items like others, without their status.
# Versions: slicer-core 5.13.31053.0, VTK 9.6.2.
# Concerns: who opens a recording of a tracked ultrasound probe in a program on Slicer's core.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0 numpy==2.4.6
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import slicer

with open("poses.seq.mha", "w") as file:
    file.write("ObjectType = Image\nNDims = 3\nDimSize = 0 0 3\nElementType = MET_UCHAR\nKinds = domain domain list\n")
    for number in range(3):
        at = f"Seq_Frame{number:04}_"
        for name, status in (("ProbeToTracker", "INVALID" if number == 1 else "OK"), ("ReferenceToTracker", "OK")):
            file.write(f"{at}{name}Transform = 1 0 0 {number} 0 1 0 0 0 0 1 0 0 0 0 1\n")
            file.write(f"{at}{name}TransformStatus = {status}\n")
        file.write(f"{at}Timestamp = {number / 10:.3f}\n")
    file.write("ElementDataFile = LOCAL\n")
scene = slicer.vtkMRMLScene()
sequence = scene.AddNewNodeByClass("vtkMRMLSequenceNode")
storage = scene.AddNewNodeByClass("vtkMRMLLinearTransformSequenceStorageNode")
storage.SetFileName("poses.seq.mha")
code = storage.ReadData(sequence)
nodes = scene.GetNodesByClass("vtkMRMLSequenceNode")
found = [(nodes.GetItemAsObject(at).GetName(), nodes.GetItemAsObject(at).GetNumberOfDataNodes()) for at in range(nodes.GetNumberOfItems())]
messages = storage.GetUserMessages().GetNumberOfMessages()
print(f"code {code}, messages {messages}, sequences and items {found}")
sys.exit(code != 1 or messages != 0 or len(found) != 1 or "Probe" not in found[0][0] or found[0][1] != 3)
PYTHON
"$folder/venv/bin/python" run.py
