"""A recording bridge that dies: killed under load at any moment, or on a full disk.  What was said before is there.

Killed alone, the bridge loses nothing: its recorder lives on and closes the file.  Killed together with its recorder,
as by a loss of power, it loses what was not flushed.  ``CRASH_KILLS=50`` kills that many times instead of two;
``--log-cli-level=INFO`` tells what each of them cost.
"""

from __future__ import annotations

import logging
import os
import random
import resource
import select
import signal
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from igtl_gateway.record.options import FLUSH_S
from igtl_gateway.replay.mcap_reader import SessionFile
from igtl_gateway.session.entry import Entry, Kind
from tests.integration.bridge import Bridge, RawPeer, children, gateway, message, string

_log = logging.getLogger(__name__)

KILLS = int(os.environ.get("CRASH_KILLS", "2"))
#: What the recorder may take on top of its interval on a busy machine, until the bytes are with the system.
SLACK_S = float(os.environ.get("CRASH_SLACK_S", "2.0"))
BATCH = 50
IMAGE_SIDE = 64
DISK_BYTES = 256 << 10


def image(number: int) -> bytes:
    """A grey picture that does not compress."""
    content = random.Random(number).randbytes(IMAGE_SIDE**2)
    axes = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)
    size = struct.pack(">6H", IMAGE_SIDE, IMAGE_SIDE, 1, 0, 0, 0)
    body = struct.pack(">HBBBB", 1, 1, 3, 2, 1) + struct.pack(">3H", IMAGE_SIDE, IMAGE_SIDE, 1) + axes
    return message("IMAGE", body + size[6:] + size[:6] + content, device="Noise")


class Load:
    """A peer that talks without a pause: numbered strings and pictures, each batch with a question.

    Attributes:
        answered: (time, number): when it knew that all up to that number had been handled.
        sent: the last number that was sent.
    """

    def __init__(self, port: int) -> None:
        self.answered: list[tuple[float, int]] = []
        self.sent = 0
        self._peer = RawPeer(port)
        self._stop = threading.Event()
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                batch = [string(str(number), "Count") for number in range(self.sent + 1, self.sent + BATCH + 1)]
                self._peer.send(b"".join([*batch, image(self.sent), message("GET_CAPABIL", b"")]))
                self.sent += BATCH
                self._peer.receive(type_name="CAPABILITY")
                with self._changed:
                    self.answered.append((time.monotonic(), self.sent))
                    self._changed.notify_all()
        except OSError:
            pass  # it was killed

    def wait_answers(self, count: int) -> None:
        """Wait until so many batches more than now are answered."""
        with self._changed:
            wanted = len(self.answered) + count
            assert self._changed.wait_for(lambda: len(self.answered) >= wanted, 30)

    def answered_before(self, moment: float) -> int:
        return max((number for when, number in self.answered if when <= moment), default=0)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._peer.close()


def recover(path: Path, out: Path) -> list[Entry]:
    """Entries of what ``recover`` makes of the file."""
    ended = gateway("recover", str(path), "-o", str(out))
    try:
        result = ended.end(None)
    finally:
        ended.close()
    assert result.code == 1, result
    assert "LOST the end" in result.out
    with SessionFile.open(out) as file:
        assert file.session["config"]
        assert file.ledger is not None
        assert [loss["what"] for loss in file.ledger["recovered"]["lost"]] == ["cut_off"]
        return list(file.entries())


def wait_gone(process: int) -> None:
    """Wait for the end of a process that is not ours."""
    try:
        handle = os.pidfd_open(process)
    except ProcessLookupError:
        return
    try:
        assert select.select([handle], [], [], 30)[0]
    finally:
        os.close(handle)


def counted(entries: list[Entry]) -> int:
    """The last number that came in; all before it have to be there, and so has what was made of them."""
    numbers = [int(entry.data()[62:]) for entry in entries if entry.channel == "STRING/Count"]
    assert numbers == list(range(1, len(numbers) + 1))
    made = sum(entry.kind is Kind.ROS_OUT and entry.channel == "/igtl/in/Count/string" for entry in entries)
    assert len(numbers) - 1 <= made <= len(numbers)
    assert [entry.seq for entry in entries] == list(range(entries[0].seq, entries[-1].seq + 1))
    return len(numbers)


@pytest.mark.slow
@pytest.mark.parametrize("kill", range((KILLS + 1) // 2))
def test_after_kill_9_of_the_bridge_everything_is_there_and_the_file_is_closed(tmp_path: Path, kill: int) -> None:
    path = tmp_path / "out.mcap"
    moment = random.Random(-kill - 1).uniform(0, 2 * FLUSH_S)
    bridge = Bridge("--no-ros", "--record", str(path), "--compression", ("lz4", "none", "zstd")[kill % 3])
    load = Load(bridge.port)
    try:
        load.wait_answers(5)
        time.sleep(moment)  # not to wait for anything: to kill at any moment of an interval
        (recorder,) = children(bridge.process.pid)
        killed = time.monotonic()
        bridge.process.send_signal(signal.SIGKILL)
        assert bridge.process.wait(10) == -signal.SIGKILL
        wait_gone(recorder)
    finally:
        load.close()
        bridge.close()
    verified = gateway("verify", str(path))
    try:
        result = verified.end(None)
    finally:
        verified.close()
    assert result.code == 0, result
    with SessionFile.open(path) as file:
        assert file.ledger is not None and file.ledger["cut_off"] is True
        number = counted(list(file.entries()))
    assert number >= load.answered_before(killed) > 0
    assert number <= load.sent


@pytest.mark.slow
@pytest.mark.parametrize("kill", range(KILLS // 2))
def test_after_kill_9_of_both_everything_older_than_the_flush_interval_is_there(tmp_path: Path, kill: int) -> None:
    path = tmp_path / "out.mcap"
    moment = random.Random(kill).uniform(0, 2 * FLUSH_S)
    bridge = Bridge("--no-ros", "--record", str(path), "--compression", ("lz4", "none", "zstd")[kill % 3])
    load = Load(bridge.port)
    try:
        load.wait_answers(5)
        time.sleep(FLUSH_S + SLACK_S + 0.5 + moment)  # not to wait for anything: to kill at any moment of an interval
        (recorder,) = children(bridge.process.pid)
        killed = time.monotonic()
        os.kill(recorder, signal.SIGKILL)
        bridge.process.send_signal(signal.SIGKILL)
        assert bridge.process.wait(10) == -signal.SIGKILL
    finally:
        load.close()
        bridge.close()
    number = counted(recover(path, tmp_path / "whole.mcap"))
    lost_since = next((when for when, answered in load.answered if answered > number), killed)
    _log.info("kill %s: %s of %s there, lost: the last %.3f s", kill, number, load.sent, killed - lost_since)
    assert number >= load.answered_before(killed - FLUSH_S - SLACK_S) > 0
    assert number <= load.sent


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_to_all_processes_at_once_ends_it_in_order(tmp_path: Path, number: int) -> None:
    """As when a service is stopped: the recorder has its signal before the bridge has written the last of it."""
    path = tmp_path / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path))
    load = Load(bridge.port)
    try:
        load.wait_answers(3)
        (recorder,) = children(bridge.process.pid)
        os.kill(recorder, number)
        assert bridge.end(number).code == 0
    finally:
        load.close()
        bridge.close()
    wait_gone(recorder)
    with SessionFile.open(path) as file:
        assert file.ledger is not None and "cut_off" not in file.ledger
        assert counted(list(file.entries())) >= load.answered[-1][1]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own, soon full; skipped where none can be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("nothing can be mounted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_on_a_full_file_system_the_bridge_goes_on_and_what_was_flushed_is_there(
    tmp_path: Path, small_disk: Path
) -> None:
    path = small_disk / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path), "--flush-interval", "0.1")
    _fill(bridge, path, tmp_path / "whole.mcap", "No space left on device")


def test_at_a_limit_of_file_size_the_bridge_goes_on_and_what_was_flushed_is_there(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path), "--flush-interval", "0.1")
    (recorder,) = children(bridge.process.pid)
    resource.prlimit(recorder, resource.RLIMIT_FSIZE, (DISK_BYTES, DISK_BYTES))
    _fill(bridge, path, tmp_path / "whole.mcap", "File too large")


def _fill(bridge: Bridge, path: Path, whole: Path, reason: str) -> None:
    load = Load(bridge.port)
    try:
        told = bridge.wait_code("record_failed")
        failed = time.monotonic()
        assert reason in told["text"]
        load.wait_answers(3)  # it goes on
        assert bridge.process.poll() is None
        load.close()
        assert bridge.end().code == 1
    finally:
        load.close()
        bridge.close()
    number = counted(recover(path, whole))
    assert number >= load.answered_before(failed - 0.1 - SLACK_S)
    assert 0 < number < load.sent


def test_the_load_is_one(tmp_path: Path) -> None:
    """Without a crash every message of it is there: what the tests above count is what they mean."""
    path = tmp_path / "out.mcap"
    bridge = Bridge("--no-ros", "--record", str(path))
    load = Load(bridge.port)
    try:
        load.wait_answers(5)
        load.close()
        assert bridge.end().code == 0
    finally:
        load.close()
        bridge.close()
    with SessionFile.open(path) as file:
        entries = list(file.entries())
    assert counted(entries) == load.sent
    assert sum(entry.channel == "IMAGE/Noise" for entry in entries) == load.sent // BATCH
    assert sum(entry.channel == "/igtl/in/Noise/image" for entry in entries) == load.sent // BATCH
