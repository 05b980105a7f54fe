#!/bin/sh
# slicer-core: the slices of a picture whose three directions are left-handed are read in the opposite order.
#
# Expected: voxel (i, j, k) of a node is voxel (i, j, k) of the file, as in ITK; the matrix says where it lies.
# Found: the first slice of the node is the last one of the file; origin and third direction of the matrix fit that, so
#        places in RAS are right, and indices are not those of the file.  No message says so.  Right-handed files are not changed.
# Versions: slicer-core 5.13.31053.0, VTK 9.6.2.
# Concerns: who joins a picture in 3D Slicer with another program by voxel indices: labels, slices of a sweep, kernels.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0 numpy==2.4.6
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import numpy as np
import slicer
import vtk
from vtk.util.numpy_support import vtk_to_numpy

PIXELS = np.arange(60, dtype=np.uint8).reshape(3, 4, 5)


def read(third):
    head = (
        "NRRD0004\ntype: uint8\ndimension: 3\nspace: right-anterior-superior\nsizes: 5 4 3\nkinds: domain domain domain\n"
        f"encoding: raw\nspace directions: (1,0,0) (0,1,0) (0,0,{third})\nspace origin: (0,0,0)\n\n"
    )
    with open("picture.nrrd", "wb") as file:
        file.write(head.encode() + PIXELS.tobytes())
    scene = slicer.vtkMRMLScene()
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode")
    storage = scene.AddNewNodeByClass("vtkMRMLVolumeArchetypeStorageNode")
    storage.SetFileName("picture.nrrd")
    storage.SetSingleFile(1)
    assert storage.ReadData(node)
    placed = vtk.vtkMatrix4x4()
    node.GetIJKToRASMatrix(placed)
    voxels = vtk_to_numpy(node.GetImageData().GetPointData().GetScalars()).reshape(3, 4, 5)
    order = "file" if np.array_equal(voxels, PIXELS) else "turned" if np.array_equal(voxels, PIXELS[::-1]) else "other"
    return order, placed.GetElement(2, 2), placed.GetElement(2, 3)


right, left = read(1), read(-1)
print(f"order of slices, third direction, origin: right-handed {right}, left-handed {left}")
sys.exit(right != ("file", 1.0, 0.0) or left != ("turned", 1.0, -2.0))
PYTHON
"$folder/venv/bin/python" run.py
