"""What a recording costs by ``--outputs`` and ``--compression``: CPU, latency and size, in turns.

    .venv/bin/python tools/evidence/recorder_cost.py --pictures FILE.mha|speckle|video [--writer]

A program sends pictures (20 Hz) and a TRANSFORM (100 Hz) to a bridge that records; a ROS node measures how old the
poses are when they arrive.  Each round has all combinations, one after the other, each with a bridge of its own.  The
table has medians of the rounds, and ratios to the first combination of the same round: all share the machine's load.
With ``--writer`` only the file is written, of the same entries: its CPU time depends little on other programs.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.large_outputs import LargeOutputs
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.transform import Transform
from igtl_gateway_lab.bench.processes import Program, Usage

COMPRESSIONS = ("lz4", "none", "auto", "zstd")
OUTPUTS = ("full", "digest")
PICTURES_HZ, POSES_HZ, WAIT_S = 20, 100, 60.0
#: Seconds until all streams are there, in which nothing is measured.
STEADY_S = 3.0


def frames(source: str) -> list[Image]:
    """Pictures of a sequence file of PLUS, or synthetic ones: speckle, or a pattern with the noise of a sensor."""
    if source == "video":
        chance = np.random.default_rng(1)
        y, x = np.mgrid[0:480, 0:640]
        waves = ([120 + 60 * np.sin((x + 3 * at) / 50 + c) + 40 * np.cos(y / 37) for c in range(3)] for at in range(30))
        noisy = (np.stack(each, -1) + chance.normal(0, 2, (480, 640, 3)) for each in waves)
        return [Image((640, 480, 1), 3, np.clip(each, 0, 255).astype("u1").tobytes(), 3) for each in noisy]
    if source == "speckle":
        chance = np.random.default_rng(4)
        noise = chance.rayleigh(1.0, (40, 480, 640))
        levels = np.clip((20 * np.log10(noise + 1e-6) + 40) / 60 * 255, 0, 255).astype(np.uint8)
        return [Image((640, 480, 1), 3, each.tobytes()) for each in levels]
    head, _, rest = Path(source).read_bytes().partition(b"ElementDataFile = LOCAL\n")
    fields = dict(line.split(" = ", 1) for line in head.decode("latin-1").splitlines() if " = " in line)
    width, height, count = map(int, fields["DimSize"].split())
    data = zlib.decompress(rest) if fields.get("CompressedData") == "True" else rest
    size = width * height
    return [Image((width, height, 1), 3, data[at * size : (at + 1) * size]) for at in range(min(count, 60))]


def send(port: int, seconds: float, source: str) -> None:
    """Send pictures and poses, with the time as their stamp."""
    pictures = frames(source)
    with socket.create_connection(("127.0.0.1", port)) as peer:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        print(json.dumps({"event": "ready"}), flush=True)
        begun = time.monotonic()
        for number in range(int(seconds * POSES_HZ)):
            time.sleep(max(0.0, begun + number / POSES_HZ - time.monotonic()))
            if number % (POSES_HZ // PICTURES_HZ) == 0:
                picture = pictures[number // (POSES_HZ // PICTURES_HZ) % len(pictures)]
                peer.sendall(join(encode(Message("IMAGE", "Probe", picture, ns_to_ticks(time.time_ns())))))
            pose = Transform((1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, float(number), 0, 0))
            peer.sendall(join(encode(Message("TRANSFORM", "Tool", pose, ns_to_ticks(time.time_ns())))))
        time.sleep(0.5)


def hear() -> None:
    """Print the ages of poses, ns, when the standard input ends."""
    import rclpy
    from geometry_msgs.msg import TransformStamped

    rclpy.init()
    node, ages = rclpy.create_node("hears"), list[tuple[int, int]]()

    def take(message: TransformStamped) -> None:
        now = time.time_ns()
        ages.append((now, now - message.header.stamp.sec * NS_PER_S - message.header.stamp.nanosec))

    node.create_subscription(TransformStamped, "/igtl/in/Tool/transform", take, 100)
    print(json.dumps({"event": "ready"}), flush=True)
    ends = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        ends.set()

    threading.Thread(target=wait, daemon=True).start()
    while not ends.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)
    steady = [age for at, age in ages if at > ages[0][0] + STEADY_S * NS_PER_S] if ages else []
    print(json.dumps({"event": "heard", "ages": steady}), flush=True)


def measure(folder: Path, source: str, seconds: float, compression: str, outputs: str) -> dict[str, float]:
    """One bridge."""
    path = folder / "recording.mcap"
    own = [sys.executable, __file__]
    bridge = [str(Path(sys.executable).with_name("igtl-gateway")), "bridge", "--json", "--listen", "127.0.0.1:0"]
    bridge += ["--record", str(path), "--overwrite", "--compression", compression, "--outputs", outputs]
    with Program("bridge", bridge) as gateway, Program("hear", [*own, "--hear"]) as listener:
        port = int(gateway.wait_for("started", WAIT_S)["listen"][0]["port"])
        listener.wait_for("ready", WAIT_S)
        with Program("send", [*own, "--send", str(port), "--seconds", str(seconds), "--pictures", source]) as sender:
            sender.wait_for("ready", WAIT_S)
            time.sleep(STEADY_S)
            begin = Usage.of(gateway.pid)
            time.sleep(seconds - STEADY_S - 0.5)
            end = Usage.of(gateway.pid)
            sender.wait(WAIT_S)
        listener.close_input()
        ages = sorted(listener.wait_for("heard", WAIT_S)["ages"])
        gateway.interrupt_and_wait()
        stopped = gateway.wait_for("stopped", WAIT_S)["recording"]
    pixels = len(frames(source)[0].pixels) * int(seconds * PICTURES_HZ)
    return {
        "recorder_cpu_s": end.children_cpu_s - begin.children_cpu_s,
        "bridge_cpu_s": end.cpu_s - begin.cpu_s,
        "p50_ms": ages[len(ages) // 2] / 1e6,
        "p99_ms": ages[len(ages) * 99 // 100] / 1e6,
        "size": stopped["bytes"] / pixels,
        "dropped": float(stopped["dropped"]),
    }


def session(source: str, seconds: float) -> list[Entry]:
    """The entries of such a session."""
    pictures, gateway = frames(source), ManualGateway(Config())
    link = gateway.connect()
    for number in range(int(seconds * POSES_HZ)):
        gateway.advance(1 / POSES_HZ)
        if number % (POSES_HZ // PICTURES_HZ) == 0:
            picture = pictures[number // (POSES_HZ // PICTURES_HZ) % len(pictures)]
            gateway.from_peer(join(encode(Message("IMAGE", "Probe", picture))), link)
        pose = Transform((1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, float(number), 0, 0))
        gateway.from_peer(join(encode(Message("TRANSFORM", "Tool", pose))), link)
    return list(gateway.log)


def write(path: Path, entries: Sequence[Entry], compression: Any, outputs: Any) -> dict[str, float]:
    """Write a file as the recorder does, with its flushes."""
    pixels = sum(entry.size for entry in entries if entry.kind is Kind.IGTL_IN and entry.type == "IMAGE")
    begun, flush_ns = time.process_time(), 0
    facts = {"config": json.dumps(Config().to_dict())}
    writer = SessionWriter(
        path, facts, compression=compression, together=True, overwrite=True, counted=True, outputs=LargeOutputs(outputs)
    )
    for entry in entries:
        if entry.stamp_ns > flush_ns:
            writer.flush()
            flush_ns = entry.stamp_ns + NS_PER_S // 2
        writer.write(entry)
    writer.close({})
    cpu_s = time.process_time() - begun
    return {
        "recorder_cpu_s": cpu_s,
        "bridge_cpu_s": 0.0,
        "p50_ms": 0.0,
        "p99_ms": 1.0,
        "size": path.stat().st_size / pixels,
    }


def ratio(of: Sequence[dict[str, float]], base: Sequence[dict[str, float]], *names: str) -> float:
    """The median of the ratios of rounds, of sums of some figures."""
    return median(
        sum(a[name] for name in names) / sum(b[name] for name in names) for a, b in zip(of, base, strict=True)
    )


def table(rounds: Sequence[dict[tuple[str, str], dict[str, float]]]) -> str:
    """Medians, and the ratios to the first combination of each round."""
    names = "`--outputs`", "`--compression`", "MB for each MB of pictures", "recorder, s of CPU", "ratio"
    lines = [f"| {' | '.join(names)} | with the bridge, ratio | p50, ms | p99, ms | ratio |"]
    lines.append("|---|---|---:|---:|---:|---:|---:|---:|---:|")
    first = [next(iter(each.values())) for each in rounds]
    for compression, outputs in rounds[0]:
        of = [each[compression, outputs] for each in rounds]
        mid = {name: median(each[name] for each in of) for name in of[0]}
        both = ratio(of, first, "recorder_cpu_s", "bridge_cpu_s")
        cells = [mid["size"], mid["recorder_cpu_s"], ratio(of, first, "recorder_cpu_s"), both, mid["p50_ms"]]
        cells += [mid["p99_ms"], ratio(of, first, "p99_ms")]
        lines.append(f"| {outputs} | {compression} | {' | '.join(f'{cell:.2f}' for cell in cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", default="speckle")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--compression", nargs="+", default=COMPRESSIONS)
    parser.add_argument("--outputs", nargs="+", default=OUTPUTS)
    parser.add_argument("--send", type=int)
    parser.add_argument("--hear", action="store_true")
    parser.add_argument("--writer", action="store_true")
    options = parser.parse_args()
    if options.send:
        return send(options.send, options.seconds, options.pictures)
    if options.hear:
        return hear()
    rounds: list[dict[tuple[str, str], dict[str, float]]] = []
    entries = session(options.pictures, options.seconds) if options.writer else []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(options.rounds):
            keys = [(compression, outputs) for outputs, compression in product(options.outputs, options.compression)]
            found: dict[tuple[str, str], Any] = {}
            for compression, outputs in keys:
                if options.writer:
                    found[compression, outputs] = write(Path(folder) / "a.mcap", entries, compression, outputs)
                    continue
                found[compression, outputs] = measure(
                    Path(folder), options.pictures, options.seconds, compression, outputs
                )
                print(compression, outputs, found[compression, outputs], file=sys.stderr, flush=True)
            rounds.append(found)
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(table(rounds))


if __name__ == "__main__":
    main()
