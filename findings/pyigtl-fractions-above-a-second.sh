#!/bin/sh
# pyigtl, as the C library: a stamp of 32.32 fixed point is read up to 10 ns late, so that stamps of order can decrease.
#
# Guess before the run: the nanoseconds of a fraction are right to one nanosecond, and below a second.
# Expected: fraction / 2^32 s; the largest fraction is 999,999,999.8 ns.
# Found: each bit counts half of the one before, rounded up, so the bits add up to more: the largest fraction is read as
#        1,000,000,010 ns.  A stamp just before a full second is later than that of the second.  Stamps that the same
#        library has written are read without loss, as it writes them the same way, up to 9 ns early.
# Versions: pyigtl 0.3.4, whose conversion is that of igtl_util.c of OpenIGTLink (cf9619e).
# Concerns: who writes stamps as fixed point and compares them, and who takes the rest of a second for less than one.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyigtl==0.3.4 numpy==2.4.6
cat > "$folder/run.py" <<'PYTHON'
import sys

import pyigtl


def read(ticks):
    message = pyigtl.TransformMessage(timestamp=1.0, device_name="Tool")
    header = bytearray(message.pack()[:58])
    header[34:42] = ticks.to_bytes(8, "big")
    return pyigtl.messages.MessageBase.parse_header(bytes(header))["timestamp"]


last, full = read((5 << 32) - 1), read(5 << 32)
print(f"the last stamp before 5 s is read as {last:.9f} s, that of 5 s as {full:.9f} s")
sys.exit(not (last > full and abs(last - 5.000000010) < 1e-9))
PYTHON
"$folder/venv/bin/python" "$folder/run.py"
