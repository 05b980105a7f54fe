"""A plain TCP server that counts and hashes what its first client sends, until that closes.

usage: python -m igtl_gateway_lab.demo.collector
"""

from __future__ import annotations

import hashlib
import json
import socket


def main() -> None:
    digest, total = hashlib.sha256(), 0
    with socket.create_server(("127.0.0.1", 0)) as listener:
        print(json.dumps({"event": "ready", "port": listener.getsockname()[1]}), flush=True)
        listener.settimeout(60.0)
        peer, _ = listener.accept()
        with peer:
            while data := peer.recv(1 << 20):
                digest.update(data)
                total += len(data)
    print(json.dumps({"event": "summary", "sha256": digest.hexdigest(), "bytes": total}), flush=True)


if __name__ == "__main__":
    main()
