#!/bin/sh
# rclpy: the bytes between the fields of a serialised message are what the memory had before.
#
# Expected: the padding that CDR puts before a number is zeros, so equal messages have equal bytes.
#           Guess before the run: zeros.
# Found: two bytes behind a text of one letter are often not zero ("_:", "si"), other ones in each place of a program.
#        The fields are right.  Fast CDR skips the padding, and the buffer comes from malloc.
# Versions: ros-jazzy-rclpy 7.1.6 with ros-jazzy-sensor-msgs 5.3.6; ros-kilted-rclpy 9.1.2 does the same.
# Concerns: who compares, hashes or signs the bytes of messages, and whose messages leave the house: there is a little of
#           the program's memory in them.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ros-jazzy-rclpy==7.1.6 \
    ros-jazzy-rmw-fastrtps-cpp==8.4.3 ros-jazzy-sensor-msgs==5.3.6 numpy
cd "$folder"
export ROS_LOG_DIR="$folder"
cat > show.py <<'PYTHON'
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String

found, messages = set(), set()
for before in ("", "a robot", "a patient's name", "x" * 100):
    for kind in (CompressedImage, Image):
        serialize_message(String(data=before))
        message = kind()
        message.header.frame_id = "a"
        data = serialize_message(message)
        messages.add((kind.__name__, data))
        assert deserialize_message(data, kind) == message
        found.add(data[18:20])  # behind stamp, length, "a" and its end; before the next number
print(len(messages), "different serialisations of two messages; padding:", *sorted(map(repr, found)))
assert found != {b"\0\0"}
PYTHON
venv/bin/python show.py
