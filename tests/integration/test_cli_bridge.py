"""``igtl-gateway bridge`` as a person meets it: what it prints, how it ends, what it leaves behind."""

from __future__ import annotations

import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory

from igtl_gateway.native.passage import is_compiled
from tests import processes
from tests.integration.bridge import (
    SECOND_DOMAIN,
    TIMEOUT_S,
    Bridge,
    Program,
    RawPeer,
    Result,
    RosClient,
    children,
    gateway,
    string,
)
from tests.places import ROOT
from tests.several import Outcome, outcomes

needs_ros = pytest.mark.ros

JOINTS, HEALTH, TEXT = "sensor_msgs/msg/JointState", "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/String"


@pytest.fixture
def programs() -> Iterator[list[Program]]:
    """Programs that are ended with the test, however that goes."""
    started: list[Program] = []
    yield started
    for program in started:
        program.close()


def run(programs: list[Program], *arguments: str, **changes: str) -> Result:
    """A program that ends by itself."""
    programs.append(gateway(*arguments, **changes))
    return programs[-1].end(None)


def refused(result: Result | Outcome, code: int = 2) -> str:
    """The one line of an error; of usage, unless another code is given."""
    assert (result.code, result.out) == (code, "")
    (line,) = result.err.splitlines()
    return line


def recorded(path: Path) -> list[tuple[str, str, Any]]:
    """Topic, type and decoded message of a finished file, by its index, with the readers of the mcap project."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None and summary.chunk_indexes
        messages = [
            (channel.topic, schema.name, decoded)
            for schema, channel, _, decoded in reader.iter_decoded_messages()
            if schema is not None
        ]
        assert len(messages) == summary.statistics.message_count
    return messages


def cut_off(path: Path) -> list[tuple[str, bytes]]:
    """Topic and bytes of the messages of a file that has no end (yet), as far as it goes."""
    found = []
    try:
        with path.open("rb") as stream:
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                found.append((channel.topic, message.data))
    except McapError:
        pass  # the end of what there is
    return found


def wait_flushed(path: Path, enough: Callable[[list[tuple[str, bytes]]], bool]) -> None:
    """Wait until the unfinished file holds what is asked for."""
    deadline = time.monotonic() + TIMEOUT_S
    while not enough(found := cut_off(path)):
        assert time.monotonic() < deadline, f"not flushed: {[topic for topic, _ in found]}"
        time.sleep(0.05)


def hidden_ros(folder: Path) -> str:
    """PYTHONPATH with which rclpy cannot be imported."""
    package = folder / "rclpy"
    package.mkdir()
    (package / "__init__.py").write_text("raise ImportError('no rclpy in this test')\n")
    here = ROOT
    return f"{folder}:{here}"


@needs_ros
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_without_options_until_a_signal(programs: list[Program], tmp_path: Path, number: signal.Signals) -> None:
    """Another bridge on this machine might use the default address; any other port then shows the same."""
    path = tmp_path / "out.mcap"
    default = default_port_is_free()
    bridge = gateway("bridge", "--record", str(path), *([] if default else ["--listen", "127.0.0.1:0"]))
    programs.append(bridge)
    bridge.wait_until(lambda: "Press Ctrl-C to stop." in bridge.lines, "greeting")
    shown = "\n".join(bridge.lines)
    if default:
        assert "server on 127.0.0.1:18944" in shown
    assert f"recording    {path}" in shown
    assert "conversion   fast, in C, to ROS from 4 s after the start on" in shown or not is_compiled()
    assert "published on /igtl/in/<device>/<kind>, poses also on /tf (mm -> m)" in shown
    assert "subscribed to /igtl/out/<device> (m -> mm)" in shown
    address = next(line for line in bridge.lines if "server on" in line).rpartition(":")[2]
    with RawPeer(int(address)) as peer:
        peer.send(string("to be kept"))
        bridge.wait_until(lambda: any("STRING/Raw goes to" in line for line in bridge.lines), "stream")
        result = bridge.end(number)
    assert (result.code, result.err) == (0, "")
    assert re.search(r"stopped; OpenIGTLink: 1 in, 0 out; ROS: 0 in, \d out; rejected: 0", result.out)
    assert "LEDGER DOES NOT CLOSE" not in result.out
    messages = recorded(path)
    assert f"recorded {len(messages)} entries to {path}" in result.out
    assert [message.data for topic, _, message in messages if topic == "/igtl/in/Raw/string"] == ["to be kept"]


def default_port_is_free() -> bool:
    try:
        with socket.create_server(("127.0.0.1", 18944)):
            return True
    except OSError:
        return False


def test_port_in_use(programs: list[Program], tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        result = run(programs, "bridge", "--no-ros", "--listen", port, "--record", str(path))
    line = refused(result, 1)
    assert f"127.0.0.1:{port}" in line and "in use" in line
    assert not path.exists()


def test_recording_that_cannot_be_made(tmp_path: Path) -> None:
    missing, there = tmp_path / "missing" / "out.mcap", tmp_path / "there.mcap"
    there.write_bytes(b"something else")
    paths = (missing, there, tmp_path)
    calls = [["bridge", "--no-ros", "--listen", "0", "--record", str(path)] for path in paths]
    for path, result in zip(paths, outcomes(calls), strict=True):
        assert (result.code, result.out) == (1, "")
        (line,) = result.err.splitlines()
        assert str(path) in line
    assert there.read_bytes() == b"something else"
    assert list(tmp_path.iterdir()) == [there]


def test_usage(tmp_path: Path) -> None:
    """A bad configuration, other hosts without an allow-list, what to record without a file."""
    texts = {
        "[gateway]\nros_unit = 'yard'\n": ("gateway.ros_unit", "'yard'"),
        "[[to_ros]]\ntopics = '/x'\n": ("to_ros[0].topics",),
        "[gateway\n": ("TOML",),
    }
    calls: list[list[str]] = []
    wanted: list[tuple[str, ...]] = []
    for number, (text, parts) in enumerate(texts.items()):
        path = tmp_path / f"bad{number}.toml"
        path.write_text(text)
        calls.append(["--config", str(path)])
        wanted.append((str(path), *parts))
    calls += [["--listen", "0.0.0.0:0"], ["--record-all"]]
    wanted += [("0.0.0.0:0", "allow"), ("no --record FILE",)]
    results = outcomes([["bridge", "--no-ros", *words] for words in calls])
    for parts, result in zip(wanted, results, strict=True):
        line = refused(result)
        assert all(part in line for part in parts), line


def test_without_ros_installed(programs: list[Program], tmp_path: Path) -> None:
    hiding = hidden_ros(tmp_path)
    path = tmp_path / "out.mcap"
    line = refused(run(programs, "bridge", "--listen", "0", "--record", str(path), PYTHONPATH=hiding), 1)
    assert "rclpy cannot be imported" in line and 'pip install "igtl-gateway[ros]"' in line
    assert not path.exists()
    bridge = Bridge("--no-ros", "--record", str(path), PYTHONPATH=hiding)
    programs.append(bridge)
    with RawPeer(bridge.port) as peer:
        peer.send(string("kept without ROS"))
        bridge.wait_code("stream")
        result = bridge.end()
    assert (result.code, result.err) == (0, "")
    kinds = {topic for topic, _, _ in recorded(path)}
    assert "/igtl/in/Raw/string" in kinds


@needs_ros
@pytest.mark.parametrize("everything", [False, True])
def test_other_topics_are_recorded(programs: list[Program], tmp_path: Path, everything: bool) -> None:
    """In a domain of its own: with ``--record-all``, topics of other programs must not be recorded."""
    path = tmp_path / "out.mcap"
    topics = {"/arm/joint_states": JOINTS, "/arm/health/all": HEALTH, "/chatter": TEXT}
    wanted = set(topics) if everything else {"/arm/joint_states"}
    options = ["--record-all"] if everything else ["--record-topics", "/arm/*", "/nowhere"]
    with RosClient("arm", advertise=topics, domain=SECOND_DOMAIN) as arm:
        bridge = Bridge("--record", str(path), *options, ROS_DOMAIN_ID=str(SECOND_DOMAIN))
        programs.append(bridge)
        arm.wait_readers(*sorted(wanted))
        head = {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "arm"}
        arm.publish("/arm/joint_states", {"header": head, "name": ["a1", "a2"], "position": [0.5, -0.25]})
        arm.publish("/arm/health/all", {"header": head, "status": [{"name": "drive", "message": "fine"}]})
        arm.publish("/chatter", {"data": "aside"})
        wait_flushed(path, lambda found: wanted <= {topic for topic, _ in found})
        result = bridge.end()
    assert (result.code, result.err) == (0, "")
    found = {topic: (name, message) for topic, name, message in recorded(path) if topic in topics}
    assert found.keys() == wanted
    name, joints = found["/arm/joint_states"]
    assert name == JOINTS
    assert (joints.name, list(joints.position), joints.header.stamp.sec) == (["a1", "a2"], [0.5, -0.25], 7)
    if everything:
        assert found["/arm/health/all"][1].status[0].message == "fine"
        assert found["/chatter"][1].data == "aside"


def test_kill_9_of_bridge_and_recorder_leaves_what_was_flushed(programs: list[Program], tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path))
    programs.append(bridge)

    def is_there(found: list[tuple[str, bytes]]) -> bool:
        return any(topic == "/igtl/in/Raw/string" and b"before the power went" in data for topic, data in found)

    with RawPeer(bridge.port) as peer:
        peer.send(string("before the power went"))
        wait_flushed(path, is_there)
        processes.kill(*children(bridge.process.pid))
        result = bridge.end(signal.SIGKILL)
    assert result.code == -signal.SIGKILL
    assert is_there(cut_off(path))
    told = run(programs, "info", str(path))
    assert told.code in (1, 2)
    (line,) = told.err.splitlines()
    assert str(path) in line and "recover" in line


def test_split_pause_and_leave_out(programs: list[Program], tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    options = ["--split-duration", "0.2", "--record-exclude", "Secret"]
    bridge = Bridge("--no-ros", "--record", str(path), *options)
    programs.append(bridge)
    with RawPeer(bridge.port) as peer:
        peer.send(string("first"))
        bridge.wait_code("stream")
        time.sleep(0.3)  # of the session's own time: the next entry begins the next part
        bridge.process.send_signal(signal.SIGUSR2)
        bridge.wait_code("record_paused")
        peer.send(string("not this"))
        bridge.process.send_signal(signal.SIGUSR2)
        bridge.wait_code("record_resumed")
        peer.send(string("last"))
        result = bridge.end()
    assert (result.code, result.err) == (0, "")
    parts = sorted(path.with_suffix("").glob("*.mcap"))
    assert len(parts) >= 2
    for file in (path.with_suffix(""), *parts):
        told = run(programs, "verify", str(file))
        assert told.code == 0, told.out


def test_a_snapshot_by_signal(programs: list[Program], tmp_path: Path) -> None:
    bridge = Bridge("--no-ros", "--record", str(tmp_path / "out.mcap"), "--snapshot", "60")
    programs.append(bridge)
    with RawPeer(bridge.port) as peer:
        peer.send(string("what just happened"))
        bridge.wait_code("stream")
        bridge.process.send_signal(signal.SIGUSR1)
        bridge.wait_code("record_snapshot")
        result = bridge.end()
    assert (result.code, result.err) == (0, "")
    (file,) = tmp_path.iterdir()
    assert any(topic == "/igtl/in/Raw/string" for topic, _, _ in recorded(file))
    assert run(programs, "verify", str(file)).code == 0


@needs_ros
def test_the_services_of_a_recording(programs: list[Program], tmp_path: Path) -> None:
    path, domain = tmp_path / "out.mcap", str(SECOND_DOMAIN)
    with RosClient("operator", domain=SECOND_DOMAIN) as node:

        def call(name: str) -> str:
            node.call(f"/igtl_gateway/{name}", "std_srvs/srv/Trigger", {})
            answer = node.receive(f"/igtl_gateway/{name}")
            assert answer["success"], answer
            return str(answer["message"])

        bridge = Bridge("--record", str(path), "--snapshot", "60", ROS_DOMAIN_ID=domain)
        programs.append(bridge)
        assert Path(call("snapshot")).is_file()
        assert bridge.end().code == 0
        bridge = Bridge("--record", str(path), ROS_DOMAIN_ID=domain)
        programs.append(bridge)
        assert call("pause_recording") == "the recording is paused"
        assert call("resume_recording") == "the recording goes on"
        bridge.wait_code("record_resumed")
        assert bridge.end().code == 0
    notes = [message.code for topic, _, message in recorded(path) if topic == "/igtl_gateway/notes"]
    assert [code for code in notes if code.startswith("record_")] == ["record_paused", "record_resumed"]


@needs_ros
def test_the_threads_that_pass_messages_get_their_cpu(programs: list[Program], tmp_path: Path) -> None:
    """Those of Fast DDS, of TCP and of ROS; not the others, and not the recorder's process."""
    usable = os.sched_getaffinity(0)
    cpu = max(usable)
    bridge = Bridge("--cpu-affinity", str(cpu), "--record", str(tmp_path / "out.mcap"))
    programs.append(bridge)
    (line,) = [line for line in bridge.events[0]["environment"] if line.startswith("real-time: ")]
    found = re.fullmatch(rf"real-time: CPUs {cpu} for (\d+) threads \((.*)\)", line)
    assert found, line
    names = found[2].split(", ")
    assert len(names) == int(found[1]) and {"igtl-tcp", "igtl-ros-receiver"} < set(names)
    assert any(name.startswith("dds.udp.") for name in names) and "dds.shm.wdog" not in names
    process = bridge.process.pid
    tasks = [int(task.name) for task in Path(f"/proc/{process}/task").iterdir()]
    pinned = [task for task in tasks if os.sched_getaffinity(task) == {cpu}]
    if len(usable) > 1:
        assert process not in pinned and len(pinned) < len(tasks)
        assert [os.sched_getaffinity(child) for child in children(process)] == [usable]
    assert len(pinned) >= len(names)
