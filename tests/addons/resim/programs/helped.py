"""A node that other processes help, or that another process starts; the argument states which."""

import multiprocessing
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.connection import Connection
from multiprocessing.pool import ThreadPool
from multiprocessing.shared_memory import SharedMemory

import rclpy
from rclpy.node import Node
from std_msgs.msg import String


def square(number: int) -> int:
    """It takes its time."""
    return sum(number for _ in range(100_000)) // 100_000 * number


def push(there: Connection) -> None:
    while True:
        time.sleep(0.02)
        there.send("pushed")


class Helped(Node):  # type: ignore[misc]
    def __init__(self, what: str) -> None:
        super().__init__("helped")
        self.publisher = self.create_publisher(String, "/out", 10)
        self.count = 0
        self.ask: Callable[[int], int] = getattr(self, what)()
        self.create_subscription(String, "/in", self.take, 10)

    def take(self, message: String) -> None:
        self.count += 1
        self.publisher.publish(String(data=f"{message.data} {self.ask(self.count)}"))

    def none(self) -> Callable[[int], int]:
        return square

    def idle(self) -> Callable[[int], int]:
        """A filter that answers what it is asked, and a fork that waits forever."""
        self.filter = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        if not os.fork():
            os.read(os.pipe()[0], 1)

        def ask(number: int) -> int:
            assert self.filter.stdin and self.filter.stdout
            self.filter.stdin.write(f"{square(number)}\n")
            return int(self.filter.stdout.readline())

        return ask

    def memory(self) -> Callable[[int], int]:
        """Python starts a tracker of such resources."""
        self.shared = SharedMemory(create=True, size=64)
        return square

    def pool(self) -> Callable[[int], int]:
        self.processes = ProcessPoolExecutor(2)
        return lambda number: next(iter(self.processes.map(square, [number, 3])))

    def later(self) -> Callable[[int], int]:
        """The answer is there when the next message comes."""
        self.processes = ProcessPoolExecutor(1)
        self.asked: list[Future[int]] = []

        def ask(number: int) -> int:
            found = sum(each.result() for each in self.asked if each.done())
            self.asked = [self.processes.submit(square, number)]
            return found

        return ask

    def threads(self) -> Callable[[int], int]:
        """Its threads poll without a timeout until time passes."""
        self.workers = ThreadPool(2)
        return lambda number: self.workers.map(square, [number, 3])[0]

    def pushes(self) -> Callable[[int], int]:
        here, there = multiprocessing.Pipe()
        multiprocessing.Process(target=push, args=(there,), daemon=True).start()

        def read() -> None:
            while True:
                self.publisher.publish(String(data=here.recv()))

        threading.Thread(target=read, daemon=True).start()
        return square


if __name__ == "__main__":
    if sys.argv[1] == "launch":
        sys.exit(subprocess.run([sys.executable, __file__, "none"], check=False).returncode)
    rclpy.init()
    try:
        rclpy.spin(Helped(sys.argv[1]))
    except KeyboardInterrupt:
        pass
