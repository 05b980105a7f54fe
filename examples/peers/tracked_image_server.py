"""Serve a moving image, its pose and a string, as an ultrasound system does, and print what clients send.

    python tracked_image_server.py [--port 18944] [--count 0] [--hz 30]

Image, pose and string of one frame have the same time stamp.
"""

import argparse
import time

import numpy as np

import igtl_gateway
from igtl_gateway.base.errors import LinkClosed, NoReply

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--port", type=int, default=18944)
parser.add_argument("--count", type=int, default=0, help="end after this number of frames; 0: never")
parser.add_argument("--hz", type=float, default=30.0)
options = parser.parse_args()


def frame(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels of shape (j, i), and the pose of the image in millimetres."""
    rows, columns = np.mgrid[0:200, 0:400]
    pixels = (127 + 100 * np.sin((rows + columns + number) / 20)).astype(np.uint8)
    angle, pose = np.radians(number / 2), np.eye(4)
    pose[:3, :3] = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    pose[0, 3] = 20 * np.sin(number / 100)
    return pixels, pose


with igtl_gateway.serve(options.port, when_full="drop") as server:
    print(f"OpenIGTLink server on {server.host}:{server.port}", flush=True)
    server.wait_connected(timeout_s=None)
    number = 0
    while not options.count or number < options.count:
        number += 1
        pixels, pose = frame(number)
        now_ns = time.time_ns()
        server.send("IMAGE", "Image", pixels, matrix=np.diag([0.2, 0.2, 1.0, 1.0]), time_ns=now_ns)
        server.send("TRANSFORM", "ImageToReference", pose, time_ns=now_ns)
        server.send("STRING", "Text", f"frame {number}", time_ns=now_ns)
        try:
            print(server.receive(timeout_s=1 / options.hz), flush=True)
        except (NoReply, LinkClosed):
            pass
