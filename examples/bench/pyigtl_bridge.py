"""A bridge of pyigtl and rclpy, as small as possible: transforms both ways, in millimetres and metres, without stamps.

It has nothing of igtl-gateway, and is for its measurements: the number of a message is in its first coordinate.

    igtl-gateway bench --case transform-n --against "python examples/bench/pyigtl_bridge.py {port}"
"""

from __future__ import annotations

import socket
import sys
from typing import Any

import numpy as np
import pyigtl
import rclpy
from geometry_msgs.msg import TransformStamped

SENT, RECEIVED = "R0_transform_n", "I0_transform_n"


class Server(pyigtl.OpenIGTLinkServer):
    """pyigtl's server, which otherwise does not notice that a peer has left, and serves no other."""

    def _receive_message_from_socket(self, peer: socket.socket) -> Any:
        try:
            if not peer.recv(1, socket.MSG_PEEK):
                raise ConnectionError("the peer has left")
        except TimeoutError:
            return False
        return super()._receive_message_from_socket(peer)


def matrix_of(message: TransformStamped) -> np.ndarray:
    """Return rotation and translation (mm) as 4 x 4 numbers."""
    t, q = message.transform.translation, message.transform.rotation
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), 1000 * t.x],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), 1000 * t.y],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), 1000 * t.z],
            [0, 0, 0, 1],
        ]
    )


def message_of(matrix: np.ndarray) -> TransformStamped:
    """Return the message of a matrix whose rotation is by less than half a turn; its stamp is not set."""
    message = TransformStamped()
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = (float(value) / 1000 for value in matrix[:3, 3])
    rotation.w = float(np.sqrt(1 + np.trace(matrix[:3, :3])) / 2)
    rotation.x = float(matrix[2, 1] - matrix[1, 2]) / (4 * rotation.w)
    rotation.y = float(matrix[0, 2] - matrix[2, 0]) / (4 * rotation.w)
    rotation.z = float(matrix[1, 0] - matrix[0, 1]) / (4 * rotation.w)
    return message


def main() -> None:
    """Serve one peer on the port that is the first argument."""
    rclpy.init()
    node = rclpy.create_node("pyigtl_bridge")
    server = Server(int(sys.argv[1]))

    def to_peer(message: TransformStamped) -> None:
        server.send_message(pyigtl.TransformMessage(matrix_of(message), device_name=SENT, timestamp=0), wait=False)

    def to_ros() -> None:
        for message in server.get_latest_messages():
            if message.device_name == RECEIVED:
                publisher.publish(message_of(message.matrix))

    node.create_subscription(TransformStamped, f"/igtl/out/{SENT}", to_peer, 100)
    publisher = node.create_publisher(TransformStamped, f"/igtl/in/{RECEIVED}/transform", 100)
    node.create_timer(0.001, to_ros)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        server.stop()


if __name__ == "__main__":
    main()
