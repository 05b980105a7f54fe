"""The service manager: what reaches its socket, and which output is the journal."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.systems.service import ServiceManager, is_journal

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="systemd is of Linux")


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.settimeout(10)
        yield made


def test_lines_reach_a_socket_with_a_path(receiver: socket.socket, tmp_path: Path) -> None:
    receiver.bind(str(tmp_path / "notify"))
    ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "notify")}).send("READY=1", "STATUS=2 peers, é\udc80")
    assert receiver.recv(4096) == "READY=1\nSTATUS=2 peers, é?".encode()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has abstract names")
def test_lines_reach_a_socket_with_an_abstract_name(receiver: socket.socket) -> None:
    receiver.bind("")  # the kernel gives it a name
    name = receiver.getsockname().decode().replace("\0", "@", 1)
    ServiceManager({"NOTIFY_SOCKET": name}).send("STOPPING=1")
    assert receiver.recv(4096) == b"STOPPING=1"


@pytest.mark.parametrize("place", ["", "notify", "vsock:2:1"])
def test_without_a_socket_nothing_is_sent(place: str) -> None:
    manager = ServiceManager({"NOTIFY_SOCKET": place, "WATCHDOG_USEC": "1"})
    assert not manager.is_present
    manager.send("READY=1")


def test_a_manager_that_is_gone_or_does_not_read_stops_nothing(receiver: socket.socket, tmp_path: Path) -> None:
    manager = ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "notify")})
    manager.send("READY=1")
    receiver.bind(str(tmp_path / "notify"))
    for _ in range(10_000):  # more than its queue has room for
        manager.send("STATUS=")
    assert receiver.recv(4096) == b"STATUS="


def test_a_watchdog_is_not_shorter_than_the_reports_allow() -> None:
    environ = {"NOTIFY_SOCKET": "/run/notify", "WATCHDOG_USEC": "4999999"}
    for ours in ({}, {"WATCHDOG_PID": str(os.getpid())}):
        with pytest.raises(ConfigError, match="WATCHDOG_USEC: found 4999999, expected at least 5000000"):
            ServiceManager(environ | ours)
    assert ServiceManager(environ | {"WATCHDOG_PID": "1"}).is_present, "the watchdog of another process"
    assert ServiceManager(environ | {"WATCHDOG_USEC": "5000000"}).is_present


def test_the_output_that_the_journal_names_is_the_journal(tmp_path: Path) -> None:
    with (tmp_path / "journal").open("w") as stream, (tmp_path / "file").open("w") as other:
        status = os.fstat(stream.fileno())
        environ = {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
        assert is_journal(stream, environ)
        assert not is_journal(other, environ), "an output that goes to a file"
        assert not is_journal(stream, {})
        assert not is_journal(stream, {"JOURNAL_STREAM": "damaged"})
    assert not is_journal(stream, environ), "closed"
