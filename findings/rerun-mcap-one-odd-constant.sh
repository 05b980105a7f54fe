#!/bin/sh
# rerun: one constant in octal hides all topics of an MCAP file, with exit code 0.
#
# Expected: `rerun mcap convert` reads the topics whose definitions it can parse, and names the one that it cannot.
# Found: `uint8 MODE=0o17` in the definition of /b, which rosidl accepts (as it does `bool OFF=False`), and neither /b
#        nor /a is in the result.  The program reports success.
# Versions: rerun-sdk 0.41.0; the file is written with mcap 1.6.0.  The control has `uint8 MODE=15`.
# Concerns: who opens bags of ROS 2 in rerun; whose definitions are those of the package, byte for byte.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check rerun-sdk==0.41.0 mcap==1.6.0
cd "$folder"
cat > make.py <<'PYTHON'
import struct
from mcap.writer import Writer

for name, constant in (("control", "15"), ("octal", "0o17")):
    with open(f"{name}.mcap", "wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for topic, kind, text in (
            ("/a", "std_msgs/msg/Float64", "float64 data\n"),
            ("/b", "lab_msgs/msg/State", f"uint8 MODE={constant}\nfloat64 data\n"),
        ):
            channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text.encode()))
            for number in range(1, 4):
                writer.add_message(channel, number, b"\0\1\0\0" + struct.pack("<d", number), number)
        writer.finish()
PYTHON
venv/bin/python make.py
venv/bin/rerun --version
codes="" seen=""
for name in control octal; do
    code=0
    venv/bin/rerun mcap convert "$name.mcap" -o "$name.rrd" > "$name.txt" 2>&1 || code=$?
    found=$(grep -oE '/[ab],' "$name.txt" | sort -u | tr -d ',\n' || true)
    echo "$name: exit code $code, topics in the result: ${found:-none}"
    codes="$codes$code " seen="$seen${found:-none} "
done
test "$codes" = "0 0 " && test "$seen" = "/a/b none "
