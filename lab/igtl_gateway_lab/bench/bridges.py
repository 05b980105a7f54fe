"""What stands between the two sides of a measurement: the gateway, the bare hop, or anyone's bridge."""

from __future__ import annotations

import shlex
import socket
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway_lab.bench.cases import Case, Direction, payload
from igtl_gateway_lab.bench.processes import BenchError, Program
from igtl_gateway_lab.bench.stalled import Stall
from igtl_gateway_lab.programs import ours

#: The bridge that only passes messages on, see ``hop``.
HOP = "hop"
START_S = 120.0  # a first start compiles igtl_msgs
_LOOK_S, _END_S = 1.0, 10.0
#: From the start of a bridge to its steady state: the gateway's publisher of /tf waits for subscribers for three
#: seconds, and until then Python passes poses to ROS.
STEADY_S = 6.0

Address = tuple[str, int]


@dataclass(frozen=True)
class Bridge:
    """The process between the two sides.

    Attributes:
        program: its process.
        foreign: it is not the gateway: it prints no events.
        stall: of the gateway, what it reported of its clients.
        recorded: of the gateway, its report at its end: on the recording, and what queues of the middleware have lost.
        begun_ns: when it was started, monotonic.
    """

    program: Program
    foreign: Address | None = None
    stall: Stall = field(default_factory=Stall)
    recorded: dict[str, Any] = field(default_factory=dict)
    begun_ns: int = field(default_factory=SystemClock().monotonic_ns)

    @cached_property
    def address(self) -> Address:
        """Where it waits for OpenIGTLink peers; of the gateway, as soon as it does."""
        if self.foreign:
            return self.foreign
        place = self.program.wait_for("started", START_S)["listen"][0]
        return place["host"], place["port"]

    def unsteady_s(self, now_ns: int) -> float:
        """Return the seconds from now until what is measured is the steady state."""
        return max(0.0, STEADY_S - (now_ns - self.begun_ns) / NS_PER_S)


@contextmanager
def gateway(
    case: Case, seconds: float, recording: Path | None, key: Path | None = None, zenoh: str = ""
) -> Iterator[Bridge]:
    """The gateway, for at most ``seconds``; with a key, it seals its recording.  Raises BenchError.

    ``zenoh``: endpoint of the router, for ROS over Zenoh; "": over DDS.
    """
    words = ["bridge", "--json", "--listen", "127.0.0.1:0", "--duration", str(seconds)]
    for stream in case.streams:
        topic, device = (f(Direction.ROS_TO_IGTL) for f in (stream.topic, stream.device))
        words += ["--send", f"{topic}={device}:{payload(stream.kind).igtl_type}"]
    if zenoh:
        words += ["--ros", f"zenoh:{zenoh}"]
    if recording:
        words += ["--record", str(recording), "--overwrite"]
    if key:
        words += ["--seal", str(key)]
    with Program("gateway", ours(*words)) as program:
        bridge = Bridge(program)
        yield bridge
        program.interrupt_and_wait()
        event = program.wait_for("stopped", START_S, bridge.stall.note)
        topics = event["ledger"]["ros_topics"].values()
        bridge.recorded["ros_lost"] = sum(counts["lost"] for counts in topics)
        if times := event.get("native_times"):
            bridge.recorded["native_times"] = times
        if recording:
            bridge.recorded["recorder_dropped"] = event["recording"]["dropped"]
            bridge.recorded["recorded_mb"] = round(event["recording"]["bytes"] / 1e6, 1)


@contextmanager
def foreign(name: str, case: Case, library: Path | None) -> Iterator[Bridge]:
    """The hop (``HOP``), or a bridge by its command.  Raises BenchError."""
    prepare_environment()  # the profile of DDS is that of the gateway
    port = free_port()
    command = hop_command(port, case, library) if name == HOP else split(name, port, case)
    try:
        program = Program(name, command)
    except OSError as error:
        raise BenchError(str(error)) from None
    with program:
        yield Bridge(program, ("127.0.0.1", port))
        program.interrupt()
        program.wait(_END_S)  # how it ends is its own affair


def hop_command(port: int, case: Case, library: Path | None) -> list[str]:
    """How to start the hop."""
    words = [sys.executable, "-m", "igtl_gateway_lab.bench.hop", "--port", str(port), "--case", case.name]
    return [*words, "--library", str(library)] if library else words


def split(command: str, port: int, case: Case) -> list[str]:
    """The words of a command; ``{port}`` and ``{case}`` in them are replaced."""
    return [word.replace("{port}", str(port)).replace("{case}", case.name) for word in shlex.split(command)]


def wait_ready(programs: Sequence[Program], bridge: Bridge | None) -> None:
    """Wait until all are; not any longer if one has ended, or the bridge.  Raises BenchError."""
    for program in programs:
        for _ in range(round(START_S / _LOOK_S)):
            try:
                program.wait_for("ready", _LOOK_S)
            except BenchError as error:
                for other in (bridge.program if bridge else program, program):
                    other.check()
                late = error
            else:
                break
        else:
            raise late


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
