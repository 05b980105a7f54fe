"""Two sites in two network namespaces, joined by a slow line: how late poses are while video saturates it.

    python tools/evidence/site_latency.py [SECONDS]      (as root)

At each site are a router of Zenoh, a gateway that records, and a peer that sends poses; that of the operating room
also sends pictures, more than the line carries.  Both gateways have the clock of this machine, so the true offset is 0.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addons.merge.merging import Source, merge
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.integration.netns import Lines, Weather

RATE = 1_250_000
DELAY_S = 0.02
BUDGET_KIB = 600

#: Two connections between the routers: what is urgent never waits behind pictures in the buffer of a socket.
URGENT, REST = "?prio=1-4", "?prio=5-7#so_sndbuf=16384"

ROUTER = """
import json, sys, time, zenoh
config = zenoh.Config()
for name, value in json.loads(sys.argv[1]).items():
    config.insert_json5(name, json.dumps(value))
session = zenoh.open(config)
print("ready", flush=True)
time.sleep(600)
"""
PEER = """
import sys, time
import numpy as np
import igtl_gateway as ig
seconds, poses, pictures, name = float(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
peer = ig.connect("127.0.0.1", 18944)
picture = np.random.default_rng(1).integers(0, 255, (1, 240, 320), dtype=np.uint8)
start = time.monotonic()
due = {"pose": start, "picture": start}
n = 0
while (now := time.monotonic()) < start + seconds:
    if now >= due["pose"]:
        due["pose"] += 1 / poses
        matrix = np.eye(4); n += 1; matrix[0, 3] = n
        peer.send("TRANSFORM", name, matrix)
    if pictures and now >= due["picture"]:
        due["picture"] += 1 / pictures
        peer.send("IMAGE", "Video", picture)
    time.sleep(max(0, min(due["pose"], due["picture"] if pictures else now + 1) - time.monotonic()))
time.sleep(1)
peer.close()
"""


@dataclass(frozen=True)
class Case:
    """What differs: pictures per second, options of the gateways, and the way between the routers."""

    name: str
    pictures: float
    options: tuple[str, ...]
    suffixes: tuple[str, ...]
    loss: float = 0.0


SITE = ("--site", "{site}", "--site-budget", str(BUDGET_KIB))
CASES = (
    Case("idle, sites", 0, SITE, (URGENT, REST)),
    Case("video, sites", 40, SITE, (URGENT, REST)),
    Case("video, as ROS sends it", 40, (), ("",)),
    Case("idle, sites, 1 % loss", 0, SITE, (URGENT, REST), 0.01),
    Case("video, sites, 1 % loss", 40, SITE, (URGENT, REST), 0.01),
)


def run(case: Case, seconds: float, folder: Path) -> dict[str, Any]:
    """Run a case; return the latencies of poses in ms, and what ``merge`` states."""
    with ExitStack() as stack:
        lines = stack.enter_context(Lines(1))
        lines.shape(0, Weather(DELAY_S, 0.0, case.loss, rate=RATE))

        def started(end: Sequence[str], *words: str) -> subprocess.Popen[str]:
            env = os.environ | {"ROS_DOMAIN_ID": "17"}
            command = [*end, sys.executable, *words]
            process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=sys.stderr, text=True)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        common = {
            "mode": "router",
            "scouting/multicast/enabled": False,
            "transport/unicast/max_links": 2,
            # both sites are on one machine, and large messages must not go around the line
            "transport/shared_memory/enabled": False,
        }
        listen = [f"tcp/0.0.0.0:{7447 + i}{way}" for i, way in enumerate(case.suffixes)]
        near = common | {"listen/endpoints": [*listen, "tcp/127.0.0.1:7400"]}
        far = common | {
            "listen/endpoints": ["tcp/127.0.0.1:7400"],
            "connect/endpoints": [f"tcp/10.77.0.1:{7447 + i}{way}" for i, way in enumerate(case.suffixes)],
        }
        for end, config in ((lines.near, near), (lines.far, far)):
            process = started(end, "-c", ROUTER, json.dumps(config))
            assert process.stdout and process.stdout.readline().strip() == "ready"
        gateways = []
        for end, site in ((lines.near, "or1"), (lines.far, "planning")):
            options = [word.format(site=site) for word in case.options]
            record = ["--record", str(folder / f"{site}.mcap"), "--overwrite", "--record-topics", "/igtl/in/**"]
            words = ["--ros", "zenoh:tcp/127.0.0.1:7400", "--node-name", site, "--listen", "127.0.0.1:18944"]
            gateways.append(started(end, "-m", "igtl_gateway", "bridge", *words, *record, *options))
        time.sleep(6)
        peers = [
            started(end, "-c", PEER, str(seconds), str(rate), str(pictures), name)
            for end, rate, pictures, name in (
                (lines.near, 100, case.pictures, "Probe"),
                (lines.far, 20, 0, "Plan"),
            )
        ]
        for peer in peers:
            peer.wait(seconds + 60)
        time.sleep(2)
        for gateway in gateways:
            gateway.send_signal(2)
        for gateway in gateways:
            gateway.wait(60)
    return judged(folder)


def judged(folder: Path) -> dict[str, Any]:
    sources = [Source(name, folder / f"{name}.mcap") for name in ("or1", "planning")]
    sent: dict[bytes, int] = {}
    late, pictures, notes = [], 0, {}
    with SessionFile.open(sources[0].path) as file:
        for entry in file.entries():
            if entry.kind is Kind.ROS_OUT and "Probe" in entry.channel and entry.type.endswith("Stamped"):
                sent[entry.data()] = entry.stamp_ns
    with SessionFile.open(sources[1].path) as file:
        for entry in file.entries():
            if entry.kind is Kind.ROS_IN and entry.data() in sent:
                late.append((entry.stamp_ns - sent[entry.data()]) / 1e6)
            pictures += entry.kind is Kind.ROS_IN and entry.type == "sensor_msgs/msg/Image"
            if entry.kind is Kind.EDGE_NOTE:
                note = json.loads(entry.data())
                if note["code"].startswith("site_"):
                    notes[note["code"], note["stream"]] = note["text"]
    # the first second has the declarations of Zenoh
    late = late[100:]
    merged = merge(sources, folder / "both.mcap", given={}, overwrite=True)
    clock = merged["parts"][1]["clock"]
    return {
        "poses": len(late),
        "sent": len(sent),
        "p50_ms": float(np.quantile(late, 0.5)),
        "p99_ms": float(np.quantile(late, 0.99)),
        "largest_ms": max(late),
        "pictures": pictures,
        "offset_ms": [None if clock[key] is None else 1e3 * clock[key] for key in ("low_s", "offset_s", "high_s")],
        "merged": [
            [row["from"], row["stream"], *(row[key] for key in ("messages", "min_ms", "p50_ms", "p99_ms", "error_ms"))]
            for row in merged["latencies"]
        ],
        "notes": sorted(notes.values()),
    }


def main(seconds: float, chosen: str = "") -> None:
    """Run the cases whose name has ``chosen`` in it; print what was found, then a table."""
    print(f"load average {os.getloadavg()[0]:.2f} at the start", flush=True)
    results: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        for case in CASES:
            if chosen in case.name:
                results[case.name] = found = run(case, seconds, Path(name))
                print(case.name, json.dumps(found, indent=1, ensure_ascii=False), flush=True)
    print(f"\ninjected: {1e3 * DELAY_S:g} ms each way, {RATE * 8 / 1e6:g} Mbit/s; latency of poses in ms")
    print(f"{'':24}{'p50':>7}{'p99':>7}{'largest':>9}{'pictures':>10}   p99 / idle p99")
    for label, found in results.items():
        _, after, loss = label.partition(", 1 % loss")
        idle = results.get(f"idle, sites{after}{loss}")
        ratio = f"{found['p99_ms'] / idle['p99_ms']:.2f}" if idle else ""
        row = f"{found['p50_ms']:7.1f}{found['p99_ms']:7.1f}{found['largest_ms']:9.1f}{found['pictures']:10d}"
        print(f"{label:24}{row}   {ratio}")
    print(f"load average {os.getloadavg()[0]:.2f} at the end")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 15.0, *sys.argv[2:3])
