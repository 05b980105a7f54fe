"""Lines between two network namespaces whose weather a test chooses.

With root's rights two namespaces can be had nearly everywhere.  Where the kernel has ``sch_netem`` (and there are
``ip`` and ``tc``), a line is a pair of veth devices and its weather is ``tc netem``; elsewhere it is a pair of TUN
devices, and ``lines.py`` is the weather.  ``Lines.how`` names the one in use.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.integration.lines import enter

NETEM, SHAPER = "tc netem", "own shaper between TUN devices"


class NotHereError(Exception):
    """This machine does not allow it; the text is the reason."""


@dataclass(frozen=True)
class Weather:
    """Shares are from 0 to 1."""

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    reorder: float = 0.0
    down: bool = False
    rate: float = 0.0  # bytes per second; 0: no limit


class Lines:
    """``count`` lines between the namespaces ``near`` and ``far``; see ``lines.py`` for addresses.

    Attributes:
        near, far: how a command is run there: to be put before it.

    Raises NotHereError.
    """

    def __init__(self, count: int) -> None:
        if not sys.platform.startswith("linux"):
            raise NotHereError(f"no network namespaces on {sys.platform}")
        if os.geteuid() != 0:
            raise NotHereError("network namespaces need root")
        if not shutil.which("nsenter"):
            raise NotHereError("no program nsenter")
        self.how = SHAPER
        self._lock = threading.Lock()
        self._keeper = _Keeper(0)
        try:
            if self._with_netem(count):
                self.how = NETEM
            else:
                self._keeper.close()
                self._keeper = _Keeper(count)
        except BaseException:
            self._keeper.close()
            raise
        self.near, self.far = self._keeper.near, self._keeper.far

    def shape(self, line: int, weather: Weather) -> None:
        """From now on the line has this weather, each way."""
        if self.how == SHAPER:
            self._ask({"line": line, **asdict(weather)})
            return
        words = []
        if weather.delay_s:
            words += ["delay", f"{weather.delay_s * 1000:g}ms", f"{weather.jitter_s * 1000:g}ms"]
        if weather.down or weather.loss:
            words += ["loss", "100%" if weather.down else f"{weather.loss:.3%}"]
        if weather.reorder:
            words += ["reorder", f"{weather.reorder:.3%}"]
        if weather.rate:
            words += ["rate", f"{8 * weather.rate:.0f}bit"]
        for end in (self.near, self.far):
            run(*end, "tc", "qdisc", "replace", "dev", f"line{line}", "root", "netem", "limit", "10000", *words)

    def spoilt(self, line: int) -> int:
        """Packets that the line has lost or let overtake others so far."""
        if self.how == SHAPER:
            told = self._ask({"line": line})
            return int(told["lost"] + told["early"] + told["blocked"])
        return sum(self._netem_drops(end, line) for end in (self.near, self.far))

    def kernel_counter(self, name: str) -> int:
        """A counter of TCP in the far namespace, such as ``TCPOFOQueue``: packets that came before others."""
        text = subprocess.run([*self.far, "cat", "/proc/self/net/netstat"], capture_output=True, text=True, check=True)
        rows = [row.split() for row in text.stdout.splitlines()]
        for names, values in zip(rows[::2], rows[1::2], strict=True):
            if name in names:
                return int(values[names.index(name)])
        raise AssertionError(f"no counter {name}")

    @contextmanager
    def inside(self, end: Sequence[str]) -> Iterator[None]:
        """Sockets that this thread makes in here belong to that namespace."""
        own = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
        there = os.open(end[1].partition("=")[2], os.O_RDONLY)
        try:
            enter(there)
            try:
                yield
            finally:
                enter(own)
        finally:
            os.close(there)
            os.close(own)

    def connect(self, line: int, port: int) -> socket.socket:
        """A connection from the far end to a port of the near one."""
        with self.inside(self.far):
            return socket.create_connection((near_address(line), port), timeout=10)

    def serve(self, line: int) -> socket.socket:
        """A listening socket at the far end."""
        with self.inside(self.far):
            return socket.create_server((far_address(line), 0))

    def close(self) -> None:
        self._keeper.close()

    def __enter__(self) -> Lines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _ask(self, words: dict[str, Any]) -> dict[str, int]:
        with self._lock:
            return self._keeper.ask(words)

    def _with_netem(self, count: int) -> bool:
        """Pairs of veth devices with netem; False where there is none."""
        if not (shutil.which("ip") and shutil.which("tc")):
            return False
        near, far = self._keeper.near, self._keeper.far
        with suppress(subprocess.CalledProcessError):
            for line in range(count):
                name = f"line{line}"
                # the keeper itself is in the far namespace
                there = ("netns", str(self._keeper.process.pid))
                run(*near, "ip", "link", "add", name, "type", "veth", "peer", "name", name, *there)
                run(*near, "tc", "qdisc", "add", "dev", name, "root", "netem", "delay", "1ms", "reorder", "1%")
                run(*near, "tc", "qdisc", "del", "dev", name, "root")
                for end, address in ((near, near_address(line)), (far, far_address(line))):
                    run(*end, "ip", "address", "add", f"{address}/24", "dev", name)
                    run(*end, "ip", "link", "set", name, "up")
            return True
        return False

    @staticmethod
    def _netem_drops(end: Sequence[str], line: int) -> int:
        command = [*end, "tc", "-s", "-j", "qdisc", "show", "dev", f"line{line}"]
        told = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
        return sum(int(qdisc["drops"]) for qdisc in told)


class _Keeper:
    """The program that holds the namespaces."""

    def __init__(self, count: int) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(Path(__file__).with_name("lines.py")), str(count)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        try:
            told = self._answer()
            if "failed" in told:
                raise NotHereError(f"no network namespaces with TUN devices: {told['failed']}")
            root = f"/proc/{self.process.pid}/fd"
            self.near, self.far = (("nsenter", f"--net={root}/{told[end]}") for end in ("near", "far"))
        except BaseException:
            self.close()
            raise

    def ask(self, words: dict[str, Any]) -> dict[str, int]:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(words).encode() + b"\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise NotHereError(f"the keeper of the lines ended with {self.process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        assert self.process.stdin is not None and self.process.stdout is not None
        with suppress(BrokenPipeError):
            self.process.stdin.close()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.process.stdout.close()


def near_address(line: int) -> str:
    return f"10.77.{line}.1"


def far_address(line: int) -> str:
    return f"10.77.{line}.2"


def run(*command: str) -> None:
    subprocess.run(command, capture_output=True, check=True)
