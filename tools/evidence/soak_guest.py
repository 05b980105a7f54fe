"""A short-lived peer of the soak test, in its own process: it connects, behaves well or badly, and disconnects.

    python tools/evidence/soak_guest.py igtl PORT FOLDER SEED MANNER LEAVE SECONDS  an OpenIGTLink client
    python tools/evidence/soak_guest.py ros SEED                                   a ROS 2 node

Manners of a client: ``listen`` reads everything, ``talk`` sends too, ``slow`` reads 64 kB ten times a second, ``deaf``
nothing.  It leaves ``politely``, by ``reset`` (RST), in the ``middle`` of an image that it sends, or is ``killed`` by
the program that started it; until then it continues.  FOLDER has its messages: ``small`` is one small message,
``picture`` one image.

The seed determines all random behaviour of a client.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

# A client starts with `python -I -S`, which finds no package: the offsets of igtl_gateway.wire.header, again.
_DEVICE_NAME, _TICKS_AT = slice(14, 34), 34
_EPOCH_S = 1_000_000_000
_SLOW_BYTES, _SLOW_S = 64 << 10, 0.1
_TALK_S = 0.02
#: A peer whose parent process has ended exits after this time.
_FOREVER_S = 60.0
_DEVICES = 8


def client(port: int, folder: Path, seed: int, manner: str, leave: str, seconds: float) -> None:
    rng = Random(seed)
    link = socket.socket()
    if manner in ("slow", "deaf"):
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SLOW_BYTES)
    link.connect(("127.0.0.1", port))
    small = bytearray((folder / "small").read_bytes())
    small[_DEVICE_NAME] = f"Guest{rng.randrange(_DEVICES)}".encode().ljust(20, b"\0")
    sent = 0
    begun = time.monotonic()
    end = begun + (_FOREVER_S if leave == "killed" else seconds)
    while (now := time.monotonic()) < end:
        if manner == "talk" and now - begun >= sent * _TALK_S:
            sent += 1
            small[_TICKS_AT : _TICKS_AT + 4] = struct.pack(">I", _EPOCH_S + sent)
            link.sendall(small)
        if manner in ("slow", "deaf"):
            time.sleep(min(_SLOW_S, end - now))
            if manner == "deaf":
                continue
        if select.select([link], [], [], _TALK_S)[0] and not link.recv(_SLOW_BYTES if manner == "slow" else 1 << 20):
            return  # the gateway has had enough of it
    match leave:
        case "middle":
            picture = (folder / "picture").read_bytes()
            link.sendall(picture[: rng.randrange(1, len(picture))])
        case "reset":
            link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        case _:
            link.shutdown(socket.SHUT_RDWR)
    link.close()


#: What a node may subscribe to (the gateway's publishers), and publish.
_HEARD = (
    ("/igtl/in/I0_transform/transform", "geometry_msgs", "TransformStamped"),
    ("/igtl/in/I1_transform/transform", "geometry_msgs", "TransformStamped"),
    ("/igtl/in/I0_string_100/string", "std_msgs", "String"),
    ("/igtl/in/Guest0/transform", "geometry_msgs", "TransformStamped"),
    ("/igtl/links", "igtl_msgs", "LinkStatusList"),
    ("/diagnostics", "diagnostic_msgs", "DiagnosticArray"),
)
_SAID = tuple(f"/igtl/out/Visitor{index}" for index in range(3))
_MOST = 4


def node(seed: int) -> None:
    """Until the end of standard input, or a signal."""
    from importlib import import_module

    import rclpy
    from std_msgs.msg import String

    from igtl_gateway.edges.ros.env import prepare_environment

    prepare_environment()
    rng = Random(seed)
    rclpy.init(args=[])
    here = rclpy.create_node(f"soak_guest_{seed}")
    readers: list[Any] = []
    writers: list[Any] = []
    change = 0.0
    os.set_blocking(0, False)
    while not _ended():
        now = time.monotonic()
        if now >= change:
            change = now + rng.expovariate(1.0)
            match rng.randrange(4):
                case 0 if len(readers) < _MOST:
                    topic, package, name = rng.choice(_HEARD)
                    try:
                        kind = getattr(import_module(f"{package}.msg"), name)
                    except ImportError:  # igtl_msgs, where it is not installed
                        continue
                    readers.append(here.create_subscription(kind, topic, lambda _message: None, 10, raw=True))
                case 1 if readers:
                    here.destroy_subscription(readers.pop(rng.randrange(len(readers))))
                case 2 if len(writers) < len(_SAID):
                    writers.append(here.create_publisher(String, rng.choice(_SAID), 10))
                case 3 if writers:
                    here.destroy_publisher(writers.pop(rng.randrange(len(writers))))
        for writer in writers:
            writer.publish(String(data=f"{seed} {now}"))
        rclpy.spin_once(here, timeout_sec=0.1)
    rclpy.shutdown()


def _ended() -> bool:
    try:
        return not os.read(0, 1)
    except BlockingIOError:
        return False


def main(arguments: Sequence[str]) -> int:
    match arguments:
        case ["igtl", port, folder, seed, manner, leave, seconds]:
            try:
                client(int(port), Path(folder), int(seed), manner, leave, float(seconds))
            except OSError:
                return 0  # the gateway closed it, and reports it
            return 0
        case ["ros", seed]:
            node(int(seed))
            return 0
        case _:
            raise SystemExit(__doc__)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
