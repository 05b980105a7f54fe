"""The native passage without memory: what is lost is counted, and a peer is never left with half of a message."""

from __future__ import annotations

import ctypes
import json
import os
import shlex
import subprocess
import sys
import sysconfig
from mmap import mmap
from pathlib import Path

import pytest

from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.native.passage import Lock, Passage, is_compiled
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.shared_queue import QueueWriter, memory
from tests.places import ROOT

HERE = Path(__file__).parent / "memory"

pytestmark = pytest.mark.skipif(not is_compiled(), reason="without the native passage")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The allocator that refuses; skips where none can be preloaded."""
    target = tmp_path_factory.mktemp("memory") / "no_memory.so"
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    words = [compiler, "-shared", "-fPIC", "-O1", "-o", str(target), str(HERE / "no_memory.c"), "-ldl"]
    try:
        subprocess.run(words, check=True, capture_output=True)
        ctypes.CDLL(str(target))
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no C compiler, or another C library")
    return target


@pytest.mark.slow
def test_a_message_of_which_no_rest_can_be_kept_ends_its_link(library: Path, tmp_path: Path) -> None:
    """The kernel has taken its beginning: what follows would be read as its rest."""
    recording = tmp_path / "session.mcap"
    words = [sys.executable, "-m", "tests.native.memory.starved", str(library), str(recording)]
    environment = {**os.environ, "LD_PRELOAD": str(library)}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    native, refused, has_ended, sent, received, gaps = json.loads(done.stdout)
    assert native == 1 and refused > 0
    assert has_ended and received < sent and gaps == []
    with SessionFile.open(recording) as file:
        notes = [Note.of(entry.data()) for entry in file.entries() if entry.kind is Kind.LINK]
    assert "there was no memory for the rest of a message" in str([note.data for note in notes])


def test_a_passage_is_recorded_once() -> None:
    """The memory and the lock of the first queue were never freed, and both queues were written."""
    passage, lock = Passage(), Lock()
    places: list[mmap] = [memory(1 << 20, 1 << 20) for _ in range(2)]
    queues = [QueueWriter(place, 1000, 1 << 20) for place in places]
    passage.record_into(queues[0].memory, lock)
    before = sys.getrefcount(lock)
    with pytest.raises(ValueError, match=r"record_into: found a passage that is recorded"):
        passage.record_into(queues[1].memory, Lock())
    with pytest.raises(BufferError):
        Passage().record_into(b"read-only", lock)
    assert sys.getrefcount(lock) == before
