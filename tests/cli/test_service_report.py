"""What systemd learns of ``bridge``: the watchdog stands for the hub, not for a thread beside it."""

from __future__ import annotations

import json
import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.systems.service import ServiceManager
from igtl_gateway.cli.bridge_session import BridgeSession
from igtl_gateway.cli.service_report import ServiceReport
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.config.configuration import Config
from tests.integration.bridge import gateway

ALIVE = "STATUS=0 peers | IGTL 0 in, 0 out/s | ROS 0 in, 0 out/s\nWATCHDOG=1"


class Manager(ServiceManager):
    """Keeps what it receives."""

    def __init__(self) -> None:
        self.is_present = True
        self.received: list[str] = []

    def send(self, *lines: str) -> None:
        self.received.append("\n".join(lines))

    def take(self) -> list[str]:
        taken, self.received = self.received, []
        return taken


def test_the_watchdog_is_fed_only_while_the_hub_ticks() -> None:
    clock, manager = ManualClock(NS_PER_S), Manager()
    report = ServiceReport(manager, clock)
    session = BridgeSession(Config(), BridgeOptions(ros=False), clock)

    def update(*, ticks: bool) -> list[str]:
        clock.advance(NS_PER_S)
        if ticks:
            session.bridge.hub.tick()
        report.update(session)
        report.update(session)  # again within the second
        return manager.take()

    report.ready()
    assert manager.take() == ["READY=1"]
    assert update(ticks=True) == [ALIVE]
    assert update(ticks=False) == [], "the hub does not tick: its timer has ended, or its lock is held"
    assert update(ticks=True) == [ALIVE]
    report.stopping()
    assert manager.take() == ["STOPPING=1"]


def test_a_node_that_waits_for_its_transitions_is_alive() -> None:
    clock, manager = ManualClock(NS_PER_S), Manager()
    report = ServiceReport(manager, clock)
    report.update(None)
    report.update(None)
    assert manager.take() == ["STATUS=unconfigured: another node configures and activates it\nWATCHDOG=1"]


def test_lines_of_the_journal_have_their_priority_in_front(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for number in (1, 2):
        status = os.fstat(number)
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        print_line("<0>of a peer", "second", error=number == 2)
        print_line("failed", error=number == 2, priority=3)
        if number == 1:
            print_json({"event": "problem"}, 4)
    out, err = capfd.readouterr()
    assert out.splitlines() == ["<6><0>of a peer", "<6>second", "<3>failed", '<4>{"event": "problem"}']
    assert err.splitlines() == ["<4><0>of a peer", "<4>second", "<3>failed"]


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[tuple[str, Callable[[str], str]]]:
    """The socket of an imitation of systemd, and what waits for a message that has a line."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.settimeout(30)

        def wait(line: str) -> str:
            while line not in (message := receiver.recv(4096).decode()).split("\n"):
                pass
            return message

        yield str(tmp_path / "notify"), wait


def test_a_service_from_its_start_to_its_end(systemd: tuple[str, Callable[[str], str]], tmp_path: Path) -> None:
    place, wait = systemd
    name = str(tmp_path / "{time}.mcap")
    bridge = gateway(
        "bridge", "--no-ros", "--listen", "127.0.0.1:0", "--record", name, "--json",
        NOTIFY_SOCKET=place, WATCHDOG_USEC="20000000",
    )  # fmt: skip
    try:
        wait("READY=1")
        assert "STATUS=0 peers | " in wait("WATCHDOG=1")
        result = bridge.end(signal.SIGTERM)
        wait("STOPPING=1")
    finally:
        bridge.close()
    assert result.code == 0, result.err
    (path,) = tmp_path.glob("*.mcap")
    stopped = json.loads(result.out.splitlines()[-1])
    assert (stopped["event"], stopped["recording"]["path"]) == ("stopped", str(path))
    assert len(path.stem) == len("20261126T205500Z")
