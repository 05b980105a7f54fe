#!/bin/sh
# slicer-core: a sequence of poses whose name has "Status" in it cannot be read.
#
# Expected: a transform "StatusToBase" of a .seq.mha is read as one that is named "MarkerToBase".
# Found: ReadData returns 0 and the sequence has no item: the reader takes every field with "Status" in its name for the
#        status of a transform.  It is not the rule that the first transform of a file is the one that is read: with
#        "StatusToBase" first and "MarkerToBase" second, the second is read, without a message.
# Versions: slicer-core 5.13.31053.0, VTK 9.6.2.
# Concerns: who stores poses of a device such as "StatusLight" or "FootStatus" for 3D Slicer.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0 numpy==2.4.6
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import slicer

HEAD = """ObjectType = Image
NDims = 3
DimSize = 0 0 3
ElementType = MET_UCHAR
Kinds = domain domain list
"""


def items(*names):
    with open("poses.seq.mha", "w") as file:
        file.write(HEAD)
        for number in range(3):
            at = f"Seq_Frame{number:04}_"
            for name in names:
                file.write(f"{at}{name}Transform = 1 0 0 {number} 0 1 0 0 0 0 1 0 0 0 0 1\n")
                file.write(f"{at}{name}TransformStatus = OK\n")
            file.write(f"{at}Timestamp = {number / 10:.3f}\n")
        file.write("ElementDataFile = LOCAL\n")
    scene = slicer.vtkMRMLScene()
    sequence = scene.AddNewNodeByClass("vtkMRMLSequenceNode")
    storage = scene.AddNewNodeByClass("vtkMRMLLinearTransformSequenceStorageNode")
    storage.SetFileName("poses.seq.mha")
    code = storage.ReadData(sequence)
    return code, sequence.GetNumberOfDataNodes(), sequence.GetName()


marker, status = items("MarkerToBase"), items("StatusToBase")
both = items("StatusToBase", "MarkerToBase")
print(f"code, items, name: MarkerToBase {marker}, StatusToBase {status}, StatusToBase before MarkerToBase {both}")
sys.exit(marker[:2] != (1, 3) or status[:2] != (0, 0) or both[:2] != (1, 3) or "Marker" not in both[2])
PYTHON
"$folder/venv/bin/python" run.py
