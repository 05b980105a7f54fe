"""Faults of a recording: the disk is full or read-only, the file is deleted, the clock is set.

With real bridges and real disks; the test has a clock of its own and does not change that of the host.  In each case
the traffic continues (or the bridge ends, if an option requests that), the bridge reports immediately what happened
and where, it counts the messages that are not in the recording, and all that it flushed before is in the file.
"""

from __future__ import annotations

import itertools
import json
import os
import resource
import shutil
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app import bridge as app
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config, ToRosRow
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.timeline import clock_steps_of
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.transform import Transform
from tests.integration.bridge import TIMEOUT_S, Bridge, RawPeer, Result, Wire, children, gateway, message, string
from tests.integration.load import Load, counted
from tests.record.test_parts import wait_until

#: Soon full.
DISK_BYTES = 2 << 20

#: Sent, and flushed, before the disk is filled.
_EARLY = "before the disk was full"
_FILLED = ("--flush-interval", "0.1", "--compression", "none", "--metrics", "0")

FULL, READ_ONLY = "No space left on device", "Read-only file system"


def ended(*arguments: str) -> Result:
    """A verb of the command line, in this process."""
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        code = main(arguments)
    return Result(code, out.getvalue(), err.getvalue())


def status(bridge: Bridge) -> dict[str, Any]:
    """What ``--metrics`` shows of the recorder."""
    url = bridge.events[0]["metrics"].replace("/metrics", "/status")
    with urllib.request.urlopen(url) as answer:
        told: dict[str, Any] = json.load(answer)
    recorder: dict[str, Any] = told["recorder"]
    return recorder


def mounted(folder: Path, size: int) -> None:
    """A file system of that size there; skips where none can be mounted."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("nothing can be mounted here")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A small file system of its own."""
    folder = tmp_path / "disk"
    mounted(folder, DISK_BYTES)
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


#: What the note of a failure has behind the reason.
GOES_ON = "the bridge goes on without recording; the disk is tried again, in a new file"

# ── from the start ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_read_only_folder_leaves_the_bridge_to_its_work(disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    path = disk / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path), "--metrics", "0")
    try:
        told = bridge.wait_code("record_failed")
        failure = f"cannot record to {path}: {READ_ONLY}, in the folder {disk}"
        assert told["text"] == f"{failure}; {GOES_ON}"
        with RawPeer(bridge.port) as peer:
            peer.send(string("all the same"))
            bridge.wait_code("stream")
            recorder = status(bridge)
        result = bridge.end()
    finally:
        bridge.close()
    assert recorder["failure"] == failure
    recording = bridge.events[-1]["recording"]
    # up, down, the message and what it became, and the notes of these
    assert recording["entries"] == 0 and recording["files"] == [] and recording["dropped"] >= 4
    assert bridge.events[-1]["ledger"]["gaps"] == []
    assert (result.code, result.err) == (1, "")
    assert not path.exists()


@pytest.mark.parametrize(("options", "place"), [([], "out.mcap"), (["--split-size", "1"], "out/out_0.mcap")])
def test_a_disk_that_is_full_from_the_start_is_a_reason_not_to_start(
    disk: Path, options: list[str], place: str
) -> None:
    with pytest.raises(OSError, match=FULL), (disk / "full").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    options = ["--no-ros", "--listen", "127.0.0.1:0", "--record", str(disk / "out.mcap"), *options]
    program = gateway("bridge", *options, "--on-record-failure", "stop")
    try:
        result = program.end(None)
    finally:
        program.close()
    assert result.err == f"igtl-gateway bridge: cannot record to {disk / place}: {FULL}\n"
    assert (result.code, result.out) == (1, "")
    assert [each.name for each in disk.iterdir() if each.name != "full"] == []


# ── the disk becomes full ──────────────────────────────────────────────────────────────────────────────────────────


def _fill(bridge: Bridge, path: Path, reason: str, *, stops: bool = False, goes_on: bool = False) -> None:
    """Talk to a recording bridge until its disk refuses, then look at what is there.

    Its chunks are not compressed: what was flushed can be seen in the file.
    """
    with RawPeer(bridge.port) as peer:
        peer.send(string(_EARLY))
        wait_until(lambda: _EARLY.encode() in path.read_bytes())
    load = Load(bridge.port)
    try:
        told = bridge.wait_code("record_failed")
        then = "the bridge stops" if stops else GOES_ON
        assert told["text"] == f"recording to {path} failed: {reason}; {then}"
        if not stops:
            load.wait_answers(3)
            recorder = status(bridge)
            if goes_on:
                assert bridge.wait_code("record_again")["text"].endswith("out_1.mcap")
            else:
                assert recorder["failure"] == f"recording to {path} failed: {reason}"
            assert recorder["dropped_entries"] > 0
            load.close()
        assert bridge.end(None if stops else 2).code == 1
    finally:
        load.close()
        bridge.close()
    recording, ledger = (bridge.events[-1][key] for key in ("recording", "ledger"))
    assert recording["dropped"] > 0 and reason in recording["failure"]
    assert ledger["gaps"] == []
    verified = ended("verify", str(path))
    assert verified.code == 0, "the chunk that did not fit made room for the end of the file"
    assert reason in ended("info", str(path)).out
    if stops:
        return
    with SessionFile.open(path) as file:
        entries = list(file.entries())
    assert any(_EARLY.encode() in entry.data() for entry in entries)
    assert counted(entries) < load.sent
    # of what was not flushed, which counts as dropped, some may be there; and an input may lack its last outputs
    assert recording["entries"] <= len(entries) + recording["dropped"]


@pytest.mark.parametrize("policy", ["continue", "stop"])
def test_a_disk_that_becomes_full(disk: Path, policy: str) -> None:
    path = disk / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path), "--on-record-failure", policy, *_FILLED)
    _fill(bridge, path, FULL, stops=policy == "stop")


def test_a_limit_of_the_size_of_files(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path), *_FILLED)
    (recorder,) = children(bridge.process.pid)
    resource.prlimit(recorder, resource.RLIMIT_FSIZE, (DISK_BYTES, DISK_BYTES))
    _fill(bridge, path, "File too large", goes_on=True)


# ── the recording is taken away ────────────────────────────────────────────────────────────────────────────────────


def _unlink(path: Path) -> None:
    path.unlink()


def _remove_folder(path: Path) -> None:
    shutil.rmtree(path.parent)


@pytest.mark.parametrize(
    ("take_away", "policy", "then"),
    [(_unlink, "stop", "; the bridge stops"), (_remove_folder, "continue", "; cannot record to ")],
)
def test_a_recording_that_is_removed_is_told_at_once(
    tmp_path: Path, policy: str, then: str, take_away: Callable[[Path], None]
) -> None:
    path = tmp_path / "folder" / "out.mcap"
    path.parent.mkdir()
    options = ["--record", str(path), "--flush-interval", "0.1", "--on-record-failure", policy]
    bridge = Bridge("--no-ros", *options)
    try:
        with RawPeer(bridge.port) as peer:
            peer.send(string("recorded"))
            bridge.wait_code("stream")
            take_away(path)
            told = bridge.wait_code("record_failed")
            assert told["text"].startswith(f"recording to {path} failed: the file was removed{then}")
            if policy == "continue":
                peer.send(string("still there", "Other"))
                bridge.wait_code("stream", stream="STRING/Other")
            result = bridge.end(None if policy == "stop" else 2)
    finally:
        bridge.close()
    assert (result.code, result.err) == (1, "")
    recording = bridge.events[-1]["recording"]
    assert recording["failure"].startswith(f"recording to {path} failed: the file was removed")
    assert recording["bytes"] == 0
    assert not path.exists()


def _replace(path: Path) -> None:
    path.unlink()
    path.write_bytes(b"")


@pytest.mark.parametrize(
    ("take_away", "words"),
    [(lambda path: os.truncate(path, 0), "the file was truncated"), (_replace, "another file took its place")],
    ids=["truncated", "replaced"],
)
@pytest.mark.parametrize("options", [[], ["--split-size", "100"]], ids=["one file", "parts"])
def test_a_recording_that_is_truncated_goes_on_in_the_next_file(
    tmp_path: Path, options: list[str], take_away: Callable[[Path], None], words: str
) -> None:
    path = tmp_path / "out.mcap"
    folder = path.with_suffix("") if options else tmp_path
    first, second = folder / ("out_0.mcap" if options else "out.mcap"), folder / "out_1.mcap"
    bridge = Bridge("--no-ros", "--record", str(path), "--flush-interval", "0.1", "--metrics", "0", *options)
    try:
        with RawPeer(bridge.port) as peer:
            peer.send(string("recorded"))
            bridge.wait_code("stream")
            take_away(first)
            told = bridge.wait_code("record_continued")["text"]
            peer.send(string("recorded, too", "Other"))
            bridge.wait_code("stream", stream="STRING/Other")
            recorder = status(bridge)
            result = bridge.end()
    finally:
        bridge.close()
    text = f"recording to {first} failed: {words}; the recording goes on in {second}"
    assert told.startswith(text)
    assert (recorder["failure"], recorder["taken_away"]) == ("", text)
    assert result.code == 1
    recording, ledger = (bridge.events[-1][key] for key in ("recording", "ledger"))
    assert recording["failure"] == text and str(second) in recording["files"]
    assert recording["dropped"] > 0 and ledger["gaps"] == []
    with SessionFile.open(second) as file:
        assert any(b"recorded, too" in entry.data() for entry in file.entries())
        assert file.ledger is not None and file.ledger["recorder"]["written_entries"] == recording["entries"]
    assert ended("verify", str(second)).code == 0


@pytest.fixture
def unchangeable(tmp_path: Path) -> Iterator[Callable[[Path], None]]:
    """What makes a folder one in which nothing can be created, also by root, until the end of the test."""
    folders: list[Path] = []

    def freeze(folder: Path) -> None:
        if os.geteuid():
            folder.chmod(0o555)
        elif subprocess.run(["chattr", "+i", str(folder)], capture_output=True, check=False).returncode:
            pytest.skip("root can write everywhere here: no chattr +i")
        folders.append(folder)

    yield freeze
    for folder in folders:
        if os.geteuid():
            folder.chmod(0o755)
        else:
            subprocess.run(["chattr", "-i", str(folder)], check=True)


def test_a_folder_that_becomes_read_only_ends_a_split_recording_at_the_next_part(
    tmp_path: Path, unchangeable: Callable[[Path], None]
) -> None:
    path = tmp_path / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path), "--split-duration", "0.1")
    try:
        with RawPeer(bridge.port) as peer:
            peer.send(string("first"))
            bridge.wait_code("stream")
            unchangeable(path.with_suffix(""))
            number = 0
            while not any(event.get("code") == "record_failed" for event in bridge.events):
                number += 1
                peer.send(string(str(number), f"Device{number}"))
                bridge.wait_code("stream", stream=f"STRING/Device{number}")
            told = bridge.wait_code("record_failed")
            peer.send(string("still there", "Other"))
            bridge.wait_code("stream", stream="STRING/Other")
            result = bridge.end()
    finally:
        bridge.close()
    assert str(path.with_suffix("")) in told["text"] and "the bridge goes on" in told["text"]
    assert result.code == 1
    part, *_ = sorted(path.with_suffix("").glob("*.mcap"))  # a busy machine may have begun a second one in time
    verified = ended("verify", str(part))
    assert verified.code == 0, verified
    recording = bridge.events[-1]["recording"]
    assert recording["entries"] > 0 and recording["dropped"] > 0


def test_a_folder_of_parts_that_is_removed_is_told_at_once(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path), "--split-size", "1", "--flush-interval", "0.1")
    load = Load(bridge.port)
    try:
        load.wait_answers(1)
        shutil.rmtree(path.with_suffix(""))
        told = bridge.wait_code("record_continued")
        assert str(path.with_suffix("")) in told["text"] and "was removed" in told["text"]
        load.wait_answers(1)
        assert list(path.with_suffix("").iterdir()), "the folder is made again"
        load.close()
        assert bridge.end().code == 1
    finally:
        load.close()
        bridge.close()
    assert bridge.events[-1]["ledger"]["gaps"] == []


# ── the host's clock is set ────────────────────────────────────────────────────────────────────────────────────────


class SetClock(SystemClock):
    """The host's clock, which the test sets."""

    set_ns = 0

    def utc_ns(self) -> int:
        return super().utc_ns() + self.set_ns


HOUR_NS = 3600 * NS_PER_S
#: Of the peer's messages, before and behind the step.
EVERY_S, EACH = 0.01, 20
POSE = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 100.0, 200.0, 300.0))


def talk_while_the_clock_is_set(path: Path, set_ns: int) -> app.Bridge:
    """Record a peer that asks something a hundred times a second, the clock being set in between."""
    clock, seen, changed, heard = SetClock(), list[Entry](), threading.Condition(), list[Wire]()

    def see(entry: Entry) -> None:
        with changed:
            seen.append(entry)
            changed.notify_all()

    def wait_for(condition: Callable[[], bool]) -> None:
        with changed:
            assert changed.wait_for(condition, TIMEOUT_S)

    config = Config(to_ros=(ToRosRow(max_age_s=5.0),), command_timeout_s=0.3).watched()
    options = BridgeOptions((("127.0.0.1", 0),), ros=False, record=path)
    bridge = app.Bridge(config, options, clock, see)
    bridge.start()
    try:
        with RawPeer(bridge.addresses[0][1]) as peer:

            def talk() -> None:
                for _ in range(EACH):
                    time.sleep(EVERY_S)  # the pace of the recording
                    pose = join(encode(Message("TRANSFORM", "Tool", POSE, ns_to_ticks(clock.utc_ns()))))
                    peer.send(pose + message("GET_CAPABIL", b""))

            def hear(type_name: str, count: int) -> None:
                while sum(each.type == type_name for each in heard) < count:
                    heard.append(peer.receive())

            talk()
            hear("CAPABILITY", EACH)
            peer.send(join(encode(Message("COMMAND", "Robot", Command.of(7, "move", "<up/>")))))  # no answer
            clock.set_ns = set_ns
            talk()
            wait_for(lambda: any(ClockStep.of(entry) for entry in list(seen)))
            hear("CAPABILITY", 2 * EACH)
            hear("RTS_COMMAND", 1)  # given up in time, not after an hour
    finally:
        bridge.stop()
    return bridge


@pytest.mark.parametrize("set_ns", [-HOUR_NS, HOUR_NS], ids=["back", "forward"])
def test_a_clock_that_is_set_by_an_hour_while_a_recording_is_made(tmp_path: Path, set_ns: int) -> None:
    path = tmp_path / "out.mcap"
    bridge = talk_while_the_clock_is_set(path, set_ns)
    assert bridge.summary is not None and not bridge.summary.failure and not bridge.summary.dropped
    assert bridge.losses["gaps"] == []
    with SessionFile.open(path) as file:
        entries = list(file.entries())
        (step,) = clock_steps_of(file)
    assert step.step_ns == pytest.approx(set_ns, abs=NS_PER_S // 10)
    # in order, and as long as it took
    stamps = [entry.stamp_ns for entry in entries]
    assert all(before < after for before, after in itertools.pairwise(stamps))
    lasted_ns = stamps[-1] - stamps[0]
    assert 2 * EACH * EVERY_S * NS_PER_S < lasted_ns - step.jump_ns < 2 * TIMEOUT_S * NS_PER_S
    asked = [entry.stamp_ns for entry in entries if entry.channel == "GET_CAPABIL/Raw"]
    assert len(asked) == 2 * EACH
    behind_ns = asked[-1] - asked[EACH]
    assert behind_ns > EACH * EVERY_S * NS_PER_S / 2, "time goes on behind the step"
    # nothing was taken for old
    assert not {"stale", "stamp_future"} & {Note.unpack(each.data()).code for each in entries if each.kind is Kind.NOTE}

    verified = ended("verify", str(path))
    assert verified.code == 0, verified
    told = json.loads(ended("info", str(path), "--json").out)
    assert [round(each["step_s"]) for each in told["clock_steps"]] == [set_ns // NS_PER_S]
    assert told["problems"]["clock_step"] == 1
    (stream,) = [each for each in told["streams"] if each["stream"] == "GET_CAPABIL/Raw"]
    assert not stream["gap"] and stream["rate_hz"] > 1
    (peer,) = told["clocks"]
    assert abs(peer["offset_plus_least_latency_ms"]) < 1000, "it is the clock of this machine"
    text = ended("info", str(path)).out
    assert f"the host's clock was set {'back' if set_ns < 0 else 'forward'}" in text
    lint = json.loads(ended("lint", str(path), "--json").out)
    assert {"IGTL-W801"} <= {each["id"] for each in lint["findings"]} & {
        "IGTL-W801",
        "IGTL-W303",
        "IGTL-W306",
        "IGTL-W507",
    }


def test_a_replay_does_not_wait_for_the_hour_by_which_a_clock_was_set(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    talk_while_the_clock_is_set(path, HOUR_NS)
    replay = gateway("replay", str(path), "--to", "igtl", "--side", "gateway", "--listen", "127.0.0.1:0")
    try:
        replay.wait_until(lambda: any("server on" in line for line in replay.lines), "server")
        port = next(int(line.rpartition(":")[2]) for line in replay.lines if "server on" in line)
        with RawPeer(port) as peer:
            said = [peer.receive(type_name="CAPABILITY") for _ in range(2 * EACH)]
            result = replay.end(None)
    finally:
        replay.close()
    assert len(said) == 2 * EACH
    assert result.code == 0, result
