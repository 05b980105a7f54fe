#!/bin/sh
# pygtlink: pixels of several bytes are little-endian and declared big-endian; its size has rows before columns.
#
# Expected: an image declares its pixels as big-endian (1), which is the default here, and has them so; a picture of 2 rows
#           and 3 columns is 3 x 2 x 1 on the wire (i is the column).
# Found: numpy writes its pixels in the order of the machine, so 1 and 256 change places for every other reader; the size
#        is (2, 3, 1).  Spacing is 0 until it is set.  Its own reader makes both mistakes again and shows the picture.
# Versions: pygtlink 1.0.0, numpy 2.2.6; a little-endian machine.
# Concerns: who sends depth or ultrasound of 16 bits: a test with this package at both ends passes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > run.py <<'PYTHON'
import struct
import sys
import warnings

import numpy
from pygtlink import ImageMessage2

warnings.simplefilter("ignore")
message = ImageMessage2()
message.setScalarTypeToUint16()
message.setData(numpy.arange(1, 7, dtype=numpy.uint16).reshape(2, 3))
message.pack()
endian, size = message.body[4], struct.unpack_from(">3H", message.body, 6)
spacing = struct.unpack_from(">f", message.body, 12)[0]
pixels = struct.unpack(">6H" if endian == 1 else "<6H", message.body[72:])
print(f"byte order {endian}, size {size}, first element of the matrix {spacing}, pixels as declared {pixels}")
sys.exit((endian, size, spacing, pixels[:2]) != (1, (2, 3, 1), 0.0, (256, 512)))
PYTHON
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check pygtlink==1.0.0 numpy==2.2.6
venv/bin/python run.py
