"""Answer the questions of a gateway (`--clock-from`) for the clock of this host, with Python alone.

python clock.py HOST [PORT]

With 3D Slicer, run it beside it: `PythonSlicer clock.py HOST`.  It connects again until it is stopped.
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
    print(f"{host}:{port} has closed the connection; trying again", flush=True)


def run(host, port):
    before = None
    while True:
        try:
            answer(host, port)
            before = None
        except OSError as error:
            if str(error) != before:
                print(f"{host}:{port}: {error}; trying again", flush=True)
            before = str(error)
        time.sleep(1)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3) or not all(port.isdecimal() for port in sys.argv[2:]):
        sys.exit("usage: python clock.py HOST [PORT]")
    try:
        run(sys.argv[1], int((sys.argv[2:] or ["18944"])[0]))
    except KeyboardInterrupt:
        pass
