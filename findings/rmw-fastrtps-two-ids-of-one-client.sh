#!/bin/sh
# rmw_fastrtps_cpp: the events of one call have one identifier of the client at the client, and another at the server.
#
# Expected: service_msgs/ServiceEventInfo says of the number of the sequence: "Combined with the client ID, this creates a
#        unique ID for the service transaction", so the four events of a call have the same ones.
# Guess before the run: four events, one identifier.
# Found: the two events of the client have the identifier of one endpoint, the two of the server that of another one.
#        Numbers of the sequence are equal.  Joined by both, each call looks like two.
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3.
# Concerns: who counts calls, or pairs requests with responses, in recordings of both sides of a service.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ros-jazzy-rclpy==7.1.6 \
    ros-jazzy-rmw-fastrtps-cpp==8.4.3 ros-jazzy-std-srvs==5.3.6 numpy
cd "$folder"
export ROS_LOG_DIR="$folder" ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
cat > try.py <<'PYTHON'
import sys
from importlib.metadata import version

import rclpy
from rclpy.qos import qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from std_srvs.srv import Trigger

print("rclpy", version("ros-jazzy-rclpy"))
rclpy.init(domain_id=93)
node, events = rclpy.create_node("both"), []
node.create_subscription(Trigger.Event, "/go/_service_event", events.append, 10)
service = node.create_service(Trigger, "/go", lambda _, answer: answer)
client = node.create_client(Trigger, "/go")
for each in (service, client):
    each.configure_introspection(node.get_clock(), qos_profile_system_default, ServiceIntrospectionState.METADATA)
client.wait_for_service()
for _ in range(20):
    rclpy.spin_once(node, timeout_sec=0.05)
future = client.call_async(Trigger.Request())
for _ in range(200):
    rclpy.spin_once(node, timeout_sec=0.05)
    if len(events) == 4:
        break
ids = {}
for event in events:
    info = event.info
    side = "server" if info.event_type in (info.REQUEST_RECEIVED, info.RESPONSE_SENT) else "client"
    ids.setdefault(side, set()).add((bytes(info.client_gid).hex(), info.sequence_number))
    print(side, info.event_type, bytes(info.client_gid).hex(), info.sequence_number)
one, other = ids["client"], ids["server"]
sys.exit(not (len(events) == 4 and len(one) == len(other) == 1 and one != other))
PYTHON
venv/bin/python try.py
