"""Send commands and queries to `command_server.py`.

python command_client.py [--host 127.0.0.1] [--port 18944]
"""

import argparse

import igtl_gateway
from igtl_gateway.base.errors import Refused

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--host", default="127.0.0.1")
parser.add_argument("--port", type=int, default=18944)
options = parser.parse_args()

with igtl_gateway.connect(options.host, options.port) as peer:
    print(peer.command("GetTools").text)
    print(peer.query("TRANSFORM", "Probe").matrix.diagonal().tolist())
    for _ in range(2):
        reply = peer.command("Remove", "Probe")
        print("removed" if reply.succeeded else f"failed: {reply.reason}")
    try:
        peer.query("TRANSFORM", "Probe")
    except Refused as error:
        print(f"refused: {error}")
