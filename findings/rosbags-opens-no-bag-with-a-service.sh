#!/bin/sh
# rosbags: AnyReader opens no message of a bag in which rosbag2 has recorded one service.
#
# Expected: AnyReader reads the other topics of the bag; of the events at most the definition is missing.
# Guess before the run: an error of the parser at the "---" of the .srv text, and no error with the definition of the
#        event itself and its hash.
# Found: rosbag2 writes the .srv file where the definition of the event would be.  With types of other files its encoding
#        is "ros2msg": "Could not parse".  Without, it is "unknown": KeyError.  With the definition of the event itself and
#        the hash of rosidl: KeyError, too, because rosbags knows the type as std_srvs/srv/msg/Trigger_Event.  Without the
#        hash it opens.
# Versions: rosbags 0.11.9, mcap 1.6.0; texts as rosbag2 0.26 writes them.
# Concerns: who reads recordings of rosbag2 with services (--all-services, and --all since Kilted) with tools on rosbags.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rosbags==0.11.9 mcap==1.6.0
cd "$folder"
cat > try.py <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

from mcap.writer import Writer
from rosbags.highlevel import AnyReader

RULE = "=" * 80 + "\n"
HASH = "RIHS01_ec4a1d26b0575e61906890342aba9523a2360e9845857c5590fa6e23bc39e1c2"  # of ros-jazzy-std-srvs 5.3.6
SRV = "---\nbool success\nstring message\n"
OF_RESPONSE, OF_INFO = "bool success\nstring message\n", "uint8 event_type\nuint8[16] client_gid\nint64 sequence_number\n"
FIELDS = "service_msgs/ServiceEventInfo info\nstd_srvs/Trigger_Request[<=1] request\nstd_srvs/Trigger_Response[<=1] response\n"
EVENT = (
    f"{FIELDS}{RULE}MSG: std_srvs/Trigger_Request\n{RULE}MSG: std_srvs/Trigger_Response\n{OF_RESPONSE}"
    f"{RULE}MSG: service_msgs/ServiceEventInfo\n{OF_INFO}"
)
#: Both topics; of the service with the hash of its type.
METADATA = """rosbag2_bagfile_information:
  version: 8
  storage_identifier: mcap
  duration: {{nanoseconds: 0}}
  starting_time: {{nanoseconds_since_epoch: 1}}
  message_count: 1
  topics_with_message_count:
    - topic_metadata: {{name: /said, type: std_msgs/msg/String, serialization_format: cdr, offered_qos_profiles: "",
        type_description_hash: ""}}
      message_count: 1
    - topic_metadata: {{name: /go/_service_event, type: std_srvs/srv/Trigger_Event, serialization_format: cdr,
        offered_qos_profiles: "", type_description_hash: "{}"}}
      message_count: 0
  compression_format: ""
  compression_mode: ""
  relative_file_paths: [a.mcap]
  files: [{{path: a.mcap, starting_time: {{nanoseconds_since_epoch: 1}}, duration: {{nanoseconds: 0}}, message_count: 1}}]
  custom_data: null
  ros_distro: jazzy
"""
CASES = {
    "unknown": ("unknown", f"{RULE}SRV: std_srvs/srv/Trigger\n{SRV}", ""),
    "ros2msg": ("ros2msg", f"{RULE}SRV: std_srvs/srv/Trigger\n{SRV}", ""),
    "event, with hash": ("ros2msg", EVENT, HASH),
    "event": ("ros2msg", EVENT, ""),
}


def opened(name: str) -> str:
    encoding, text, type_hash = CASES[name]
    folder = Path(name)
    folder.mkdir()
    with (folder / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "try")
        said = writer.register_channel("/said", "cdr", writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data"))
        schema = writer.register_schema("std_srvs/srv/Trigger_Event", encoding, text.encode())
        writer.register_channel("/go/_service_event", "cdr", schema, {"topic_type_hash": type_hash})
        writer.add_message(said, 1, b"\0\1\0\0\2\0\0\0a\0", 1)
        writer.finish()
    (folder / "metadata.yaml").write_text(METADATA.format(type_hash))
    try:
        with AnyReader([folder]) as reader:
            return f"{sum(1 for _ in reader.messages())} message"
    except Exception as error:
        return f"{type(error).__name__}: {str(error).splitlines()[0][:60]}"


print("rosbags", version("rosbags"))
found = {name: opened(name) for name in CASES}
for name, result in found.items():
    print(f"{name:<18}{result}")
bad = [name for name, result in found.items() if result != "1 message"]
sys.exit(bad != ["unknown", "ros2msg", "event, with hash"])
PYTHON
venv/bin/python try.py
