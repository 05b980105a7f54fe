"""``igtl-gateway demo``: the main job in a minute, on real traffic.

The bridge, a ROS 2 node and an OpenIGTLink client run as three programs; the bridge records their messages,
and the recording is verified and replayed.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, GatewayError, Unavailable
from igtl_gateway.base.extras import missing
from igtl_gateway.base.quantities import count_text, duration_text, size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.cli.next_steps import command, print_next
from igtl_gateway.cli.options import default
from igtl_gateway.cli.terminal import print_line
from igtl_gateway.edges.ros_interfaces.cache import make_ready
from igtl_gateway_lab.programs import Event, EventProgram

EXAMPLES = """\
  # write the recording to igtl-gateway-demo/demo.mcap
  igtl-gateway demo
  # write it to out/demo.mcap
  igtl-gateway demo --keep out"""

_FOLDER = Path("igtl-gateway-demo")

_TIMEOUT_S = 60.0


class DemoError(GatewayError):
    """A part of the demo did not do its job."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seconds", type=float, default=8.0, metavar="SECONDS", help="duration of the traffic " + default("8.0")
    )
    parser.add_argument(
        "--keep", type=Path, default=_FOLDER, metavar="DIR", help="directory of the recording " + default(_FOLDER)
    )


def run(options: argparse.Namespace) -> int:
    for package in ("rclpy", "pyigtl"):
        if importlib.util.find_spec(package) is None:
            raise Unavailable(f"{missing(package)}; `make demo` installs what it needs")
    if not 1 <= options.seconds <= 600:
        raise ConfigError(f"--seconds: found {options.seconds}, expected 1 to 600")
    # the demo must neither receive from other robots nor disturb them
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
    try:
        options.keep.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GatewayError(f"--keep {options.keep}: {error.strerror or error}, expected a writable directory") from None
    make_ready()  # its programs wait for each other, and a terminal shows the progress
    return _demo(options.keep / "demo.mcap", options.seconds)


def _demo(recording: Path, seconds: float) -> int:
    _title(1, "the bridge runs and records; a ROS 2 node and an OpenIGTLink client talk through it")
    summaries = _traffic(recording, seconds)
    for name, summary in summaries.items():
        print_line("", f"{name} sent {count_text(sum(summary['sent'].values()), 'message')} and received:")
        for stream, counts in sorted(summary["received"].items()):
            print_line(f"  {stream:<36} {counts['messages']:>5}, last: {counts['last']}")
        if not summary["received"]:
            raise DemoError(f"{name} received nothing")
    _title(2, f"what was recorded ({size_text(recording.stat().st_size)})")
    _gateway("info", str(recording))
    _title(3, "verify: do the recorded outputs follow from the recorded inputs?")
    _gateway("verify", str(recording))
    _title(4, "replay to OpenIGTLink, twice: at 4 times the speed, and as fast as possible")
    wanted = _recorded_outputs(recording)
    digests = [_replayed(recording, pace) for pace in (("--rate", "4"), ("--as-fast-as-possible",))]
    if any(digest != wanted for digest in digests):
        raise DemoError(f"the replays differ from the recording: {digests}, expected {wanted}")
    print_line(f"both replays delivered {count_text(wanted[1], 'byte')} with SHA-256 {wanted[0][:16]}…")
    print_line("the bytes were identical to those that the bridge sent to the client.")
    print_line("", f"demo: all good; the recording is {recording}", "")
    print_next(
        (command("view", recording), "show it in rerun"),
        (command("replay", recording, "--to", "igtl"), "serve it to 3D Slicer or another client, port 18944"),
        (command("bridge", "--record", "mine.mcap"), "record programs of your own"),
        title="try next",
    )
    return 0


def _title(number: int, text: str) -> None:
    print_line("", f"--- {number}/4  {text}", flush=True)


def _traffic(recording: Path, seconds: float) -> dict[str, dict[str, Any]]:
    """Run the three programs; return the summaries of the node and the client."""
    command = ["bridge", "--listen", "127.0.0.1:0", "--record", str(recording), "--overwrite", "--json"]
    with _program("igtl_gateway", *command) as bridge:
        port = _event(bridge, "started")["listen"][0]["port"]
        print_line(f"bridge: OpenIGTLink server on 127.0.0.1:{port}, ROS 2 node /igtl_gateway", flush=True)
        with _program("igtl_gateway_lab.demo.ros_node") as node:
            _event(node, "ready")
            print_line("ROS 2 node (rclpy): publishes and listens", flush=True)
            with _program("igtl_gateway_lab.demo.igtl_client", str(port), str(seconds)) as client:
                _event(client, "ready")
                print_line(f"OpenIGTLink client (pyigtl): sends and listens for {seconds:g} s", flush=True)
                client_summary = _event(client, "summary")
                client.wait_ended(_TIMEOUT_S)
            node.close_input()
            node_summary = _event(node, "summary")
            node.wait_ended(_TIMEOUT_S)
        bridge.interrupt()
        recorded = _event(bridge, "stopped")["recording"]
        entries = count_text(recorded["entries"], "entry", "entries")
        print_line(f"bridge: stopped, {entries} recorded, {recorded['dropped']} lost")
        bridge.wait_ended(_TIMEOUT_S)
    return {"ROS 2 node (rclpy)": node_summary, "OpenIGTLink client (pyigtl)": client_summary}


class _Program(EventProgram):
    """A program of the demo."""

    error = DemoError


def _program(module: str, *arguments: str) -> _Program:
    """Start a Python module as a program."""
    return _Program(module, [sys.executable, "-m", module, *arguments])


def _event(program: _Program, name: str) -> Event:
    """The next event of this name; warnings before it are printed."""
    return program.wait_for(name, _TIMEOUT_S, _print_warning)


def _print_warning(event: Event) -> None:
    if event.get("level") in ("WARN", "ERROR"):
        print_line(f"  {event['text']}")


def _gateway(*arguments: str) -> None:
    """Another verb of this command line, as the user would call it."""
    print_line(f"$ igtl-gateway {' '.join(arguments)}", flush=True)
    code = subprocess.run([sys.executable, "-m", "igtl_gateway", *arguments], check=False).returncode
    if code:
        raise DemoError(f"igtl-gateway {arguments[0]} ended with exit code {code}")


def _recorded_outputs(recording: Path) -> tuple[str, int]:
    """SHA-256 and size of the bytes that the bridge sent, read from the file without the replay code."""
    from igtl_gateway.gateway.log.entry import Kind
    from igtl_gateway.record.sessionfile.reader import SessionFile

    digest, total = hashlib.sha256(), 0
    with SessionFile.open(recording) as file:
        for entry in file.entries():
            if entry.kind is Kind.IGTL_OUT:
                digest.update(entry.data())
                total += entry.size
    return digest.hexdigest(), total


def _replayed(recording: Path, pace: tuple[str, ...]) -> tuple[str, int]:
    """SHA-256 and size of what a plain socket receives from a replay."""
    clock = SystemClock()
    with _program("igtl_gateway_lab.demo.collector") as collector:
        target = f"127.0.0.1:{_event(collector, 'ready')['port']}"
        begun_ns = clock.monotonic_ns()
        with _program(
            "igtl_gateway", "replay", str(recording), "--to", "igtl", "--exact", "--connect", target, "--json", *pace
        ):
            summary = _event(collector, "summary")
        seconds = (clock.monotonic_ns() - begun_ns) / NS_PER_S
    print_line(
        f"replay {' '.join(pace):<24} {count_text(summary['bytes'], 'byte')} in {duration_text(seconds * NS_PER_S)}",
        flush=True,
    )
    return summary["sha256"], summary["bytes"]
