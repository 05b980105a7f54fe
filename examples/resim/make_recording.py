"""Writes test/session.mcap: a target that a tracker sees for 10 s, 50 times per second.

A recording of your robot takes its place: `igtl-gateway bridge --record session.mcap`, or `ros2 bag record -s mcap`.
"""

import math
import sys

from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message
from igtl_gateway.wire.transform import Transform

gateway = ManualGateway()
gateway.connect()
for number in range(500):
    angle = number / 100
    position = (100 * math.cos(angle), 100 * math.sin(angle), 150 + 20 * math.sin(3 * angle))  # mm
    columns = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, *position)
    gateway.from_peer(Message("TRANSFORM", "TargetToBase", Transform(columns)))
    gateway.advance(0.02)
gateway.save(sys.argv[1] if len(sys.argv) > 1 else "test/session.mcap")
