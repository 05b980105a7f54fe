#!/bin/sh
# rclpy: the result of an action that is asked for too late is an empty one, without an error.
#
# Expected (guess): after the server's result_timeout the future of get_result_async() fails, or does not complete.
# Found: it completes with status 0 (STATUS_UNKNOWN) and a result whose fields have their defaults, as of a goal that the
#        server never had.  The client's GoalHandle is still "accepted"; nothing is logged.
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3, ros-jazzy-test-msgs 2.0.3; the default of the timeout
#           is 900 s there, and 10 s in rclpy 9.1.2 of Kilted.
# Concerns: clients that use `result` without a look at `status`: an empty path, or zeros, are taken for the result; and
#           who answers for a recorded server: no answer is better than such a one.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ros-jazzy-rclpy==7.1.6 \
    ros-jazzy-rmw-fastrtps-cpp==8.4.3 ros-jazzy-test-msgs==2.0.3 numpy
cd "$folder"
export ROS_LOG_DIR="$folder" ROS_DOMAIN_ID=97 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
cat > show.py <<'PYTHON'
import os
import threading
import time

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from test_msgs.action import Fibonacci

def work(goal):
    goal.succeed()
    return Fibonacci.Result(sequence=[1, 2, 3])

def wait(future):
    until = time.monotonic() + 20
    while not future.done() and time.monotonic() < until:
        time.sleep(0.02)
    return future.result()

rclpy.init()
node = Node("both")
server = ActionServer(node, Fibonacci, "/fib", work, result_timeout=1)
client = ActionClient(node, Fibonacci, "/fib")
executor = MultiThreadedExecutor(4)
executor.add_node(node)
threading.Thread(target=executor.spin, daemon=True).start()
client.wait_for_server()
for late_s in (0, 3):
    goal = wait(client.send_goal_async(Fibonacci.Goal(order=3)))
    time.sleep(late_s)
    found = wait(goal.get_result_async())
    print(f"after {late_s} s: accepted {goal.accepted}, status {found.status}, {list(found.result.sequence)}", flush=True)
os._exit(0)
PYTHON
venv/bin/python show.py > found.txt
cat found.txt
grep -q '^after 0 s: accepted True, status 4, \[1, 2, 3\]$' found.txt
grep -q '^after 3 s: accepted True, status 0, \[\]$' found.txt
