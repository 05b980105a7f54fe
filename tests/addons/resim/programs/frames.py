"""Transforms: listens to /tf and /tf_static, and broadcasts a frame that follows from them.

tf2_ros has no wheels for this Python, so this node does what its listener and broadcaster do: latched subscriptions, a
buffer, one thread of its own that spins the listener, and a look-up that waits.
"""

import threading

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage


class Frames(Node):
    def __init__(self):
        super().__init__("frames")
        self.buffer, self.lock, self.changed = {}, threading.Lock(), threading.Condition()
        self.broadcaster = self.create_publisher(TFMessage, "/tf", 100)
        self.static = self.create_publisher(
            TFMessage, "/tf_static", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )
        fixed = TransformStamped()
        fixed.header.frame_id, fixed.child_frame_id = "tool", "tip"
        fixed.transform.translation.z = 0.2
        self.static.publish(TFMessage(transforms=[fixed]))
        self.create_timer(0.1, self.tick)


class Listener:
    """As tf2_ros.TransformListener with spin_thread=True."""

    def __init__(self, node):
        self.node = node
        group = ReentrantCallbackGroup()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf", self.take, 100, callback_group=group)
        node.create_subscription(TFMessage, "/tf_static", self.take, latched, callback_group=group)

    def take(self, message):
        with self.node.changed:
            for each in message.transforms:
                self.node.buffer[each.child_frame_id] = each
            self.node.changed.notify_all()


def tick(self):
    with self.changed:
        tool, tip = self.buffer.get("tool"), self.buffer.get("tip")
        if not tool or not tip:
            return
        found = TransformStamped(header=tool.header, child_frame_id="needle")
        found.transform.translation.x = tool.transform.translation.x + tip.transform.translation.z
        found.transform.translation.y = tool.transform.translation.y
        found.transform.rotation = tool.transform.rotation
    self.broadcaster.publish(TFMessage(transforms=[found]))


Frames.tick = tick
rclpy.init()
listening = Node("listening")
node = Frames()
listening.buffer, listening.changed = node.buffer, node.changed
Listener(listening)
executor = SingleThreadedExecutor()
executor.add_node(listening)
thread = threading.Thread(target=executor.spin, daemon=True)
thread.start()
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    pass
