"""A loop of asyncio that spins a node now and then, without a wait, and answers each message 5 ms later.

"coarse": with a clock of the loop so coarse that a deadline is equal to the time at which it is looked at.
"""

import asyncio
import sys

import rclpy
from rclpy.node import Node
from std_msgs.msg import String


class Answers(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("asynchronous")
        self.publisher = self.create_publisher(String, "/out", 10)
        self.create_subscription(String, "/in", lambda message: self.coming.put_nowait(message.data), 10)
        self.create_timer(0.1, lambda: self.publisher.publish(String(data="tick")))
        self.coming: asyncio.Queue[str] = asyncio.Queue()

    async def spin(self) -> None:
        while rclpy.ok():
            rclpy.spin_once(self, timeout_sec=0)
            await asyncio.sleep(0.002)

    async def answer(self) -> None:
        while True:
            text = await self.coming.get()
            await asyncio.sleep(0.005)
            self.publisher.publish(String(data=f"{text} {self.get_clock().now().nanoseconds}"))


async def main() -> None:
    loop = asyncio.get_running_loop()
    if "coarse" in sys.argv:
        fine = loop.time
        loop.time = lambda: fine() * 500 // 1 / 500  # type: ignore[method-assign]
        loop._clock_resolution = 0.0  # type: ignore[attr-defined]
    rclpy.init()
    node = Answers()
    await asyncio.gather(node.spin(), node.answer())


try:
    asyncio.run(main())
except KeyboardInterrupt:
    pass
