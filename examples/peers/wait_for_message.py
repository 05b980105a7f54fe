"""Wait for one message of a device, and print it.

    python wait_for_message.py [--device ToolToReference] [--host 127.0.0.1] [--port 18944]

For any OpenIGTLink server, such as 3D Slicer, PLUS or `igtl-gateway bridge`.
"""

import argparse

import igtl_gateway

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--device", default="ToolToReference")
parser.add_argument("--host", default="127.0.0.1")
parser.add_argument("--port", type=int, default=18944)
options = parser.parse_args()

with igtl_gateway.connect(options.host, options.port) as peer:
    message = peer.receive(device=options.device, timeout_s=5.0)
    print(message.type, message.device)
    print(message.matrix if message.type == "TRANSFORM" else message.describe())
