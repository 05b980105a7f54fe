#!/bin/sh
# pyIGTLink and pygtlink: no image can be sent with numpy 2.3 and newer, which a plain installation brings.
#
# Expected: both name the numpy that they need; a fresh `pip install` sends an image, or its metadata refuse the numpy.
# Found: neither bounds numpy, and both pack pixels with `ndarray.tostring`, which numpy 2.3 removed: AttributeError at
#        the first image.  Transforms, positions and states are sent as before, so that a link seems to work.
# Versions: pyIGTLink 0.2.1, pygtlink 1.0.0, numpy 2.4.6 and 2.2.6.
# Concerns: who installs one of them today.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > run.py <<'PYTHON'
import sys
import warnings

import numpy
from pygtlink import ImageMessage2
from pyIGTLink.pyIGTLink import ImageMessage, TransformMessage

warnings.simplefilter("ignore")
pixels = numpy.zeros((4, 4), numpy.uint8)


def of_pygtlink():
    message = ImageMessage2()
    message.setData(pixels)
    message.pack()


TransformMessage(numpy.eye(4)).get_binary_message()
found = []
for pack in (lambda: ImageMessage(pixels).get_binary_message(), of_pygtlink):
    try:
        pack()
        found.append("packed")
    except AttributeError as error:
        found.append(str(error))
print(f"numpy {numpy.__version__}: {found}")
sys.exit(found != ["packed"] * 2 if sys.argv[1] == "old" else not all("tostring" in one for one in found))
PYTHON
for kind in new=2.4.6 old=2.2.6; do
    python3 -m venv "${kind%=*}"
    "${kind%=*}/bin/pip" install --quiet --disable-pip-version-check pyIGTLink==0.2.1 pygtlink==1.0.0 "numpy==${kind#*=}"
    "${kind%=*}/bin/python" run.py "${kind%=*}"
done
