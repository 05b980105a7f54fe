"""Judges this system (Linux, macOS, Windows): installs the package and passes, records and verifies a session.

``python tools/systems.py``: with the extra ``zenoh`` in a new environment, a router, a bridge, a peer and a node.
``--here`` uses this Python and its packages.  Only the standard library is needed.  Exit code 1 at the first failure.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import venv
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DEADLINE_S = 60.0
WINDOWS = os.name == "nt"
MESSAGES = 200


def main() -> int:
    """Run all steps."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--here", action="store_true", help="use this Python and its packages")
    here: bool = parser.parse_args().here
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        python = sys.executable if here else _installed(folder / "environment")
        _pass_session(python, folder)
    print(f"{sys.platform}, Python {sys.version.split()[0]}: all steps passed")
    return 0


def _installed(folder: Path) -> str:
    venv.create(folder, with_pip=True)
    python = folder / ("Scripts/python.exe" if WINDOWS else "bin/python")
    constraints = str(ROOT / "constraints.txt")
    command = [str(python), "-m", "pip", "install", "--quiet", "-c", constraints, f"{ROOT}[zenoh,seal]"]
    subprocess.run(command, check=True)
    return str(python)


def _pass_session(python: str, folder: Path) -> None:
    path, router_port = folder / "session.mcap", _free_port()
    endpoint = f"tcp/127.0.0.1:{router_port}"
    router = _Program(python, "zenoh-router", "--listen", endpoint, cwd=folder)
    bridge = _Program(
        *(python, "bridge", "--json", "--listen", "127.0.0.1:0", "--ros", f"zenoh:{endpoint}"),
        *("--record", str(path)),
        cwd=folder,
    )
    try:
        port = bridge.wait(lambda event: event.get("event") == "started")["listen"][0]["port"]
        bridge.wait(lambda event: event.get("code") == "zenoh_connected")
        with socket.create_connection(("127.0.0.1", port)) as peer:
            for number in range(MESSAGES):
                peer.sendall(_transform(number))
        bridge.wait(lambda event: event.get("code") == "link_down")
        bridge.end()
        counts = bridge.wait(lambda event: event.get("event") == "stopped")["counts"]
        _expect(counts["igtl_in"], MESSAGES, "messages of the peer")
        _expect(counts["ros_out"] > MESSAGES, True, "messages to ROS")
    finally:
        for program in (bridge, router):
            program.kill()
    for words in (
        ("verify", path),
        ("info", path),
        ("doctor", path),
        ("diff", path, path),
        ("slice", path, "-o", folder / "part.mcap", "--end", "1"),
        ("seal", "keys", "new", folder / "own.key"),
        ("seal", path, "--key", folder / "own.key", "-o", folder / "sealed.mcap"),
        ("verify", "--seal", folder / "sealed.mcap", "--trust", folder / "own.key.pub"),
        ("export", path, "--to", "csv", "-o", folder / "tables"),
        ("recover", path, "-o", folder / "again.mcap"),
        ("keep", folder, "--retention", "1 d"),
    ):
        command = [python, "-m", "igtl_gateway", *map(str, words)]
        ran = subprocess.run(command, cwd=folder, capture_output=True, check=False, timeout=DEADLINE_S)
        _expect((words[0], ran.returncode, ran.stderr), (words[0], 0, b""), "exit code and errors")


class _Program:
    """A verb with lines of JSON."""

    def __init__(self, python: str, *words: str, cwd: Path) -> None:
        flags = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
        command = [python, "-m", "igtl_gateway", *words]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=cwd, creationflags=flags)
        self._lines: queue.Queue[bytes] = queue.Queue()
        self._seen: list[dict[str, Any]] = []
        threading.Thread(target=self._read, daemon=True).start()

    def wait(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the first event that is wanted, also among those before."""
        for event in self._seen:
            if wanted(event):
                return event
        while True:
            line = self._lines.get(timeout=DEADLINE_S)
            if not line:
                raise SystemExit(f"the program has ended: {self._seen[-3:]}")
            self._seen.append(json.loads(line))
            if wanted(self._seen[-1]):
                return self._seen[-1]

    def end(self) -> None:
        """Do what Ctrl-C does, on Windows Ctrl-Break; expect exit code 0."""
        self._process.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))
        _expect(self._process.wait(DEADLINE_S), 0, "exit code of the bridge")

    def kill(self) -> None:
        """End it by all means."""
        self._process.kill()
        self._process.wait()

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            if line.startswith(b"{"):
                self._lines.put(line)
        self._lines.put(b"")


def _expect(found: object, expected: object, what: str) -> None:
    if found != expected:
        raise SystemExit(f"{what}: found {found!r}, expected {expected!r}")
    print(f"passed: {what}: {found!r}")


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def _transform(number: int) -> bytes:
    """Return a TRANSFORM, header version 1."""
    body = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, number, 0, 0)
    return struct.pack(">H12s20sQQQ", 1, b"TRANSFORM", b"Probe", number << 32, len(body), _crc(body)) + body


def _crc(data: bytes) -> int:
    """Return the CRC-64 of OpenIGTLink: ECMA-182, not reflected."""
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = (crc << 1 ^ (0x42F0E1EBA9EA3693 if crc >> 63 else 0)) & (1 << 64) - 1
    return crc


if __name__ == "__main__":
    sys.exit(main())
