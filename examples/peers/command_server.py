"""Serve commands and queries: a device that reports its state, and whose tool can be asked for.

    python command_server.py [--port 18944]

`command_client.py` is its client.
"""

import argparse
import time

import numpy as np

import igtl_gateway

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--port", type=int, default=18944)
options = parser.parse_args()

tools = {"Needle": np.eye(4), "Probe": np.diag([1.0, -1.0, -1.0, 1.0])}

with igtl_gateway.serve(options.port) as server:

    @server.on_command("GetTools")
    def get_tools(command):
        return "<Tools>" + "".join(f'<Tool name="{name}" />' for name in sorted(tools)) + "</Tools>"

    @server.on_command("Remove")
    def remove(command):
        if command.text not in tools:
            raise ValueError(f"there is no tool {command.text!r}")  # the client gets the status FAIL and this text
        del tools[command.text]

    @server.on_query("TRANSFORM")
    def pose_of(query):
        return tools.get(query.device)  # None refuses the query

    print(f"OpenIGTLink server on {server.host}:{server.port}", flush=True)
    while True:
        time.sleep(1.0)
