"""A peer that talks without a pause, and what of it has to be in the recording."""

from __future__ import annotations

import os
import random
import struct
import threading
import time
from pathlib import Path

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.integration.bridge import RawPeer, gateway, message, string

#: What the recorder may take on top of its interval on a busy machine, until the bytes are with the system.
SLACK_S = float(os.environ.get("CRASH_SLACK_S", "2.0"))
BATCH = 50
IMAGE_SIDE = 64


def image(number: int) -> bytes:
    """A grey picture that does not compress."""
    content = random.Random(number).randbytes(IMAGE_SIDE**2)
    axes = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)
    size = struct.pack(">6H", IMAGE_SIDE, IMAGE_SIDE, 1, 0, 0, 0)
    body = struct.pack(">HBBBB", 1, 1, 3, 2, 1) + struct.pack(">3H", IMAGE_SIDE, IMAGE_SIDE, 1) + axes
    return message("IMAGE", body + size[6:] + size[:6] + content, device="Noise")


class Load:
    """A peer that talks: numbered strings and pictures, each batch with a question.

    Args:
        pause_s: after each batch; 0 for a flood.

    Attributes:
        answered: (time, number): when it knew that all up to that number had been handled.
        sent: the last number that was sent.
    """

    def __init__(self, port: int, pause_s: float = 0.0) -> None:
        self._pause_s = pause_s
        self.answered: list[tuple[float, int]] = []
        self.sent = 0
        self._peer = RawPeer(port)
        self._stop = threading.Event()
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.wait(self._pause_s):
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
        """Wait until this number of further batches is answered."""
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


def counted(entries: list[Entry]) -> int:
    """The last number that came in; all before it have to be there, and so has what was made of them."""
    numbers = [int(entry.data()[62:]) for entry in entries if entry.channel == "STRING/Count"]
    assert numbers == list(range(1, len(numbers) + 1))
    made = sum(entry.kind is Kind.ROS_OUT and entry.channel == "/igtl/in/Count/string" for entry in entries)
    assert len(numbers) - 1 <= made <= len(numbers)
    assert [entry.seq for entry in entries] == list(range(entries[0].seq, entries[-1].seq + 1))
    return len(numbers)
