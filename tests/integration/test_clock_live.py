"""Clocks of peers, live: a peer whose clock is set, a program of the examples, and two gateways that ask each other."""

from __future__ import annotations

import json
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from examples.peers.clock import BODY, CRC, HEADER
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from tests.integration.bridge import Bridge, Program, gateway
from tests.places import ROOT

OFFSET_NS, STEP_NS = 5 * NS_PER_S, 20 * NS_PER_MS


class ShiftedPeer:
    """A program that answers as the example does, by a clock that is ahead."""

    def __init__(self, port: int) -> None:
        self.ahead_ns, self.answers = OFFSET_NS, 0
        self._link = socket.create_connection(("127.0.0.1", port))
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with self._link.makefile("rb") as stream:
            while len(head := stream.read(HEADER.size)) == HEADER.size:
                _, kind, device, _, size, _ = HEADER.unpack(head)
                stream.read(size)
                if kind.rstrip(b"\0") == b"GET_STATUS":
                    ticks = ((time.time_ns() + self.ahead_ns) << 32) // NS_PER_S
                    self._link.sendall(HEADER.pack(1, b"STATUS", device, ticks, len(BODY), CRC) + BODY)
                    self.answers += 1

    def close(self) -> None:
        self._link.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._link.close()


@contextmanager
def closing(*programs: Program | ShiftedPeer) -> Iterator[None]:
    try:
        yield
    finally:
        for program in programs:
            program.close()


def status(bridge: Bridge, page: str = "status") -> Any:
    url = bridge.events[0]["metrics"].replace("metrics", page)
    with urllib.request.urlopen(url) as answer:
        return answer.read().decode()


def run(*arguments: str) -> str:
    found = gateway(*arguments)
    try:
        result = found.end(None)
        assert result.code == 0, result.out + result.err
        return result.out
    finally:
        found.close()


def test_a_step_of_20_ms_is_noted_and_leaves_a_black_box_that_verifies(tmp_path: Path) -> None:
    box = ["--record", str(tmp_path / "box.mcap"), "--trigger", "clock,before=4,after=0.2", "--snapshot", "60"]
    bridge = Bridge("--no-ros", "--clock-from", "127.0.0.1:*", "--metrics", "0", *box)
    peer = ShiftedPeer(bridge.port)
    with closing(bridge, peer):
        known = bridge.wait_code("peer_clock")["data"]
        assert known["low_ns"] <= OFFSET_NS <= known["high_ns"]
        while peer.answers < 3:
            time.sleep(0.01)
        (clock,) = [each["clock"] for each in json.loads(status(bridge))["peers"]]
        assert clock["method"] == "two-way" and clock["low_ns"] <= OFFSET_NS <= clock["high_ns"]
        assert 'igtl_gateway_peer_clock_offset_seconds{link="1"' in status(bridge, "metrics")
        before = peer.answers
        peer.ahead_ns += STEP_NS
        step = bridge.wait_code("peer_clock_step")
        assert step["data"]["low_ns"] <= STEP_NS <= step["data"]["high_ns"] and peer.answers - before <= 10
        saved = bridge.wait_code("trigger_saved")["data"]["path"]
        assert bridge.end().code == 0
    run("verify", saved)
    shown = json.loads(run("info", saved, "--json"))
    assert shown["problems"]["peer_clock_step"] == 1
    offset = shown["clocks"][0]["offset"]
    assert offset["low_ns"] <= OFFSET_NS + STEP_NS <= offset["high_ns"]


def test_gateways_ask_each_other_and_the_example_answers(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.mcap" for name in "ab"]
    one = Bridge("--no-ros", "--record", str(paths[0]))
    other = Bridge("--no-ros", "--record", str(paths[1]), "--connect", f"127.0.0.1:{one.port}", "--clock-from", "**:*")
    program = Program(["python3", str(ROOT / "examples/peers/clock.py"), "127.0.0.1", str(other.port)])
    with closing(program, other, one):
        found = [
            one.wait_code("peer_clock"),
            *other.wait_events(lambda event: event.get("code") == "peer_clock", "2", 2),
        ]
        for each in found:
            assert each["data"]["low_ns"] <= 0 <= each["data"]["high_ns"]
        assert other.end().code == 0 and one.end().code == 0
    for path in paths:
        run("verify", str(path))
