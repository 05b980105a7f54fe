#!/bin/sh
# rosbags: one definition with line ends of Windows closes the whole bag.
#
# Expected: AnyReader opens a bag with a definition that it cannot parse, and reads the other topics: each message has
#           the name of its own type.
# Found: it raises an AnyReaderError while it opens, and no topic can be read.  rosidl accepts such a .msg file, and
#        rosbag2 stores its bytes as they are.  mcap-ros2-support reads both topics.
# Versions: rosbags 0.11.9, mcap-ros2-support 0.6.0, mcap 1.6.0.
# Concerns: who reads bags of packages that were edited on Windows, with tools on top of rosbags.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    rosbags==0.11.9 mcap-ros2-support==0.6.0 mcap==1.6.0
cd "$folder"
cat > try.py <<'PYTHON'
import struct
import sys
from importlib.metadata import version
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

print("rosbags", version("rosbags"), "mcap-ros2-support", version("mcap-ros2-support"))
found = {}
for name, end in (("control", "\n"), ("windows", "\r\n")):
    path = Path(f"{name}.mcap")
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for topic, kind, text in (
            ("/a", "std_msgs/msg/Float64", "float64 data\n"),
            ("/b", "lab_msgs/msg/State", f"float64 data{end}float64 more{end}"),
        ):
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channel = writer.register_channel(topic, "cdr", schema)
            size = 1 if topic == "/a" else 2
            writer.add_message(channel, 1, b"\0\1\0\0" + struct.pack(f"<{size}d", *range(size)), 1)
        writer.finish()
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        by_mcap = sorted(channel.topic for _, channel, _, _ in reader.iter_decoded_messages())
    try:
        with AnyReader([path]) as bag:
            by_rosbags = sorted(each.topic for each, _, data in bag.messages() if bag.deserialize(data, each.msgtype))
    except Exception as error:
        by_rosbags = type(error).__name__
    found[name] = by_mcap, by_rosbags
    print(f"{name}: mcap-ros2-support {by_mcap}, rosbags {by_rosbags}")
both = ["/a", "/b"]
sys.exit(found != {"control": (both, both), "windows": (both, "AnyReaderError")})
PYTHON
venv/bin/python try.py
