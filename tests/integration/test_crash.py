"""A recording bridge is killed under load at any moment.  The messages from before are in the file.

Killed alone, the bridge loses nothing: its recorder lives on and closes the file.  Killed together with its recorder,
as by a loss of power, it loses what was not flushed.  ``CRASH_KILLS=50`` kills that many times instead of two;
``--log-cli-level=INFO`` shows the loss of each.
"""

from __future__ import annotations

import logging
import os
import random
import select
import signal
import time
from pathlib import Path

import pytest

from igtl_gateway.record.options import FLUSH_S
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests import processes
from tests.integration.bridge import Bridge, children, gateway
from tests.integration.load import BATCH, SLACK_S, Load, counted, recover

_log = logging.getLogger(__name__)

KILLS = int(os.environ.get("CRASH_KILLS", "2"))


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
    load = Load(bridge.port, pause_s=0.01)
    try:
        load.wait_answers(5)
        time.sleep(FLUSH_S + SLACK_S + 0.5 + moment)  # not to wait for anything: to kill at any moment of an interval
        (recorder,) = children(bridge.process.pid)
        killed = time.monotonic()
        processes.kill(recorder, bridge.process.pid)
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
