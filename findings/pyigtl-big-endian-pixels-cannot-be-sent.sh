#!/bin/sh
# pyigtl: an image of big-endian numbers is "list index out of range".
#
# Expected: an array of ">i2", as DICOM, NIfTI and MetaImage readers give them, is sent with byte order 1: the code asks
#           for dtype.byteorder and has both values.
# Found: IndexError: the scalar type is found by comparing the dtype with numpy's native types, and ">i2" is not equal
#        to int16; so that byte order 1 is never written.  Reading it is right.  One byte a pixel has no byte order and
#        passes.  array.astype(array.dtype.newbyteorder("=")) helps.
# Versions: pyigtl 0.3.4, numpy 2.2.6.
# Concerns: who sends volumes that a reader mapped from a big-endian file.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyigtl==0.3.4 numpy==2.2.6
cat > "$folder/try.py" <<'PYTHON'
import sys

import numpy as np
from pyigtl.messages import ImageMessage

BYTE_ORDER_AT = 4


def content(dtype):
    try:
        return ImageMessage(np.array([[[1, 2]]], dtype))._pack_content()
    except IndexError as error:
        return error


found = {dtype: content(dtype) for dtype in ("<i2", ">i2", ">f4", ">u1")}
for dtype, data in found.items():
    print(dtype, data if isinstance(data, IndexError) else f"byte order {data[BYTE_ORDER_AT]}")
native = found["<i2"]
big = native[:BYTE_ORDER_AT] + b"\1" + native[BYTE_ORDER_AT + 1 : 72] + b"\0\1\0\2"
there = ImageMessage()
there._unpack_content(big)
print("byte order 1 is read as", there.image.ravel().tolist())
failed = [dtype for dtype, data in found.items() if isinstance(data, IndexError)]
sys.exit(failed != [">i2", ">f4"] or there.image.ravel().tolist() != [1, 2])
PYTHON
"$folder/venv/bin/python" "$folder/try.py"
