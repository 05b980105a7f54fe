"""Other bridges: how they are started, and errors of those that do not work."""

from __future__ import annotations

import sys

import pytest

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.interface import DISCOVERY_NS
from igtl_gateway_lab.bench.bridges import STEADY_S, Bridge, foreign, split, wait_ready
from igtl_gateway_lab.bench.cases import CASES
from igtl_gateway_lab.bench.processes import BenchError, Program
from igtl_gateway_lab.programs import ours


def test_port_and_case_are_replaced() -> None:
    words = split("ros2 run 'my bridge' --ros-args -p port:={port} --case={case}", 18944, CASES["image-vga"])
    assert words == ["ros2", "run", "my bridge", "--ros-args", "-p", "port:=18944", "--case=image-vga"]


def test_a_command_that_is_not_there() -> None:
    with (
        pytest.raises(BenchError, match=r"No such file.*no-such-bridge"),
        foreign("no-such-bridge", CASES["mixed"], None),
    ):
        raise AssertionError("it has not started")


def test_a_bridge_that_ends_is_quoted() -> None:
    failing = f"{sys.executable} -c 'import sys; sys.exit(\"no port {{port}} for me\")'"
    with Program("client", ours("simulate", "--help")) as client:
        with foreign(failing, CASES["transform"], None) as bridge, pytest.raises(BenchError, match="for me"):
            client.wait_ended()
            bridge.program.wait(60)
            wait_ready([client], bridge)


def test_one_that_is_not_ready_is_quoted() -> None:
    with Program("verifier", ours("verify", "no-such-file.mcap")) as program:
        with pytest.raises(BenchError, match="no-such-file"):
            wait_ready([program], None)
        assert Bridge(program, ("127.0.0.1", 1)).address == ("127.0.0.1", 1)


def test_what_is_measured_is_the_steady_state() -> None:
    """In its first seconds the gateway passes poses to ROS through Python: a short run measured mostly these."""
    with Program("gateway", ours("simulate", "--help")) as program:
        bridge = Bridge(program)
        assert bridge.unsteady_s(bridge.begun_ns) == STEADY_S > DISCOVERY_NS / NS_PER_S + 1
        assert bridge.unsteady_s(bridge.begun_ns + 5 * NS_PER_S) == pytest.approx(STEADY_S - 5)
        assert bridge.unsteady_s(bridge.begun_ns + 60 * NS_PER_S) == 0
