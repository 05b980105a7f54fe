"""Two threads that sleep to the same times; with ``wrap``, as root of a namespace, the second has the lower number."""

import sys
import threading
import time
from pathlib import Path

import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("threads")
publisher = node.create_publisher(String, "/out", 100)
node.create_subscription(String, "/in", lambda message: None, 10)


def say(name: str) -> None:
    time.sleep(0.05)
    for number in range(10):
        time.sleep(0.01)
        publisher.publish(String(data=f"{name} {number}"))


if "wrap" in sys.argv:
    kernel = Path("/proc/sys/kernel")
    (kernel / "ns_last_pid").write_text(str(int((kernel / "pid_max").read_text()) - 2))
for name in ("first", "second"):
    threading.Thread(target=say, args=(name,), daemon=True).start()
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    pass
