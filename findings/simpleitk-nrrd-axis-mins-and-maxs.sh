#!/bin/sh
# SimpleITK: an NRRD with "axis mins" and "axis maxs", but without "spacings", has voxels of 1 mm.
#
# Expected: the size of the voxels follows from the two ends, as the definition of NRRD has it: for cell-centred samples
#           (axis max - axis min) / size, here 2, 3 and 5 mm.  Guess before the run: that, or both fields are ignored.
# Found: half of it.  The origin is the first centre of voxels of 2, 3 and 5 mm (11, 11.5 and 12.5 mm), the spacing is
#        1 mm: the image begins at the right place and has the wrong size.  Nothing is reported.
# Versions: SimpleITK 2.5.7.
# Concerns: who writes NRRD with the ends of axes (teem's unu does), and reads it in 3D Slicer, PLUS or other programs on ITK.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check SimpleITK==2.5.7
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import SimpleITK

HEAD = "NRRD0005\ntype: uint8\ndimension: 3\nsizes: 2 3 4\naxis mins: 10 10 10\naxis maxs: 14 19 30\n"
with open("a.nrrd", "wb") as out:
    out.write((HEAD + "centers: cell cell cell\nencoding: raw\n\n").encode() + bytes(24))
image = SimpleITK.ReadImage("a.nrrd")
print(f"SimpleITK {SimpleITK.Version.VersionString()}: spacing {image.GetSpacing()}, origin {image.GetOrigin()}")
sys.exit((image.GetSpacing(), image.GetOrigin()) != ((1.0, 1.0, 1.0), (11.0, 11.5, 12.5)))
PYTHON
venv/bin/python run.py
