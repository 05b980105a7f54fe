"""A bridge with a peer that reads slowly, whose native passage has no memory for a while; see ``test_memory.py``.

Arguments: the preloaded library, and the recording to write.  Writes as JSON: the streams that passed natively, the
allocations that were refused, whether the link has ended, how many STRINGs were sent to it, how many it has received,
and the parts of its account that are not in balance.
"""

from __future__ import annotations

import ctypes
import json
import socket
import sys
from pathlib import Path

import pytest

from igtl_gateway.convert.rosmsg import String
from igtl_gateway.wire.framer import Framer
from tests.gateway.fastpath.test_passage_streams import scene, wait_for

#: Sent without memory, and after it: far more than the kernel holds for a peer.
STARVED, LATER = 400, 40


def main(library: str, recording: Path) -> None:
    refuse, refused = (ctypes.c_int.in_dll(ctypes.CDLL(library), name) for name in ("refuse", "refused"))
    sent, received, framer = 0, 0, Framer()
    with pytest.MonkeyPatch.context() as patch, scene(patch, path=recording) as here, socket.socket() as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(here.bridge.addresses[0])
        slow.settimeout(0.2)
        wait_for(lambda: any(one.connected for one in here.bridge.tcp.links()))

        def send() -> None:
            nonlocal sent
            here.send_ros(String(f"{sent:06} " + "x" * 20_000), "/igtl/out/text")
            sent += 1
            wait_for(lambda: here.received("ros_in") == sent)

        def read() -> bool:
            """Read what has come; False at the end of the connection."""
            nonlocal received
            try:
                while data := slow.recv(1 << 20):
                    received += sum(bytes(message)[2:8] == b"STRING" for message in framer.feed(data))
            except TimeoutError:
                return True
            except OSError:
                pass
            return False

        while here.native == 0 and sent < 100:  # these pass in Python, until the stream is copied
            send()
            read()
        native = here.native
        refuse.value = 1
        for _ in range(STARVED):
            send()
        refuse.value = 0
        for _ in range(LATER):
            if not (is_open := read()):
                break
            send()
        else:
            is_open = read()
    gaps = here.bridge.losses["gaps"]
    sys.stdout.write(json.dumps([native, refused.value, not is_open, sent, received, gaps]))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
