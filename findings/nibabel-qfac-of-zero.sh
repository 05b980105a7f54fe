#!/bin/sh
# nibabel: a NIfTI whose pixdim[0] is 0 cannot give its qform, although nifti1.h defines 0 as 1.
#
# Expected: by nifti1.h (method 2) a pixdim[0] of 0, which should not occur, stands for a qfac of 1.
#           Guess before the run: get_qform takes 1, as SimpleITK does.
# Found: get_qform raises HeaderDataError; loading the file takes 1 for its affine.  SimpleITK reads the position.
# Versions: nibabel 5.4.2, SimpleITK 2.5.7.
# Concerns: who reads NIfTI of scanners and converters that leave pixdim[0] at 0, by the header instead of the affine.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check nibabel==5.4.2 SimpleITK==2.5.7 numpy==2.4.6
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import nibabel
import numpy
import SimpleITK

affine = numpy.diag([1.0, 2.0, 3.0, 1.0])
affine[:3, 3] = 5, 6, 7
image = nibabel.Nifti1Image(numpy.zeros((2, 3, 4), numpy.uint8), affine)
image.set_sform(None, 0)
image.set_qform(affine, 1)
nibabel.save(image, "a.nii")
with open("a.nii", "r+b") as file:
    file.seek(76)
    file.write(bytes(4))
try:
    raised = nibabel.Nifti1Header.from_fileobj(open("a.nii", "rb"), check=False).get_qform() is None
except Exception as error:
    raised = type(error).__name__
loaded = nibabel.load("a.nii").affine[:3, 3].tolist()
origin = SimpleITK.ReadImage("a.nii").GetOrigin()
print(f"nibabel {nibabel.__version__}: get_qform raises {raised}; the loaded affine begins at {loaded}")
print(f"SimpleITK {SimpleITK.Version.VersionString()}: origin {origin}")
sys.exit(raised != "HeaderDataError" or loaded != [5.0, 6.0, 7.0] or origin != (-5.0, -6.0, 7.0))
PYTHON
venv/bin/python run.py
