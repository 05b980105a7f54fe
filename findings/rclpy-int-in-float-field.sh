#!/bin/sh
# rclpy: an int in a float field is published as 5e-324, without an error.
#
# Expected: `message.transform.translation.x = 1` publishes 1.0, or raises: the generated setters check types.
# Found: they check only with ROS_PYTHON_CHECK_FIELDS=1 (or check_fields=True).  Without it the serialiser takes the bytes
#        of the object for those of a float: 1, 1000 and True become 5e-324 in a float64 and 0.0 in a float32 field, and
#        numpy.float32(2.5) becomes 5e-315.  A list of ints in a float64[] field is converted rightly.
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-geometry-msgs and ros-jazzy-std-msgs 5.3.6, ros-jazzy-sensor-msgs 5.3.6.
# Concerns: who fills poses or forces in Python, and who records them: the arm stands at the origin, and nothing is said.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ros-jazzy-rclpy==7.1.6 \
    ros-jazzy-rmw-fastrtps-cpp==8.4.3 ros-jazzy-geometry-msgs==5.3.6 ros-jazzy-std-msgs==5.3.6 \
    ros-jazzy-sensor-msgs==5.3.6 numpy
cd "$folder"
export ROS_LOG_DIR="$folder"
cat > show.py <<'PYTHON'
import numpy
from geometry_msgs.msg import TransformStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32

def received(message):
    return deserialize_message(serialize_message(message), type(message))

for value in (1.0, 1, 1000, True, numpy.float32(2.5)):
    pose, number = TransformStamped(), Float32()
    pose.transform.translation.x = number.data = value
    print(repr(value), received(pose).transform.translation.x, received(number).data)
print(list(received(JointState(position=[1, 2, 3])).position))
PYTHON
found=$(venv/bin/python show.py)
echo "$found"
code=0
ROS_PYTHON_CHECK_FIELDS=1 venv/bin/python show.py > checked.txt 2>&1 || code=$?
echo "with ROS_PYTHON_CHECK_FIELDS=1: exit code $code, $(grep -o 'AssertionError' checked.txt | head -1)"
echo "$found" | grep -q '^1 5e-324 0.0$'
echo "$found" | grep -q '^True 5e-324 0.0$'
echo "$found" | grep -q '^\[1.0, 2.0, 3.0\]$'
test "$code" -ne 0
