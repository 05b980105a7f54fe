"""Starts and stops short-lived peers (``soak_guest``), as determined by a seed."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from random import Random

from igtl_gateway_lab.bench.cases import payload
from tools.evidence.soak_findings import Found, Settings
from tools.evidence.soak_load import PICTURE

_GUEST = Path(__file__).with_name("soak_guest.py")

#: Behaviour of a short-lived peer, and how it disconnects, weighted by repetition.
MANNERS = ("listen", "listen", "listen", "talk", "talk", "talk", "talk", "slow", "slow", "deaf")
_LEAVES = ("politely", "reset", "killed", "middle")
MOST_GUESTS = 3
_STAY_S, _DEAF_S = 8.0, 75.0
_NODE_LEAVES = ("politely", "interrupted", "killed")
_MOST_NODE_STAY_S = 60.0
_LEAVES_S = 60.0


class Deck:
    """Draws from what there is by chance, but everything before anything comes again."""

    def __init__(self, rng: Random, cards: Sequence[str]) -> None:
        self._rng, self._cards = rng, cards
        self._left: list[str] = []

    def draw(self) -> str:
        if not self._left:
            self._left = self._rng.sample(self._cards, len(self._cards))
        return self._left.pop()


class Guests:
    """Brings them in, and out, until closed."""

    def __init__(self, port: int, settings: Settings, found: Found) -> None:
        self._port, self._settings, self._found = port, settings, found
        self._rng = Random(settings.seed)
        self._manners, self._leaves = Deck(self._rng, MANNERS), Deck(self._rng, _LEAVES)
        self._node_leaves = Deck(self._rng, _NODE_LEAVES)
        self._over = threading.Event()
        self._here: list[tuple[subprocess.Popen[bytes], float]] = []  # and when it is killed
        self._node: subprocess.Popen[bytes] | None = None
        self._node_until = 0.0
        self.many = 0
        made = payload("transform").igtl_maker("Guest"), payload(PICTURE).igtl_maker("Guest")
        for name, make in zip(("small", "picture"), made, strict=True):
            (settings.folder / name).write_bytes(bytes(make(1)))
        self._thread = threading.Thread(target=self._run, name="guests")
        self._thread.start()

    def close(self) -> None:
        """All leave."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            # The worst at once and at first: what memory it takes stays with the process, and is no growth later.
            for _ in range(MOST_GUESTS):
                self._come("deaf", "politely", min(0.6 * self._settings.warm_s, _DEAF_S))
            due = time.monotonic()
            while not self._over.wait(0.1):
                now = time.monotonic()
                self._look(now)
                if now >= due:
                    due = now + self._rng.expovariate(1 / self._settings.guest_s)
                    stay = min(self._rng.expovariate(1 / _STAY_S), self._settings.most_stay_s)
                    if len(self._here) < MOST_GUESTS:
                        self._come(self._manners.draw(), self._leaves.draw(), stay)
        finally:
            for process, _ in self._here:
                process.kill()
                process.wait()
            self._here.clear()
            if self._node:
                self._node_goes(self._node, "politely")
            self.many = 0

    def _come(self, manner: str, leave: str, stay: float) -> None:
        self._found.guests[f"{manner}, {leave}"] += 1
        words = [str(self._port), str(self._settings.folder), str(self._rng.getrandbits(32)), manner, leave, f"{stay}"]
        process = subprocess.Popen([sys.executable, "-I", "-S", str(_GUEST), "igtl", *words])
        self._here.append((process, time.monotonic() + stay if leave == "killed" else float("inf")))

    def _look(self, now: float) -> None:
        """Kill processes at their time, and forget ended ones; the same for the node."""
        for process, until in self._here:
            if now >= until:
                process.kill()
        if any(process.poll() == 1 for process, _ in self._here):  # Python's exit code of an exception
            self._found.failures.append("a short-lived peer failed")
        self._here = [(process, until) for process, until in self._here if process.poll() is None]
        self.many = len(self._here)
        if self._node and (now >= self._node_until or self._node.poll() is not None):
            self._node_goes(self._node, self._node_leaves.draw())
        elif not self._node:
            self._node_until = now + self._rng.uniform(0.2, 1) * min(_MOST_NODE_STAY_S, self._settings.seconds / 3)
            words = ["ros", str(self._rng.getrandbits(31))]
            self._node = subprocess.Popen(
                [sys.executable, str(_GUEST), *words], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL
            )

    def _node_goes(self, node: subprocess.Popen[bytes], leave: str) -> None:
        self._found.guests[f"ROS node, {leave}"] += 1
        assert node.stdin
        match leave:
            case "killed":
                node.kill()
            case "interrupted":
                node.send_signal(signal.SIGINT)
        node.stdin.close()
        try:
            node.wait(_LEAVES_S)
        except subprocess.TimeoutExpired:
            self._found.failures.append(f"the ROS node did not leave ({leave})")
            node.kill()
            node.wait()
        self._node = None
