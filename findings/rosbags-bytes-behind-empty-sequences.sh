#!/bin/sh
# rosbags: a parameter event as rclpy serializes it is "CDR message size mismatch".
#
# Expected: rosbags decodes what rclpy.serialization writes with rmw_fastrtps_cpp.
# Found: behind empty sequences of 64-bit numbers (int64[], float64[]) rmw_fastrtps_cpp counts an alignment that the
#        message does not have, and what was in memory stays at its end: 8 bytes for one boolean parameter.  rclpy reads
#        the message back; rosbags permits at most 3 bytes and raises a SerdeError, and decodes it without them.
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3, rosbags 0.11.9.
# Concerns: who writes MCAP files or bags with serialize_message() and reads them with tools on top of rosbags.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ros-jazzy-rclpy==7.1.6 \
    ros-jazzy-rmw-fastrtps-cpp==8.4.3 rosbags==0.11.9 numpy
cd "$folder"
export ROS_LOG_DIR="$folder"
cat > try.py <<'PYTHON'
import sys
from importlib.metadata import version

from rcl_interfaces.msg import Parameter, ParameterEvent
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

print("rclpy", version("ros-jazzy-rclpy"), "rosbags", version("rosbags"))
event = ParameterEvent(node="/planner", new_parameters=[Parameter(name="use_sim_time")])
event.new_parameters[0].value.type = 1
data = serialize_message(event)
store, name = get_typestore(Stores.ROS2_JAZZY), "rcl_interfaces/msg/ParameterEvent"
size = len(store.serialize_cdr(store.deserialize_cdr(data[:-8], name), name))
print(len(data), "bytes of rclpy,", size, "of rosbags; behind them:", data[size:].hex())
print("rclpy reads it back:", same := deserialize_message(data, ParameterEvent) == event)
try:
    store.deserialize_cdr(data, name)
    error = ""
except SerdeError as problem:
    error = str(problem)
print("rosbags:", error)
sys.exit(not (same and len(data) - size == 8 and "size mismatch" in error))
PYTHON
venv/bin/python try.py
