#!/bin/sh
# pyigtl: text that is not ASCII cannot be sent, although the code for UTF-8 is there.
#
# Expected: a STRING "Läsion" is sent as UTF-8 with MIBenum 106: "Encode string as ASCII if possible, UTF8 otherwise".
# Found: UnicodeEncodeError, for a STRING and for a value of metadata: the code catches UnicodeDecodeError, which
#        str.encode never raises.  A device name and a key of metadata are always UTF-8 and pass.  Such a STRING of
#        another program is read.
# Versions: pyigtl 0.3.4.
# Concerns: who sends names of patients or places in any language but English with pyigtl.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyigtl==0.3.4 numpy==2.2.6
cat > "$folder/try.py" <<'PYTHON'
import sys

from pyigtl.messages import MessageBase, StringMessage

TEXT = "Läsion"


def packed(string="", device="Text", **metadata):
    message = StringMessage(string, timestamp=1.0, device_name=device)
    message.header_version, message.metadata = 2, metadata
    try:
        return message.pack()
    except UnicodeEncodeError:
        return b""


sent = {
    "STRING": packed(TEXT),
    "value": packed(key=TEXT),
    "key": packed(**{TEXT: "value"}),
    "device name": packed(device=TEXT),
}
data = TEXT.encode()
wire = bytes([0, 106, 0, len(data)]) + data
there = StringMessage()
there._unpack_content(wire)
for what, found in sent.items():
    print(what, "is sent" if found else "is not sent: UnicodeEncodeError")
print("a STRING of MIBenum 106 is read as", there.string)
header = MessageBase.parse_header(sent["device name"][:58])
is_so = [bool(found) for found in sent.values()] == [False, False, True, True]
sys.exit(not is_so or there.string != TEXT or header["device_name"] != TEXT)
PYTHON
"$folder/venv/bin/python" "$folder/try.py"
