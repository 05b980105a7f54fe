#!/bin/sh
# pyIGTLink: an image with more columns than rows has a sub-volume that does not fit into it; RGB has two components.
#
# Expected: a picture of 3 rows and 4 columns is 4 x 3 x 1, and so is its sub-volume, which is the whole of it; one of
#           3 x 4 x 3 has three components, and one slice.
# Found: size (4, 3, 1) and sub-volume (3, 4, 1); of the coloured one 2 components, and 3 slices in both.  A reader that
#        checks the sub-volume refuses each picture that is not square, and each in colour by its number of bytes.
# Versions: pyIGTLink 0.2.1, numpy 2.2.6.
# Concerns: who streams ultrasound with it: square pictures of one colour work in every test.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > run.py <<'PYTHON'
import struct
import sys

import numpy
from pyIGTLink.pyIGTLink import ImageMessage

found = []
for shape in ((3, 4), (3, 4, 3)):
    body = ImageMessage(numpy.zeros(shape, numpy.uint8)).get_binary_body()
    components, size = body[2], struct.unpack_from(">3H", body, 6)
    part, pixels = struct.unpack_from(">3H", body, 66), len(body) - 72
    print(f"shape {shape}: {components} components, size {size}, sub-volume {part}, {pixels} bytes of pixels")
    found.append((components, size, part))
sys.exit(found != [(1, (4, 3, 1), (3, 4, 1)), (2, (4, 3, 3), (3, 4, 3))])
PYTHON
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check pyIGTLink==0.2.1 numpy==2.2.6
venv/bin/python run.py
