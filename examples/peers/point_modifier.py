"""Receive points of one device, project them onto the plane z = 0, and send them as another device in red.

python point_modifier.py [--device F] [--host 127.0.0.1] [--port 18944] [--count 0]
"""

import argparse

import numpy as np

import igtl_gateway
from igtl_gateway.wire.point import Points

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--device", default="F")
parser.add_argument("--host", default="127.0.0.1")
parser.add_argument("--port", type=int, default=18944)
parser.add_argument("--count", type=int, default=0, help="end after this number of lists; 0: never")
options = parser.parse_args()

with igtl_gateway.connect(options.host, options.port) as peer:
    number = 0
    while not options.count or number < options.count:
        message = peer.receive("POINT", options.device, timeout_s=None)
        elements = message.content.elements.copy()  # with names, groups and diameters
        elements["position"][:, 2] = 0.0
        elements["rgba"] = np.array([255, 0, 0, 255])
        peer.send("POINT", f"{options.device}-modified", Points(elements))
        number += 1
