#!/bin/sh
# rosbags-convert: stamps of ROS 1 from 2038-01-19 on become stamps of 1901 in ROS 2, with exit code 0.
#
# Expected: a conversion that cannot hold a stamp refuses the message or reports it: ROS 1 counts seconds of a time as
#           uint32, up to 2106, ROS 2 as int32, up to 2038.
# Found: the 32 bits are copied.  2208988800 s (2040-01-01) is read as -2085978496 s (1903-11-25); nothing is reported.
# Versions: rosbags 0.11.9.  The bag is written with its own writer, whose time of ROS 1 is int32, too: the same bits.
# Concerns: who converts bags of simulated or wrong clocks, or looks for messages by their stamps afterwards.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rosbags==0.11.9
cd "$folder"
cat > make.py <<'PYTHON'
import struct

from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS1_NOETIC)
with Writer("a.bag") as bag:
    connection = bag.add_connection("/tick", "std_msgs/msg/Header", typestore=store)
    # uint32 seq, uint32 secs, uint32 nsecs, string frame_id
    bag.write(connection, 1, struct.pack("<IIII", 1, 2208988800, 5, 0))
PYTHON
cat > read.py <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

from rosbags.highlevel import AnyReader

with AnyReader([Path("out")]) as bag:
    (seconds,) = (bag.deserialize(data, each.msgtype).stamp.sec for each, _, data in bag.messages())
print(f"rosbags {version('rosbags')}: 2208988800 s of ROS 1 is {seconds} s in ROS 2")
sys.exit(seconds != 2208988800 - 2**32)
PYTHON
venv/bin/python make.py
venv/bin/rosbags-convert --src a.bag --dst out
echo "rosbags-convert: exit code 0"
venv/bin/python read.py
