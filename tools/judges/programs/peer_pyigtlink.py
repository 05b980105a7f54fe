"""A peer on pyIGTLink, which is a server that only sends: what standard input has, see foreign_peers.py."""

import sys
from urllib.parse import unquote

import numpy as np
from pyIGTLink.pyIGTLink import ImageMessage, PyIGTLink, TransformMessage  # type: ignore[import-not-found]

_, role, port = sys.argv
server = PyIGTLink(int(port), localServer=True)
print("ready", flush=True)
for line in sys.stdin:
    kind, device, stamp_ns, *words = line.split()
    name, stamp_ms = unquote(device[1:]), int(stamp_ns) / 1e6
    try:
        if kind == "TRANSFORM":
            matrix = np.eye(4)
            matrix[:3] = np.array(words, float).reshape(4, 3).T
            message = TransformMessage(matrix, stamp_ms, name)
        elif kind == "IMAGE":
            columns, rows, slices, _, parts = map(int, words[:5])
            pixels = np.frombuffer(bytes.fromhex(words[-1][1:]), np.uint8)
            message = ImageMessage(
                pixels.reshape((rows, columns, *((parts,) if parts > 1 else ()))), [1, 1, 1], stamp_ms, name
            )
        else:
            raise ValueError(f"no class for {kind}")
        message.get_binary_message()  # else its thread ends
        server.add_message_to_send_queue(message)
    except Exception as error:  # what it cannot send is a result
        print("error", f"={type(error).__name__}:{error}".replace(" ", "%20"), flush=True)
