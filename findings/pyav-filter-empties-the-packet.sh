#!/bin/sh
# PyAV: a bitstream filter takes what is in the packet, whose time is None afterwards.
#
# Expected: `filter(packet)` returns new packets and leaves its argument, as `decode` does; or its page states otherwise.
# Found: `packet.pts` and `packet.dts` are None, `packet.size` is 0 and `is_keyframe` is False after the call, also where
#        the filter changes nothing ("null").  The returned packet has all of them.  No exception, no warning.
# Versions: av 18.1.0.
# Concerns: who copies the frames of an mp4 as Annex B: a time that is read after the filter is the end of the stream.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import av
import numpy
from av.bitstream import BitStreamFilterContext

with av.open("a.mp4", "w") as file:
    stream = file.add_stream("libx264", rate=30)
    stream.width = stream.height = 32
    for number in range(4):
        picture = numpy.full((32, 32, 3), 60 * number, numpy.uint8)
        file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
    file.mux(stream.encode(None))


def facts(packet):
    return packet.pts, packet.dts, packet.size > 0, packet.is_keyframe


good = True
for name in ("h264_mp4toannexb", "null"):
    with av.open("a.mp4") as file:
        packet = next(file.demux(video=0))
        before = facts(packet)
        packet.decode()
        decoded = facts(packet)
        [new] = BitStreamFilterContext(name, file.streams.video[0]).filter(packet)
        print(f"av {av.__version__}, {name}: {before}, after decode {decoded}, after filter {facts(packet)}, new {facts(new)}")
        good &= before == decoded == facts(new) and facts(packet) == (None, None, False, False)
sys.exit(not good)
PYTHON
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check av==18.1.0 numpy
venv/bin/python run.py
