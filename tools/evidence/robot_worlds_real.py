"""Worlds of what a robot gets over real DDS: ``python tools/evidence/robot_worlds_real.py --worlds 200``.

Strategy: one bridge without sockets (the real hub, core, guard and RosEdge), and in the same graph arms, robots and
other nodes of rclpy, in contexts of their own.  Each world has an arm of its own.  Its robot subscribes early, late, or
leaves and comes back; another node may look at the commands with a QoS that never matches, or with one that does; with
``foreign`` the edge takes all readers for those of another vendor.  A peer streams set points meanwhile.  The judge is
each reader: it integrates what it got by the source stamps of DDS.  In the last batch the edge stops in the middle.

Times are real, so a world is not the same again by its seed.  The exit code is 1 if a promise is broken.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.hub import Hub
from igtl_gateway.app.ros_traffic import RosTraffic
from igtl_gateway.app.subscriptions import Subscriptions
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.edges.ros import graph
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.transform import Transform
from tests import domains

SPEED, MAX_AGE_S, BEHIND_S, BEGIN_S = 0.25, 0.5, 0.2, 0.02
_HZ, _LASTS_S = 50, 3.0
#: What float32 on the wire rounds, m.
_NOTHING = 1e-7


@dataclass
class Reader:
    """A subscription: what it got, as (source stamp ns, stamp of the command ns, x m, x of the arm m)."""

    name: str
    got: list[tuple[int, int, float, float]] = field(default_factory=list)


class World:
    """One arm, its robot and other nodes."""

    def __init__(self, number: int, node: Any, types: Any, rng: random.Random, hub: Hub) -> None:
        self.arm, self.node, self.types, self.rng, self.hub = f"W{number}", node, types, rng, hub
        self.at, self.readers = 0.0, list[Reader]()
        self.follows = rng.random() < 0.8
        self.publisher = node.create_publisher(types.pose, f"/{self.arm}/measured_cp", 10)
        self.late_s = rng.choice((0.0, 0.0, 0.3, 0.9, 1.5))
        self.returns = rng.random() < 0.4
        self.looker = rng.choice(("none", "none", "incompatible", "incompatible", "compatible"))
        self.looker_s = rng.uniform(0.0, 2.0)
        self.factor, self.swing_s = rng.choice((0.3, 0.8, 1.0)), rng.choice((0.1, 0.3, 3.0))
        self._subscription: Any = None

    def subscribe(self, name: str, *, is_robot: bool, latched: bool = False) -> Any:
        """Subscribe to the commands of the arm."""
        qos = self.types.qos.QoSProfile(depth=100)
        if latched:
            qos.durability = self.types.qos.DurabilityPolicy.TRANSIENT_LOCAL
        reader = Reader(f"{self.arm} {name}")
        self.readers.append(reader)

        def came(message: Any, info: Any) -> None:
            stamp = message.header.stamp
            x = message.pose.position.x
            sent_ns = stamp.sec * NS_PER_S + stamp.nanosec
            reader.got.append((info["source_timestamp"], sent_ns, x, self.at))
            if is_robot and self.follows:
                self.at = x

        return self.node.create_subscription(self.types.pose, f"/{self.arm}/servo_cp", came, qos)

    def run(self, stop: threading.Event) -> None:
        """Play the world in real time."""
        begun, looker, robot, number = time.monotonic(), None, None, 0
        left_s = self.late_s + 1.0
        while (at_s := time.monotonic() - begun) < _LASTS_S and not stop.is_set():
            if robot is None and at_s >= self.late_s and (at_s < left_s or at_s >= left_s + 0.05):
                robot = self.subscribe("robot", is_robot=True)
                left_s = left_s if at_s < left_s else 1e9
            if robot is not None and self.returns and at_s >= left_s:
                self.node.destroy_subscription(robot)
                robot, left_s = None, at_s - 0.04
            if looker is None and self.looker != "none" and at_s >= self.looker_s:
                looker = self.subscribe(self.looker, is_robot=False, latched=self.looker == "incompatible")
            self.measure()
            if at_s > 0.2:
                phase = (at_s - 0.2) / self.swing_s
                self.command(self.factor * SPEED * self.swing_s * (phase if self.swing_s > 1 else _swing(phase)))
            number += 1
            time.sleep(max(0.0, begun + number / _HZ - time.monotonic()))

    def measure(self) -> None:
        """The arm shows where it is."""
        message, now_ns = self.types.pose(), time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, NS_PER_S)
        message.pose.position.x, message.pose.orientation.w = self.at, 1.0
        self.publisher.publish(message)

    def command(self, x: float) -> None:
        """The peer sends a set point."""
        content = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, x, 0.0, 0.0))
        message = Message("TRANSFORM", f"{self.arm}/servo_cp", content, ns_to_ticks(time.time_ns()))
        self.hub.igtl(1, join(encode(message)))

    def broken(self, stopped_ns: int) -> list[str]:
        """Return the promises that were not kept."""
        texts = []
        for reader in self.readers:
            got = sorted(reader.got)
            for one, other in pairwise(got):
                way, most = abs(one[2] - other[2]), SPEED * (other[0] - one[0]) / NS_PER_S
                if way > most + _NOTHING:
                    texts.append(f"speed: {1000 * way:.2f} mm in {(other[0] - one[0]) / 1e6:.3f} ms, {reader.name}")
            for stamp_ns, sent_ns, x, at in got:
                if stamp_ns - sent_ns > MAX_AGE_S * NS_PER_S:
                    texts.append(f"age: {(stamp_ns - sent_ns) / 1e9:.3f} s, {reader.name}")
                if stamp_ns > stopped_ns:
                    texts.append(f"stop: written after it, {reader.name}")
                # the arm moves on while its state is on its way, at most at the limit
                if abs(x - at) > SPEED * (BEHIND_S + 0.5):
                    texts.append(f"behind: {1000 * abs(x - at):.1f} mm, {reader.name}")
            if got and "robot" in reader.name and not self.follows and abs(got[0][2]) > SPEED * BEHIND_S + _NOTHING:
                texts.append(f"begin: {1000 * abs(got[0][2]):.1f} mm, {reader.name}")
        return texts


def _swing(phase: float) -> float:
    """A triangle between -1 and 1 with slope 1."""
    phase %= 4.0
    return phase if phase < 1 else 2 - phase if phase < 3 else phase - 4


def batch(first: int, count: int, rng: random.Random, *, stops: bool, foreign: bool) -> tuple[list[str], Counter[str]]:
    """Play several worlds at a time with one edge."""
    import rclpy.context
    import rclpy.executors
    import rclpy.node
    import rclpy.qos
    from geometry_msgs.msg import PoseStamped

    @dataclass
    class Types:
        pose: Any = PoseStamped
        qos: Any = rclpy.qos

    vendor = graph.FAST_DDS
    graph.FAST_DDS = (0x01, 0x10) if foreign else vendor
    log: list[Entry] = []
    clock = SystemClock()
    config = Config(profile="crtk:/W*", allow_in=("*/servo_cp",)).watched()
    gateway = Gateway(config)
    traffic: RosTraffic

    def dispatch(entry: Entry) -> None:
        if entry.kind is Kind.ROS_OUT:
            traffic.publish(entry)

    hub = Hub(Session(gateway), clock, [dispatch, log.append])
    subscriptions = Subscriptions(gateway, (), hub.note)
    traffic = RosTraffic(BridgeOptions(), gateway, hub, subscriptions, None, None, builds_all=True)
    context = rclpy.context.Context()
    context.init(args=[])
    node = rclpy.node.Node("arms", context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    stop, ended = threading.Event(), threading.Event()

    def spin() -> None:
        while not ended.is_set():
            with suppress(rclpy._rclpy_pybind11.InvalidHandle):  # a subscription that another thread has removed
                executor.spin_once(0.02)

    spins = threading.Thread(target=spin, daemon=True)
    traffic.start()
    hub.link(1, Note(Level.INFO, LINK_UP, "up"))
    worlds = [World(first + number, node, Types, random.Random(rng.random()), hub) for number in range(count)]
    spins.start()
    threads = [threading.Thread(target=each.run, args=(stop,)) for each in worlds]
    for thread in threads:
        thread.start()
    if stops:
        time.sleep(_LASTS_S / 2)
        traffic.stop()
        stopped_ns = time.time_ns()
        time.sleep(0.5)
        stop.set()
    for thread in threads:
        thread.join()
    if not stops:
        time.sleep(0.2)
        traffic.stop()
        stopped_ns = time.time_ns()
        time.sleep(0.3)
    ended.set()
    spins.join()
    executor.shutdown()
    node.destroy_node()
    context.shutdown()
    graph.FAST_DDS = vendor
    texts = [text for each in worlds for text in each.broken(stopped_ns)]
    session = Session(Gateway(config, fast_path=False))
    if any(session.recorded(group.input) != list(group.outputs) for group in input_groups(log)):
        texts.append("verify: outputs differ")
    counts = Counter({"worlds": count})
    for each in worlds:
        counts[f"looker: {each.looker}"] += 1
        counts["late robot"] += each.late_s > 0
        counts["returning robot"] += each.returns
        counts["worlds with motion"] += any(len(reader.got) > 1 for reader in each.readers)
        counts["received"] += sum(len(reader.got) for reader in each.readers)
    counts["foreign"] += count * foreign
    counts["stopped in the middle"] += count * stops
    counts["sent"] = sum(entry.kind is Kind.IGTL_IN for entry in log)
    counts["written"] = sum(entry.kind is Kind.ROS_OUT and "servo" in entry.channel for entry in log)
    counts.update(note.code for entry in log if entry.kind is Kind.NOTE and (note := Note.of(entry.data())))
    return texts, counts


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=200)
    parser.add_argument("--at-once", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(domains.OWN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    rng = random.Random(options.seed)
    total, failed = Counter[str](), 0
    for first in range(0, options.worlds, options.at_once):
        kind = first // options.at_once % 4
        texts, counts = batch(first, options.at_once, rng, stops=kind == 1, foreign=kind == 2)
        total += counts
        failed += len(texts)
        for text in texts[:5]:
            print(text, flush=True)
    print(json.dumps({"broken promises": failed, **dict(sorted(total.items()))}, indent=1))
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
