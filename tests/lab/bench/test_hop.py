"""The bridge that does nothing but the hop, as a command: what is sent on one side arrives on the other."""

from __future__ import annotations

import socket

import pytest

from igtl_gateway.wire import decode
from igtl_gateway_lab.bench.bridges import hop_command
from igtl_gateway_lab.bench.cases import CASES, Direction, payload
from igtl_gateway_lab.bench.native import PlainNode, connect
from igtl_gateway_lab.bench.probe import lacks_probe
from igtl_gateway_lab.bench.processes import Program

pytestmark = [pytest.mark.ros, pytest.mark.skipif(bool(lacks_probe()), reason=lacks_probe())]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def test_what_is_published_arrives_with_its_number() -> None:
    case, port = CASES["transform"], free_port()
    (stream,) = case.streams
    made, way = payload("transform"), Direction.ROS_TO_IGTL
    with Program("hop", hop_command(port, case, None)) as program:
        for _ in range(2):  # a second peer takes the place of the first
            with connect(("127.0.0.1", port)) as peer:
                node = PlainNode("tester")
                publisher = node.publisher(stream.topic(way), made.ros_type, 10)
                peer.settimeout(0.2)
                message = b""
                for _ in range(300):
                    publisher.publish(bytes(made.ros_maker()(7)))
                    try:
                        message = peer.recv(len(made.igtl_maker("x")(0)), socket.MSG_WAITALL)
                        break
                    except TimeoutError:
                        continue
                node.close()
                assert made.forms[1].number(message) == 7
                assert decode(message).device_name == stream.device(way)
        program.interrupt_and_wait()
