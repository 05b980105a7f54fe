"""The router as a program, and with the configuration of the documentation."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path

import pytest

from igtl_gateway.addons.zenoh.router import Router
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.base.qos import Qos
from igtl_gateway.convert.rosmsg import String
from tests.addons.zenoh.routers import free_port
from tests.addons.zenoh.test_connection import as_client, pem
from tests.addons.zenoh.test_edge import counts, port, sides, started, text
from tests.integration.bridge import START_S, gateway
from tests.places import ROOT

__all__ = ["port", "sides"]

PAGE = ROOT / "docs" / "how-to" / "zenoh.md"


def test_the_program(port: int) -> None:
    program = gateway("zenoh-router", "--listen", f"127.0.0.1:{port}")
    try:
        program.wait_until(lambda: len(program.lines) > 1, "start")
        bridge = gateway("bridge", "--listen", "127.0.0.1:0", "--ros", f"zenoh:127.0.0.1:{port}", "--duration", "0.1")
        bridge.wait_until(lambda: bool(bridge.lines), "start", START_S)  # its end has a limit of its own
        told = bridge.end(None)
        assert (told.code, told.err) == (0, "")
        assert "= connected to router" in told.out
        program.wait_until(lambda: program.lines[-1].endswith(" left"), "end of the bridge")
        with pytest.raises(Unavailable, match="Address already in use"):
            Router([f"tcp/127.0.0.1:{port}"], [], lambda: None)
        told = program.end()
        assert (told.code, told.err) == (0, "")
        assert [line.split()[0] for line in told.out.splitlines()] == ["Zenoh", "Press", "client", "client"]
    finally:
        program.close()


def test_the_documented_configuration(
    port: int, sides: ExitStack, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = re.search(r"```json5\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert found
    file, ours = tmp_path / "router.json5", found[1]
    names = {"clinic.pem": pem("ca"), "router.pem": pem("server"), "0.0.0.0:7447": f"127.0.0.1:{port}"}
    for name in ("robot", "viewer"):
        wanted = "server" if name == "robot" else name
        names[f'cert_common_names: ["{name}"]'] = f'cert_common_names: ["TEST ONLY {wanted}"]'
    for name, path in (names | {'"0/': '"7/', "@ros2_lv/0/": "@ros2_lv/7/"}).items():
        assert name in ours
        ours = ours.replace(name, path)
    file.write_text(ours)
    router = Router([], [], lambda: None, {"ZENOH_ROUTER_CONFIG_URI": str(file)})
    sides.callback(router.close)
    as_client(monkeypatch, "server")
    robot = started(sides, port, name="robot", scheme="tls")
    for topic in ("/igtl/in/Plan/string", "/igtl/out/Plan"):
        assert robot.edge.publish(topic, String.TYPE, text("plan"), Qos(1, latched=True)) == ""
    as_client(monkeypatch, "viewer")
    viewer = started(sides, port, ("/igtl/in/Plan/string", "/igtl/out/Plan"), name="viewer", scheme="tls")
    viewer.wait(lambda: len(viewer.messages) == 1)
    viewer.wait(lambda: viewer.codes().count("ros_subscribed") == 2)  # all may see the graph
    assert viewer.edge.counters() == {"/igtl/in/Plan/string": counts(received=1), "/igtl/out/Plan": counts()}


def test_a_file_for_a_session_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "session.json5"
    file.write_text('{mode: "client"}')
    with pytest.raises(ConfigError, match="found mode 'client', expected 'router'"):
        Router([f"tcp/127.0.0.1:{free_port()}"], [], lambda: None, {"ZENOH_ROUTER_CONFIG_URI": str(file)})
