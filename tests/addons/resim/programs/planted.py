"""A node with one thing that is not the same in every run; the argument states which."""

import ctypes
import random
import select
import sys
import threading
import time

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String


class Planted(Node):  # type: ignore[misc]
    def __init__(self, what: str) -> None:
        super().__init__("planted")
        self.publisher = self.create_publisher(String, "/out", 10)
        self.count = self.total = self.ticks = 0
        self.work = getattr(self, what)
        self.create_subscription(String, "/in", self.take, 10)
        if what == "joints":
            states = self.create_publisher(JointState, "/joints", 10)
            state = JointState(name=["a"], position=[1.0])
            state.header.frame_id = "base"
            self.create_subscription(String, "/in", lambda message: states.publish(state), 10)
        if what in ("timer", "samples"):
            self.create_timer(0.007, self.tick)

    def take(self, message: String) -> None:
        self.count += 1
        # the first messages are equal in all runs
        text = self.work(message.data) if self.count > 20 else message.data
        self.publisher.publish(String(data=text))

    def nothing(self, text: str) -> str:
        return text

    joints = nothing

    def wall(self, text: str) -> str:
        return f"{text} at {time.time():.3f}"

    def chance(self, text: str) -> str:
        return f"{text} {random.random():.6f}"

    def hashed(self, text: str) -> str:
        return " ".join({text, f"{text}-left", f"{text}-right"})

    def race(self, text: str) -> str:
        """Two threads write to one list, without a lock between them."""
        found: list[object] = []

        def write(name: str) -> None:
            for number in range(200):
                found.append(f"{name}{number}")
                sum(range(3000))

        threads = [threading.Thread(target=write, args=(name,)) for name in "ab"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return f"{text} {found[150:250]}"

    def waits(self, text: str) -> str:
        """Waits of C with a timeout of 3 ms, and what the steady clock shows of each, in ms."""
        libc = ctypes.CDLL(None)
        limit = (ctypes.c_long * 2)(0, 3_000_000)
        epoll = select.epoll()
        found: list[object] = []
        for wait in (
            lambda: libc.ppoll(None, ctypes.c_ulong(0), limit, None),
            lambda: libc.pselect(0, None, None, None, limit, None),
            lambda: libc.epoll_pwait(epoll.fileno(), (ctypes.c_char * 12)(), 1, 3, None),
            lambda: libc.epoll_pwait2(epoll.fileno(), (ctypes.c_char * 12)(), 1, limit, None),
            lambda: libc.sigtimedwait(ctypes.byref(ctypes.c_ulong(1 << 9)), None, limit),  # SIGUSR1
        ):
            began = time.monotonic_ns()
            found.append(wait())  # type: ignore[no-untyped-call]
            found.append((time.monotonic_ns() - began) / 1e6)
        return f"{text} {found}"

    def tick(self) -> None:
        self.ticks += 1
        if self.work == self.samples:
            self.publisher.publish(String(data=f"{self.count} by tick {self.ticks}"))

    def timer(self, text: str) -> str:
        return f"{text} {self.ticks}"

    def samples(self, text: str) -> str:
        return text


rclpy.init()
try:
    rclpy.spin(Planted(sys.argv[1]))
except KeyboardInterrupt:
    pass
