"""Answer the questions of a gateway (`--clock-from`) for the clock of this host, with Python alone.

python clock.py HOST [PORT]

With 3D Slicer, run it beside it: `PythonSlicer clock.py HOST`.
"""

import socket
import struct
import sys
import time

HEADER = struct.Struct(">H12s20sQQQ")  # version, type, device, time stamp, size and CRC of the body
BODY = struct.pack(">Hq20s1s", 1, 0, b"", b"")  # a STATUS that is OK
CRC = 0x4EB66A467286AFA6


def answer(host, port):
    with socket.create_connection((host, port)) as link, link.makefile("rb") as stream:
        print(f"answers {host}:{port}", flush=True)
        while len(head := stream.read(HEADER.size)) == HEADER.size:
            _, kind, device, _, size, _ = HEADER.unpack(head)
            stream.read(size)
            if kind.rstrip(b"\0") == b"GET_STATUS":
                stamp = (time.time_ns() << 32) // 1_000_000_000
                link.sendall(HEADER.pack(1, b"STATUS", device, stamp, len(BODY), CRC) + BODY)


if __name__ == "__main__":
    answer(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 18944)
