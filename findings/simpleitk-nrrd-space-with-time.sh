#!/bin/sh
# SimpleITK: the space of an NRRD with time (RAST, right-anterior-superior-time) is read as LPS: turned by 180 degrees.
#
# Expected: as RAS without time: x and y change their sign on the way to LPS; time is a coordinate of its own.
#           Guess before the run: the long name has this effect, the short one may not.
# Found: neither has it.  Both names without time have it.  Nothing is reported.
# Versions: SimpleITK 2.5.7.
# Concerns: who keeps volumes over time (4-D ultrasound, cardiac MR) as NRRD, and reads them in programs on ITK.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check SimpleITK==2.5.7
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import SimpleITK

FOUR = "sizes: 2 3 4 5\nkinds: domain domain domain domain\nspace directions: (1,0,0,0) (0,1,0,0) (0,0,1,0) (0,0,0,1)\n"
THREE = "sizes: 2 3 4\nkinds: domain domain domain\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"
FORMS = {
    "RAS": THREE + "space origin: (1,2,3)\n",
    "right-anterior-superior": THREE + "space origin: (1,2,3)\n",
    "RAST": FOUR + "space origin: (1,2,3,0)\n",
    "right-anterior-superior-time": FOUR + "space origin: (1,2,3,0)\n",
}
found = {}
for name, lines in FORMS.items():
    head = f"NRRD0005\ntype: uint8\ndimension: {3 if lines.startswith(THREE) else 4}\nspace: {name}\n{lines}encoding: raw\n\n"
    with open("a.nrrd", "wb") as out:
        out.write(head.encode() + bytes(120))
    found[name] = SimpleITK.ReadImage("a.nrrd").GetOrigin()[:3]
    print(f"{name}: origin {found[name]}")
print("SimpleITK", SimpleITK.Version.VersionString())
sys.exit(
    found
    != {
        "RAS": (-1.0, -2.0, 3.0),
        "right-anterior-superior": (-1.0, -2.0, 3.0),
        "RAST": (1.0, 2.0, 3.0),
        "right-anterior-superior-time": (1.0, 2.0, 3.0),
    }
)
PYTHON
venv/bin/python run.py
