#!/bin/sh
# slicer-core: reading a volume, or a sequence of volumes, takes memory for all its pixels twice.
#
# Expected: the pixels once: they are read into the volume that keeps them.
#           Guess before the run: 2.0 times the pixels for a sequence, plain and compressed, whose frames are copied out of
#           one block; 1.0 for a single volume.
# Found: 2.2 for both sequences, and 2.0 for a single volume too (the guess was wrong there).
# Versions: slicer-core 5.13.31053.0 (3D Slicer without its windows), vtk 9.6.2.
# Concerns: who writes long ultrasound or fluoroscopy as one .seq.nrrd or .mrb: a file of 8 GB does not open with 16 GB of
#           memory, though its frames would fit; two files of 4 GB do.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0
cd "$folder"
cat > run.py <<'PYTHON'
import resource
import subprocess
import sys
import zlib
from importlib.metadata import version

import slicer

SIZE, FRAMES = (640, 480), 600
MIB = 1 << 20


def header(encoding, frames):
    listed = f" {frames}" if frames > 1 else ""
    lines = [
        "NRRD0005",
        "type: uint8",
        f"dimension: {4 if listed else 3}",
        "space: left-posterior-superior",
        f"sizes: {SIZE[0]} {SIZE[1]} {1 if listed else FRAMES}{listed}",
        f"space directions: (1,0,0) (0,1,0) (0,0,1){' none' if listed else ''}",
        f"kinds: domain domain domain{' list' if listed else ''}",
        f"encoding: {encoding}",
        "space origin: (0,0,0)",
    ]
    if listed:
        lines += ["axis 3 index type:=numeric", "axis 3 index values:=" + " ".join(f"{n / 20:.3f}" for n in range(frames))]
    return ("\n".join(lines) + "\n\n").encode()


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def read(path):
    scene = slicer.vtkMRMLScene()
    scene.RegisterNodeClass(slicer.vtkMRMLScalarVolumeNode())
    is_sequence = path.startswith("sequence")
    storage = slicer.vtkMRMLVolumeSequenceStorageNode() if is_sequence else slicer.vtkMRMLNRRDStorageNode()
    node = scene.AddNewNodeByClass("vtkMRMLSequenceNode" if is_sequence else "vtkMRMLScalarVolumeNode")
    scene.AddNode(storage)
    storage.SetFileName(path)
    before = peak()
    assert storage.ReadData(node)
    count = node.GetNumberOfDataNodes() if is_sequence else node.GetImageData().GetDimensions()[2]
    print(count, peak() - before)


if len(sys.argv) > 1:
    read(sys.argv[1])
    sys.exit()
frame = bytes(range(256)) * (SIZE[0] * SIZE[1] // 256)
with open("sequence.seq.nrrd", "wb") as raw, open("sequence-gz.seq.nrrd", "wb") as packed, open("volume.nrrd", "wb") as one:
    raw.write(header("raw", FRAMES))
    one.write(header("raw", 1))
    packed.write(header("gzip", FRAMES))
    packer = zlib.compressobj(1, zlib.DEFLATED, 31)
    for number in range(FRAMES):
        pixels = frame[number % 256 :] + frame[: number % 256]
        raw.write(pixels)
        one.write(pixels)
        packed.write(packer.compress(pixels))
    packed.write(packer.flush())
pixels_mib = SIZE[0] * SIZE[1] * FRAMES / MIB
print("slicer-core", version("slicer-core"))
found = {}
for path in ("sequence.seq.nrrd", "sequence-gz.seq.nrrd", "volume.nrrd"):
    done = subprocess.run([sys.executable, __file__, path], capture_output=True, text=True, check=True)
    count, more = map(int, done.stdout.split())
    found[path] = round(more / pixels_mib, 2)
    print(f"{path}: {count} frames of {pixels_mib:.0f} MiB; the peak grows by {more} MiB = {found[path]} times the pixels")
sys.exit(not (found["sequence.seq.nrrd"] > 1.9 and found["sequence-gz.seq.nrrd"] > 1.9 and found["volume.nrrd"] > 1.9))
PYTHON
venv/bin/python run.py
