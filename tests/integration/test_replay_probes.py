"""A replay that waits for its peer is not used up by what only looks: a scan of ports, ``doctor``."""

from __future__ import annotations

import json
import socket
import subprocess
import sys

import pytest

from igtl_gateway.cli import main
from tests.places import FIXTURES


def received(port: int) -> int:
    """Number of bytes until the replay closes the connection."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as peer:
        return sum(len(data) for data in iter(lambda: peer.recv(1 << 16), b""))


@pytest.mark.slow
@pytest.mark.parametrize("options", [[], ["--exact"]], ids=["recognised", "exact"])
def test_scans_and_doctor_do_not_count_as_the_peer(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    words = ["replay", str(FIXTURES / "acquisition.mcap"), "--to", "igtl", "--listen", "127.0.0.1:0", *options]
    command = [sys.executable, "-m", "igtl_gateway", *words, "--as-fast-as-possible"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as replay:
        assert replay.stdout is not None
        try:
            server = next(line for line in replay.stdout if line.startswith("OpenIGTLink server"))
            port = int(server.rpartition(":")[2])
            socket.create_connection(("127.0.0.1", port)).close()
            assert main(["doctor", f"127.0.0.1:{port}", "--seconds", "1", "--json"]) == 0
            (finding,) = json.loads(capsys.readouterr().out)["findings"]
            assert finding["id"] == "IGTL-I117" and "a replay of igtl-gateway that waits" in str(finding)
            assert received(port) > 20_000
            printed = replay.stdout.read()
            assert replay.wait(30) == 0
        finally:
            replay.kill()
    assert "doctor looks at this replay" in printed and "sent 47 messages" in printed
