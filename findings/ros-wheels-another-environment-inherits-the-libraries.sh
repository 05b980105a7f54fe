#!/bin/sh
# ROS wheels: a program of one environment cannot start rclpy of another environment.
#
# Expected: each environment finds its own libraries, whoever starts its Python.
#           Guess before the run: it works, as the wheels set the paths at each start.
# Found: the first Python sets LD_LIBRARY_PATH and a mark (_ROS_WHEELS_BOOTSTRAP_COMPLETE), and children inherit both.  For
#        the mark, the other environment does not set its own paths, and rclpy "failed to be imported while being
#        present on the system".  Without the mark it works.
# Versions: ros-jazzy-rclpy 7.1.6 and ros-kilted-rclpy 9.1.2, each with its rmw-fastrtps-cpp (8.4.3, 9.3.3).
# Concerns: who compares two distributions of ROS 2 from one program, or starts tools of other environments from a node.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for distribution in jazzy kilted; do
    test $distribution = jazzy && versions="7.1.6 8.4.3" || versions="9.1.2 9.3.3"
    python3 -m venv "$folder/$distribution"
    "$folder/$distribution/bin/pip" install --quiet --disable-pip-version-check \
        "ros-$distribution-rclpy==${versions% *}" "ros-$distribution-rmw-fastrtps-cpp==${versions#* }" numpy
done
cd "$folder"
export ROS_LOG_DIR="$folder"
cat > other.py <<'PYTHON'
import os
import subprocess

START = ["kilted/bin/python", "-c", "import rclpy; rclpy.init(); print('started')"]
for name in ("as it is", "without the mark"):
    env = dict(os.environ)
    if name == "without the mark":
        env = {key: value for key, value in env.items() if key not in ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH")}
    ended = subprocess.run(START, env=env, capture_output=True, text=True)
    reason = [line for line in ended.stderr.splitlines() if "failed to be imported" in line]
    print(f"{name}: exit code {ended.returncode}", ended.stdout.strip(), "failed to be imported" * bool(reason))
PYTHON
found=$(jazzy/bin/python other.py)
echo "$found"
echo "$found" | grep -q '^as it is: exit code 1 .*failed to be imported$'
echo "$found" | grep -q '^without the mark: exit code 0 started'
