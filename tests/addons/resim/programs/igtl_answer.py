"""A pyigtl client: answers each TRANSFORM with one that is moved by 1 mm, or by a random distance (``random``).

Other arguments: ``faulty`` programs, see `main`.
"""

import ctypes
import os
import platform
import random
import signal
import socket
import subprocess
import sys
import threading
import time

import pyigtl

#: Called as it is, so that nothing replaces it.
NANOSLEEP = 35 if platform.machine() == "x86_64" else 101


def turn() -> None:
    """Compute now and then, in real time."""
    libc = ctypes.CDLL(None)
    for _ in range(100):
        sum(range(300_000))
        libc.syscall(NANOSLEEP, (ctypes.c_long * 2)(0, 3_000_000), None)


def main(kind: str) -> None:
    """Connect to the address of the environment, and answer."""
    address = os.environ["IGTL_HOST"], int(os.environ["IGTL_PORT"])
    if kind == "never":
        time.sleep(3600)
    if kind in ("close", "garbage", "flood", "hang", "sleep", "crc", "elsewhere", "is killed"):
        made = socket.socket()
        if kind == "elsewhere":
            time.sleep(3600)
        made.connect(address)
        made.recv(106)
        if kind == "close":
            made.close()
            time.sleep(3600)
        if kind == "garbage":
            made.sendall(b"GET / HTTP/1.1\r\nHost: here\r\n\r\n" * 10)
            time.sleep(3600)
        data = pyigtl.StringMessage("much", device_name="Flood").pack()
        if kind == "is killed":
            made.sendall(3 * data)
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "crc":
            made.sendall(data[:50] + bytes(8) + data[58:])
        if kind in ("sleep", "crc"):
            signal.pause()
        while True:
            if kind == "flood":
                made.sendall(100 * data)
    client = pyigtl.OpenIGTLinkClient(*address)
    if kind == "datagrams":
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM).close()
    if kind == "elsewhere too":
        socket.socket().connect_ex((address[0], 9))
    if kind == "twice":
        client.wait_for_message("Tool")
        client = pyigtl.OpenIGTLinkClient(*address)
    if kind == "spawns":
        client.wait_for_message("Tool")
        subprocess.run(["sleep", "1000"], check=False)
    if kind == "apart":
        threading.Thread(target=turn, daemon=True).start()
    while True:
        message = client.wait_for_message("Tool")
        if kind == "talks":
            os.write(1, bytes(300_000))
        matrix = message.matrix.copy()
        matrix[0, 3] += random.random() if kind == "random" else 1.0
        client.send_message(pyigtl.TransformMessage(matrix, device_name="Answer"))


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "")
