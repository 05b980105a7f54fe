"""An independent OpenIGTLink client (pyigtl): sends the messages of an ultrasound machine, prints what it receives.

usage: python -m igtl_gateway_lab.demo.igtl_client PORT SECONDS
"""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

import numpy as np
import pyigtl

_RATE_HZ = 20.0
_LOOKS = 5


def main() -> None:
    port, seconds = int(sys.argv[1]), float(sys.argv[2])
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
    pace = threading.Event()
    while not client.is_connected():
        pace.wait(0.05)
    print(json.dumps({"event": "ready"}), flush=True)
    sent: dict[str, int] = {}
    heard: dict[str, dict[str, Any]] = {}
    matrix = np.eye(4)
    for tick in range(int(seconds * _RATE_HZ)):
        matrix[:3, 3] = (10.0 + tick, -20.0, 30.5)
        _send(client, pyigtl.TransformMessage(matrix.copy(), device_name="ProbeToTracker"), sent)
        if tick % 4 == 0:
            voxels = np.arange(64 * 48, dtype=np.uint32).reshape(1, 48, 64).astype(np.uint8)
            _send(client, pyigtl.ImageMessage(voxels, device_name="Ultrasound"), sent)
        if tick % 20 == 0:
            _send(client, pyigtl.StringMessage(f"hello from the operator, tick {tick}", device_name="Operator"), sent)
            points = [[10.0, 15.0, 20.0], [25.0, 30.0, 35.0], [-40.0, 45.0, -50.0]]
            _send(client, pyigtl.PointMessage(positions=points, device_name="Landmarks"), sent)
        # pyigtl keeps the newest message of each name only: look often, or miss some
        for _ in range(_LOOKS):
            pace.wait(1.0 / _RATE_HZ / _LOOKS)
            _look(client, heard)
    print(json.dumps({"event": "summary", "sent": sent, "received": heard}), flush=True)
    client.stop()


def _look(client: Any, heard: dict[str, dict[str, Any]]) -> None:
    for message in client.get_latest_messages():
        entry = heard.setdefault(f"{message.message_type} {message.device_name}", {"messages": 0, "last": ""})
        entry["messages"] += 1
        entry["last"] = _shown(message)


def _send(client: Any, message: Any, sent: dict[str, int]) -> None:
    client.send_message(message)
    sent[message.device_name] = sent.get(message.device_name, 0) + 1


def _shown(message: Any) -> str:
    """The message in a few words."""
    if isinstance(message, pyigtl.TransformMessage):
        x, y, z = message.matrix[:3, 3]
        return f"at ({x:.2f}, {y:.2f}, {z:.2f}) mm"
    if isinstance(message, pyigtl.ImageMessage):
        return f"array {message.image.shape} {message.image.dtype}"
    if isinstance(message, pyigtl.PointMessage):
        return f"points {np.asarray(message.positions).round(3).tolist()} mm"
    if isinstance(message, pyigtl.StringMessage):
        return repr(message.string)
    return "(a type that pyigtl does not decode)"


if __name__ == "__main__":
    main()
