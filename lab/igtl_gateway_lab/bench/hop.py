"""A bridge that does nothing but the hop: what a bridge in C++ costs before it converts anything.

    python -m igtl_gateway_lab.bench.hop --port 18944 --case transform

It takes the serialised message, copies its number into the OpenIGTLink message that was made beforehand, and sends
that; and the other way round.  Its loops are those of the native measuring programs (``_probe.c``), without Python.
It has the topics and devices of a case.  Use it with ``bench --against``, or as the example of a bridge for that.
"""

from __future__ import annotations

import argparse
import socket
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway_lab.bench.cases import CASES, BenchStream, Direction, payload
from igtl_gateway_lab.bench.native import SOCKET_BYTES, PlainNode
from igtl_gateway_lab.bench.probe import Flag, InStream, OutStream, Probe, compile_probe, igtl_bytes, ros_bytes
from igtl_gateway_lab.bench.ros_side import queue_depth


class Hop:
    """The hop of some streams, for one peer at a time.

    Args:
        streams: which.
        library: see ``compile_probe``.
    """

    def __init__(self, streams: Sequence[BenchStream], library: Path) -> None:
        self._node = PlainNode("igtl_hop")
        self._probe = Probe(library, ros=True)
        self._link = self._probe.link(-1)
        self._pause = Flag()
        self._entities: list[Any] = []
        self._from_ros: list[tuple[int, InStream]] = []
        self._from_igtl: list[InStream] = []
        self._peer: socket.socket | None = None
        self._reader: threading.Thread | None = None
        for stream in streams:
            self._add(stream)
        self._threads = [
            threading.Thread(target=loop, name="igtl-hop-ros")
            for loop in self._node.receivers(self._probe, self._from_ros)
        ]

    def run(self, port: int) -> None:
        """Until an interrupt."""
        for thread in self._threads:
            thread.start()
        try:
            with socket.create_server(("127.0.0.1", port)) as server:
                while True:
                    peer = server.accept()[0]
                    self._leave_peer()
                    self._join(peer)
        except KeyboardInterrupt:
            pass
        finally:
            self._node.end_loops()
            self._leave_peer()
            for thread in self._threads:
                thread.join()
            self._node.close()

    def _add(self, stream: BenchStream) -> None:
        made = payload(stream.kind)
        out, back = Direction.ROS_TO_IGTL, Direction.IGTL_TO_ROS
        depth = queue_depth(made.size)
        subscription = self._node.subscription(stream.topic(out), made.ros_type, depth)
        publisher = self._node.publisher(stream.topic(back), made.ros_type, depth)
        self._entities += [subscription, publisher]
        to_igtl = OutStream(igtl_bytes(made, stream.device(out)), made.forms[1], link=self._link)
        to_ros = OutStream(ros_bytes(made), made.forms[0], publisher=publisher.handle.pointer)
        taken = InStream(made.forms[0], subscription=subscription.handle.pointer, forward=to_igtl)
        self._from_ros.append((made.size, taken))
        self._from_igtl.append(InStream(made.forms[1], device=stream.device(back), forward=to_ros))

    def _join(self, peer: socket.socket) -> None:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BYTES)
        self._peer = peer
        self._probe.set_link(self._link, peer.fileno())
        self._reader = threading.Thread(
            target=self._probe.receive_link, args=(peer.fileno(), self._from_igtl, self._pause), name="igtl-hop-peer"
        )
        self._reader.start()

    def _leave_peer(self) -> None:
        if self._peer is None or self._reader is None:
            return
        try:
            self._peer.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass  # it has closed the connection before
        self._probe.set_link(self._link, -1)
        self._reader.join()
        self._peer.close()
        self._peer = self._reader = None


def main(arguments: Sequence[str]) -> int:
    """See the module."""
    parser = argparse.ArgumentParser(prog="python -m igtl_gateway_lab.bench.hop", description=__doc__)
    parser.add_argument("--port", type=int, required=True, help="TCP port of OpenIGTLink")
    parser.add_argument("--case", default="transform", choices=tuple(CASES), metavar="NAME", help="case of bench")
    parser.add_argument("--library", type=Path, metavar="FILE", help="the compiled loops (default: compile them)")
    options = parser.parse_args(arguments)
    prepare_environment()
    with tempfile.TemporaryDirectory(prefix="igtl-hop-") as folder:
        library = options.library or compile_probe(Path(folder))
        Hop(CASES[options.case].streams, library).run(options.port)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
