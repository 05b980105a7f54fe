#!/bin/sh
# SimpleITK: a compressed .mha without CompressedDataSize has other pixels than the file, and no error; the same as .mhd is right.
#
# Expected: the compressed pixels reach to the end of the file, in both forms.
#           Guess before the run: an error for .mha, or the right pixels.
# Found: ReadImage returns an image of the right size with pixels that are not in the file; only stderr has
#        "Uncompress failed".  As .mhd beside a .zraw, and with CompressedDataSize, the pixels are right.
# Versions: SimpleITK 2.5.7.
# Concerns: who writes MetaImages without ITK, and reads them in programs on ITK.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check SimpleITK==2.5.7 numpy==2.3.5
cd "$folder"
cat > run.py <<'PYTHON'
import sys
import zlib

import numpy
import SimpleITK

pixels = numpy.arange(1000, 1024, dtype="<u2").reshape(2, 3, 4)
packed = zlib.compress(pixels.tobytes())
HEAD = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = True\n"
REST = "DimSize = 4 3 2\nElementSpacing = 1 1 1\nOffset = 0 0 0\nElementType = MET_USHORT\nElementDataFile = "
size = f"CompressedDataSize = {len(packed)}\n"
with open("a.zraw", "wb") as out:
    out.write(packed)
found = {}
for name, head, data in (
    ("size.mha", HEAD + size + REST + "LOCAL\n", packed),
    ("none.mha", HEAD + REST + "LOCAL\n", packed),
    ("none.mhd", HEAD + REST + "a.zraw\n", b""),
):
    with open(name, "wb") as out:
        out.write(head.encode() + data)
    image = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(name))
    found[name] = image.shape == pixels.shape and bool((image == pixels).all())
    print(f"{name}: shape {image.shape}, pixels {'right' if found[name] else 'wrong'}")
print("SimpleITK", SimpleITK.Version.VersionString())
sys.exit(found != {"size.mha": True, "none.mha": False, "none.mhd": True})
PYTHON
venv/bin/python run.py
