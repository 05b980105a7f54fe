#!/bin/sh
# mcap-ros2-support: one event of a service ends the reading of a recording.
#
# Expected: read_ros2_messages decodes what has a definition, or leaves out what it cannot.
# Guess before the run: the event is decoded, its definition is plain ros2msg.
# Found: the name of the type is refused: "'SetBool_Event' is an invalid message name", and with it all messages after it.
#        The rule of rosidl is for names of files; the names of events and feedback (SetBool_Event, Fib_FeedbackMessage)
#        are made by rosidl itself.
# Versions: mcap-ros2-support 0.6.0, mcap 1.6.0.
# Concerns: who reads recordings with service introspection or actions and asks for no topics by name.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mcap-ros2-support==0.6.0 mcap==1.6.0
cd "$folder"
cat > try.py <<'PYTHON'
import sys
from importlib.metadata import version

from mcap.writer import Writer
from mcap_ros2.reader import read_ros2_messages

print("mcap-ros2-support", version("mcap-ros2-support"))
with open("a.mcap", "wb") as stream:
    writer = Writer(stream)
    writer.start("ros2", "try")
    said, event = (
        writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text))
        for topic, kind, text in (
            ("/said", "std_msgs/msg/String", b"string data"),
            ("/switch/_service_event", "std_srvs/srv/SetBool_Event", b"bool[<=1] request"),
        )
    )
    for time, channel, data in ((1, said, b"\2\0\0\0a\0"), (2, event, b"\0\0\0\0"), (3, said, b"\2\0\0\0b\0")):
        writer.add_message(channel, time, b"\0\1\0\0" + data, time)
    writer.finish()
read, error = [], ""
try:
    for message in read_ros2_messages("a.mcap"):
        read.append(message.ros_msg.data)
except Exception as problem:
    error = f"{type(problem).__name__}: {problem}"
print("read:", read, "then:", error)
sys.exit(not (read == ["a"] and "SetBool_Event" in error))
PYTHON
venv/bin/python try.py
