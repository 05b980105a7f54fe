#!/bin/sh
# rclpy: the bytes between the values of a message are memory of the process, so equal messages have different bytes.
#
# Expected (guess): equal messages have equal bytes, with zeros where a value is aligned.
# Found: Fast CDR skips these bytes without writing them.  A response of SetBool has three of them behind its bool, and
#        one is 0x55 or 0x56, or other in another program: a part of an address.  Two processes that send the same
#        response send, record and hash different bytes; in one process they are mostly the same.
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3 (ros-fastcdr 2.2.5), ros-jazzy-std-srvs 5.3.6.
# Concerns: who compares requests, caches or deduplicates messages by their bytes, or has digests of a run: values must
#           be compared; and who sends to others: bits of an address leave the process.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ros-jazzy-rclpy==7.1.6 \
    ros-jazzy-rmw-fastrtps-cpp==8.4.3 ros-jazzy-std-srvs==5.3.6 ros-fastcdr==2.2.5 numpy
cd "$folder"
export ROS_LOG_DIR="$folder"
cat > show.py <<'PYTHON'
from rclpy.serialization import serialize_message
from std_srvs.srv import SetBool

print(bytes(serialize_message(SetBool.Response(success=True, message="on"))).hex(" "))
PYTHON
for _ in 1 2 3 4 5 6 7 8 9 10; do
    venv/bin/python show.py
done | sort | uniq -c > found.txt
cat found.txt
# between the bool and the length of the text, not all is 0
grep -qv '00 01 00 00 01 00 00 00 03 00 00 00 6f 6e 00' found.txt
