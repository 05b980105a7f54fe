"""A good peer and a new one beside 20 that flood a running bridge, with programs of their own."""

from __future__ import annotations

import socket
import statistics
import subprocess
import sys
import time

import pytest

from tests.integration.bridge import Bridge, RawPeer, environment, message
from tests.places import ROOT

pytestmark = pytest.mark.slow

ATTACKERS, SECONDS = 20, 8
TRIPS = 60


def round_trips(peer: RawPeer) -> list[float]:
    """Times (s) of queries and their answers."""
    times = []
    for _ in range(TRIPS):
        begun = time.monotonic()
        peer.send(message("GET_STATUS", b""))
        peer.receive(type_name="STATUS")
        times.append(time.monotonic() - begun)
        time.sleep(0.005)
    return times


@pytest.mark.parametrize("attack", ["GET_STATUS", "COMMAND", "wrong CRC", "TRANSFORM"])
def test_a_good_peer_is_answered_beside_twenty_that_flood(attack: str) -> None:
    """Before, its median was a thousand times that without them, and a new peer waited for seconds."""
    bridge = Bridge("--no-ros")
    try:
        with RawPeer(bridge.port) as good:
            good.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            idle = statistics.median(round_trips(good))
            words = [attack, str(bridge.port), str(ATTACKERS), "0", str(SECONDS)]
            command = [sys.executable, str(ROOT / "tools/attacks.py"), *words]
            with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment()) as attacker:
                assert attacker.stdout and attacker.stdout.readline() == b"ready\n"
                bridge.wait_code("link_up", 1 + ATTACKERS)
                beside = statistics.median(round_trips(good))
                begun = time.monotonic()
                with RawPeer(bridge.port) as late:
                    late.send(message("GET_STATUS", b""))
                    late.receive(type_name="STATUS")
                waited = time.monotonic() - begun
                attacker.kill()
        assert beside < 100 * idle + 0.1
        assert waited < 2.5  # of a machine that is as busy as those of the gate
    finally:
        bridge.close()
