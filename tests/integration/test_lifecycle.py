"""The bridge as a managed node: its transitions, called by another node, while messages arrive from both sides."""

from __future__ import annotations

import importlib
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.managed import ManagedBridge
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.ros.middleware import import_rclpy
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.transform import Transform
from tests.timing import WAIT_S

pytest.importorskip("lifecycle_msgs", reason='needs ROS 2: pip install "igtl-gateway[ros]"')

TIMEOUT_S = 2 * WAIT_S  # the first start compiles igtl_msgs
TOPIC = "/igtl/out/Tool"
NAME = "managed_gateway"
#: Rounds of all transitions under traffic.
ROUNDS = int(os.environ.get("LIFECYCLE_ROUNDS", "2"))


SERVICES = {
    "change_state": "ChangeState",
    "get_state": "GetState",
    "get_available_states": "GetAvailableStates",
    "get_available_transitions": "GetAvailableTransitions",
    "get_transition_graph": "GetAvailableTransitions",
}


class Manager:
    """Another node: it calls the services of the managed node, and publishes poses."""

    def __init__(self) -> None:
        from geometry_msgs.msg import TransformStamped as RosTransform

        TransitionEvent = importlib.import_module("lifecycle_msgs.msg").TransitionEvent  # noqa: N806

        rclpy = import_rclpy()
        self.context = rclpy.context.Context()
        self.context.init(args=[])
        self.node = rclpy.node.Node("manager", context=self.context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}
        self.events: list[tuple[str, str]] = []
        self.node.create_subscription(TransitionEvent, f"/{NAME}/transition_event", self._on_event, 100)
        self._publisher = self.node.create_publisher(RosTransform, TOPIC, 100)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _on_event(self, event: Any) -> None:
        self.events.append((event.start_state.label, event.goal_state.label))

    def publish(self, number: int) -> None:
        from geometry_msgs.msg import TransformStamped as RosTransform

        message = RosTransform(child_frame_id="tool")
        message.header.frame_id = "base"
        message.transform.translation.x = float(number)
        self._publisher.publish(message)

    def meet(self) -> None:
        """Wait for the services.  A server must know its client, too, or its answer is lost."""
        services = importlib.import_module("lifecycle_msgs.srv")
        for name, kind in SERVICES.items():
            self._clients[name] = self.node.create_client(getattr(services, kind), f"/{NAME}/{name}")
        for client in self._clients.values():
            assert client.wait_for_service(TIMEOUT_S)
        for _ in range(10):
            if self._answer("get_state", 1.0):
                break
        time.sleep(0.5)

    def call(self, name: str, transition: str = "") -> Any:
        found = self._answer(name, TIMEOUT_S, transition)
        assert found, f"no answer of {name}"
        return found

    def _answer(self, name: str, timeout_s: float, transition: str = "") -> Any:
        client = self._clients[name]
        request = client.srv_type.Request()
        if transition:
            request.transition.label = transition
        done = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: done.set())
        return future.result() if done.wait(timeout_s) else None

    def change(self, transition: str) -> bool:
        return bool(self.call("change_state", transition).success)

    @property
    def state(self) -> str:
        return str(self.call("get_state").current_state.label)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
        self._thread.join(TIMEOUT_S)


class Sender(threading.Thread):
    """A peer that connects as often as it can, and the publisher of the manager: numbered poses from both."""

    def __init__(self, managed: ManagedBridge[Bridge], manager: Manager) -> None:
        super().__init__(daemon=True)
        self._managed = managed
        self._manager = manager
        self._ending = threading.Event()
        self._peer: socket.socket | None = None
        self._address: Any = None

    def run(self) -> None:
        number = 0
        while not self._ending.is_set():
            number += 1
            self._manager.publish(number)
            self._send(number)
            time.sleep(0.001)
        if self._peer:
            self._peer.close()

    def _send(self, number: int) -> None:
        bridge = self._managed.bridge
        if bridge and bridge.addresses and bridge.addresses[0] != self._address:
            if self._peer:
                self._peer.close()
            self._address = bridge.addresses[0]
            with suppress(OSError):
                self._peer = socket.create_connection(self._address)
        pose = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, float(number), 0.0, 0.0))
        with suppress(OSError):
            if self._peer:
                self._peer.sendall(join(encode(Message("TRANSFORM", "Probe", pose))))

    def end(self) -> None:
        self._ending.set()
        self.join(TIMEOUT_S)


class Stage:
    """A managed bridge; the recording of session n is ``n.mcap``."""

    def __init__(self, folder: Path, *, autostart: bool = False) -> None:
        self.folder = folder
        self.bridges: list[Bridge] = []
        self.failures: list[str] = []
        self.ended = threading.Event()
        self.config = Config().watched()
        self.refusal: Exception | None = None
        self.managed = ManagedBridge(
            self._make, NAME, autostart=autostart, on_failure=self.failures.append, on_end=self.ended.set
        )

    def _make(self, host: NodeHost, number: int) -> Bridge:
        if self.refusal:
            raise self.refusal
        options = BridgeOptions((("127.0.0.1", 0),), record=self.folder / f"{number}.mcap", node_name=NAME)
        self.bridges.append(Bridge(self.config, options, SystemClock(), host=host))
        return self.bridges[-1]


@contextmanager
def staged(folder: Path, *, autostart: bool = False) -> Iterator[tuple[Stage, Manager]]:
    stage, manager = Stage(folder, autostart=autostart), Manager()
    try:
        stage.managed.start()
        manager.meet()
        yield stage, manager
    finally:
        stage.managed.stop()
        manager.close()


def wait_for(condition: Callable[[], Any]) -> None:
    until = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < until, "it took too long"
        time.sleep(0.005)


def received(bridge: Bridge, kind: str) -> int:
    return sum(row.get("received", 0) for row in bridge.ledger()["streams"].get(kind, {}).values())


def wait_for_more(bridge: Bridge) -> None:
    """Wait for some messages from both sides."""
    for kind in ("igtl_in", "ros_in"):
        least = received(bridge, kind) + 30
        wait_for(partial(_has_received, bridge, kind, least))


def _has_received(bridge: Bridge, kind: str, least: int) -> bool:
    return received(bridge, kind) >= least


def check_session(path: Path, bridge: Bridge) -> tuple[int, int]:
    """Check a recording and its ledger; return the numbers of messages that passed and that were refused."""
    assert bridge.losses["gaps"] == []
    with SessionFile.open(path) as file:
        config, entries = Config.from_dict(json.loads(file.session["config"])), list(file.entries())
        report = verify(file.entries(), config)
    assert report.good, report.firsts
    active, passed, refused = True, 0, 0
    numbers: dict[tuple[Kind, tuple[int, ...]], list[int]] = {}
    for entry in entries:
        if entry.kind is Kind.EDGE_NOTE and (settings := LiveSettings.from_note(Note.unpack(entry.data()))):
            active = settings.active
        elif entry.kind is Kind.IGTL_IN:
            numbers.setdefault((entry.kind, entry.links), []).append(_number_of_peer(entry.data()))
        elif entry.kind is Kind.ROS_IN:
            numbers.setdefault((entry.kind, ()), []).append(_number_of_ros(entry.data()))
        if entry.kind in (Kind.IGTL_IN, Kind.ROS_IN):
            passed, refused = passed + active, refused + (not active)
        if not active:
            assert entry.kind is not Kind.IGTL_OUT
            assert entry.kind is not Kind.ROS_OUT or entry.channel == "/igtl/links"
    for (kind, _), found in numbers.items():
        assert found == list(range(found[0], found[0] + len(found))), f"{kind}: messages are missing"
    streams = bridge.losses["streams"]
    rows = [*streams.get("igtl_in", {}).values(), *streams.get("ros_in", {}).values()]
    assert refused == sum(row.get("dropped", {}).get("inactive", 0) for row in rows)
    assert not any(row.get("dropped", {}).keys() - {"inactive"} for row in rows)
    assert passed + refused == sum(row.get("received", 0) for row in rows)
    return passed, refused


def _number_of_peer(data: bytes) -> int:
    return int(struct.unpack_from(">f", data, 58 + 36)[0])


def _number_of_ros(data: bytes) -> int:
    return int(TransformStamped.unpack(data).translation[0])


def test_every_transition_under_traffic(tmp_path: Path) -> None:
    with staged(tmp_path) as (stage, manager):
        assert manager.state == "unconfigured"
        assert len(manager.call("get_available_states").available_states) == 11
        assert [one.transition.label for one in manager.call("get_available_transitions").available_transitions] == [
            "configure",
            "shutdown",
        ]
        assert len(manager.call("get_transition_graph").available_transitions) > 20
        assert not manager.change("activate"), "not possible in this state"
        sender = Sender(stage.managed, manager)
        sender.start()
        threads = 0
        for number in range(ROUNDS):
            assert manager.change("configure")
            bridge = stage.bridges[-1]
            wait_for_more(bridge)
            for _ in range(2):
                assert manager.change("activate")
                wait_for_more(bridge)
                assert manager.change("deactivate")
                time.sleep(0.01)
            if number % 2:
                assert manager.change("activate")
                assert manager.change("deactivate")
            assert manager.change("cleanup")
            threads = threads or threading.active_count()
        assert threading.active_count() <= threads
        sender.end()
        assert manager.state == "unconfigured"
        wait_for(lambda: ("deactivating", "inactive") in manager.events)
        assert manager.change("shutdown")
        assert stage.ended.is_set() and stage.failures == []
    for number, bridge in enumerate(stage.bridges, start=1):
        passed, refused = check_session(tmp_path / f"{number}.mcap", bridge)
        assert passed > 100 and refused > 0
    assert len(stage.bridges) == ROUNDS


def test_a_bridge_that_starts_by_itself_is_active_and_can_be_deactivated(tmp_path: Path) -> None:
    with staged(tmp_path, autostart=True) as (stage, manager):
        assert manager.state == "active"
        (bridge,) = stage.bridges
        assert bridge.settings.active
        assert manager.change("deactivate")
        assert manager.state == "inactive"
        seen = [bridge.settings.active]
        assert manager.change("activate")
        assert [*seen, bridge.settings.active] == [False, True]
        assert manager.change("shutdown") and stage.ended.is_set()
        assert manager.state == "finalized"
        assert bridge.losses["gaps"] == []


def test_a_failed_transition_is_reported_and_leaves_nothing_open(tmp_path: Path) -> None:
    with staged(tmp_path) as (stage, manager):
        stage.refusal = ConfigError("port: found 70000, expected 0 to 65535")
        assert not manager.change("configure")
        assert manager.state == "unconfigured"
        stage.refusal = ValueError("a defect")
        assert not manager.change("configure")
        assert manager.state == "unconfigured", "by error processing"
        assert stage.failures == [
            "configure: port: found 70000, expected 0 to 65535",
            "configure: ValueError: a defect",
        ]
        stage.refusal = None
        assert manager.change("configure") and manager.change("activate")
        assert manager.state == "active"


def test_a_start_that_fails_raises_and_leaves_the_graph(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        stage = Stage(tmp_path, autostart=True)

        def make(host: NodeHost, _number: int) -> Bridge:
            return Bridge(stage.config, BridgeOptions((taken.getsockname(),)), SystemClock(), host=host)

        managed = ManagedBridge(make, NAME, autostart=True, on_failure=print, on_end=print)
        with pytest.raises(Unavailable):
            managed.start()
        assert managed.bridge is None
        managed.stop()


def test_the_command_line_waits_for_another_node_and_records_each_session(tmp_path: Path) -> None:
    arguments = ["bridge", "--no-autostart", "--listen", "127.0.0.1:0", "--node-name", NAME, "--json"]
    command = [sys.executable, "-m", "igtl_gateway", *arguments, "--record", str(tmp_path / "or.mcap")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    manager = Manager()
    try:
        manager.meet()
        assert manager.state == "unconfigured"
        assert not list(tmp_path.iterdir()), "configure makes the file"
        for transition in ("configure", "activate", "deactivate", "cleanup", "configure", "activate", "shutdown"):
            assert manager.change(transition), transition
            time.sleep(0.6)  # the program looks twice a second
        output, _ = process.communicate(timeout=TIMEOUT_S)
    finally:
        manager.close()
        process.kill()
        process.wait()
    assert process.returncode == 0
    events = [json.loads(line) for line in output.splitlines()]
    shown = [event["event"] for event in events if event["event"] in ("unconfigured", "started", "stopped")]
    assert shown == ["unconfigured", "started", "stopped", "unconfigured", "started", "stopped"]
    recorded = [Path(event["recording"]["path"]).name for event in events if event["event"] == "stopped"]
    assert recorded == ["or.mcap", "or-2.mcap"]
    for name in recorded:
        with SessionFile.open(tmp_path / name) as file:
            assert verify(file.entries(), Config.from_dict(json.loads(file.session["config"]))).good


def test_transitions_wait_until_the_owner_of_the_node_has_started(tmp_path: Path) -> None:
    stage, manager = Stage(tmp_path), Manager()
    try:
        stage.managed.host.start(lambda error: stage.failures.append(str(error)))  # for example to read its parameters
        manager.meet()
        done: list[bool] = []
        caller = threading.Thread(target=lambda: done.append(manager.change("configure")))
        caller.start()
        time.sleep(0.3)
        assert stage.bridges == [] and done == []
        stage.managed.start()
        caller.join(TIMEOUT_S)
        assert done == [True] and len(stage.bridges) == 1
    finally:
        stage.managed.stop()
        manager.close()
