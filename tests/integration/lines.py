"""The keeper of two network namespaces and of the lines between them, as a program of its own.

usage: lines.py LINES   (as root; 0 lines: the namespaces only)

Line ``i`` has the network 10.77.i.0/24: .1 is its near end, .2 its far end, both called ``line<i>``.  Each end is a TUN
device, and this program carries the IP packets from one to the other, with the given weather.  So both ends are
the kernel's own TCP, and retransmissions, duplicates and backoff are real.  Weather is as that of ``tc netem``: a
packet that is chosen for reordering goes without its delay, and so overtakes those that wait.

One JSON object per line.  First on stdout ``{"near": FD, "far": FD}``, descriptors of the namespaces in this process,
or ``{"failed": text}``.  Then on stdin ``{"line": i, …}`` with any of ``delay_s``, ``jitter_s``, ``loss``,
``reorder`` (shares from 0 to 1), ``down``, ``rate`` and ``queue``, answered by what the line has carried so far.

Namespaces and devices are gone with this process, however it ends; it ends with its stdin.
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import socket
import struct
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

CLONE_NEWNET = 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_SIOCSIFADDR, _SIOCSIFNETMASK, _SIOCGIFFLAGS, _SIOCSIFFLAGS = 0x8916, 0x891C, 0x8913, 0x8914
_IFF_UP = 1
_PACKET_BYTES = 1 << 16


_libc = ctypes.CDLL(None, use_errno=True)


def enter(namespace: int) -> None:
    """Move this thread into a network namespace."""
    check(_libc.setns(ctypes.c_int(namespace), CLONE_NEWNET))


def check(code: int) -> None:
    """Raise the OSError of a call into libc."""
    if code:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def new_namespace() -> int:
    """Move this process into a network namespace of its own, with ``lo`` up; its descriptor."""
    check(_libc.unshare(CLONE_NEWNET))
    bring_up("lo")
    return os.open("/proc/self/ns/net", os.O_RDONLY)


def bring_up(device: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        told = fcntl.ioctl(sock, _SIOCGIFFLAGS, struct.pack("16sh22x", device.encode(), 0))
        (flags,) = struct.unpack_from("h", told, 16)
        fcntl.ioctl(sock, _SIOCSIFFLAGS, struct.pack("16sh22x", device.encode(), flags | _IFF_UP))


def tun(device: str, address: str) -> int:
    """A TUN device in this namespace, up, with that address in a network of 256."""
    handle = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(handle, _TUNSETIFF, struct.pack("16sH22x", device.encode(), _IFF_TUN | _IFF_NO_PI))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for request, value in ((_SIOCSIFADDR, address), (_SIOCSIFNETMASK, "255.255.255.0")):
            place = struct.pack("HH4s8x", socket.AF_INET, 0, socket.inet_aton(value))
            fcntl.ioctl(sock, request, struct.pack("16s16s8x", device.encode(), place))
    bring_up(device)
    return handle


@dataclass
class Line:
    """Two ends and the weather between them."""

    ends: tuple[int, int]
    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    reorder: float = 0.0
    down: bool = False
    rate: float = 0.0  # bytes per second each way; 0: no limit
    queue: float = 65_536  # bytes that wait at that rate; more are lost, as in a router
    free_s: dict[int, float] = field(default_factory=dict)  # by end: when it has carried all that waits
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(("carried", "lost", "early", "blocked"), 0))

    def fate(self, chance: random.Random, end: int, size: int, now: float) -> float | None:
        """How long a packet of ``size`` bytes is on its way from an end; None if it does not arrive."""
        if self.down:
            self.counts["blocked"] += 1
            return None
        if chance.random() < self.loss:
            self.counts["lost"] += 1
            return None
        queued_s = 0.0
        if self.rate:
            free_s = max(self.free_s.get(end, 0.0), now)
            if (free_s - now) * self.rate > self.queue:
                self.counts["lost"] += 1
                return None
            self.free_s[end] = free_s + size / self.rate
            queued_s = self.free_s[end] - now
        self.counts["carried"] += 1
        if chance.random() < self.reorder:
            self.counts["early"] += 1
            return 0.0
        return queued_s + max(0.0, self.delay_s + chance.uniform(-self.jitter_s, self.jitter_s))


def carry(lines: list[Line]) -> None:
    """Until the end of stdin."""
    chance = random.Random(7)
    ways = {line.ends[side]: (line, line.ends[1 - side]) for line in lines for side in (0, 1)}
    waiting: list[tuple[float, int, int, bytes]] = []  # when, number, to which end, packet
    number = 0
    poll = select.poll()
    for handle in (*ways, 0):
        poll.register(handle, select.POLLIN)
    while True:
        timeout = None if not waiting else max(0.0, waiting[0][0] - time.monotonic()) * 1000
        for handle, _ in poll.poll(timeout):
            if handle == 0:
                words = sys.stdin.buffer.readline()
                if not words:
                    return
                say(obey(lines, json.loads(words)))
                continue
            line, other = ways[handle]
            now = time.monotonic()
            while packet := received(handle):
                delay = line.fate(chance, handle, len(packet), now)
                if delay is not None:
                    number += 1
                    heapq.heappush(waiting, (now + delay, number, other, packet))
        now = time.monotonic()
        while waiting and waiting[0][0] <= now:
            _, _, end, packet = heapq.heappop(waiting)
            try:
                os.write(end, packet)
            except OSError:
                pass  # its queue is full, as a router's may be


def received(handle: int) -> bytes:
    try:
        return os.read(handle, _PACKET_BYTES)
    except BlockingIOError:
        return b""


def obey(lines: list[Line], words: dict[str, Any]) -> dict[str, int]:
    line = lines[int(words.pop("line"))]
    for name, value in words.items():
        setattr(line, name, value)
    return line.counts


def say(words: dict[str, Any]) -> None:
    print(json.dumps(words), flush=True)  # noqa: T201 (the protocol)


def main() -> None:
    count = int(sys.argv[1])
    try:
        near = new_namespace()
        # only the silence of a dead end reveals that it is dead: no ICMP error
        ends = [tun(f"line{index}", f"10.77.{index}.1") for index in range(count)]
        far = new_namespace()
        others = [tun(f"line{index}", f"10.77.{index}.2") for index in range(count)]
    except OSError as error:
        say({"failed": f"{error.strerror}{f' ({error.filename})' if error.filename else ''}"})
        return
    say({"near": near, "far": far, "root": str(Path("/proc", str(os.getpid()), "fd"))})
    carry([Line(pair) for pair in zip(ends, others, strict=True)])


if __name__ == "__main__":
    main()
