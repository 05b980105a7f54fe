"""SIGKILL for bridge and recorder at random moments of a loaded machine: what is lost, by the log of an own sender.

The recording must have what was sent longer ago than the flush interval.  A program of its own sends poses and notes
when each was handed to its socket; the load is a number of programs that use a processor each, in sessions of their
own, as programs of others are.  What a kill lost are the poses in the log of the sender that the file
does not have.

.venv/bin/python tools/flush_kills.py [--kills 60] [--loads 0 4 16] [--hz 1000] [--seed 1]     print a row for each load
.venv/bin/python tools/flush_kills.py --kills 67 --page          200 kills (40 min), into docs/evidence/soak.md
"""

from __future__ import annotations

import argparse
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from igtl_gateway.base.buffers import join
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.transform import Transform
from tools import pages

#: Entries that are younger may be lost: the flush interval of 0.5 s, and 0.15 s for the kill and for the socket.
MOST_AGE_S = 0.65
#: Of one message, and the interval at which the connection is looked at.
_POSE_BYTES, _LOOK_S = 106, 0.02

_PAGE, _HEADING = "docs/evidence/soak.md", "## Kills under load"
_TITLES = (
    "| load: programs that use a core | kills | lost entries older than 0.65 s | of them reported before | oldest, s "
    "| lost entries, median | most |",
    "| ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
)


def poses(place: tuple[str, int], hz: float, sent: list[float], read: list[float], ends: threading.Event) -> None:
    """Send poses whose x is their number, until the connection ends.

    Args:
        place: of the bridge.
        hz: number a second.
        sent: gets the time at which each was handed over.
        read: gets the time until which the bridge has read each.
        ends: set at the end.
    """
    with socket.create_connection(place) as link:
        begun, number, looked = time.monotonic(), 0, 0.0
        while not ends.is_set():
            due = int((time.monotonic() - begun) * hz) - number
            try:
                for _ in range(due):
                    pose = Transform((1.0, 0, 0, 0, 1, 0, 0, 0, 1, number, 0, 0))
                    link.sendall(join(encode(Message("TRANSFORM", "ToolToBase", pose))))
                    sent.append(time.monotonic())
                    number += 1
                if time.monotonic() - looked > _LOOK_S:
                    looked = time.monotonic()
                    count = number - -(-unread(place[1]) // _POSE_BYTES)
                    read += [looked] * (count - len(read))
            except OSError:
                return
            time.sleep(1 / hz)


def unread(port: int) -> int:
    """Return the bytes that wait in the connections of a port of this machine: its program has not read them."""
    found, place = 0, f":{port:04X}"
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, local, remote, _, queues, *_ = line.split()
        if local.endswith(place):
            found += int(queues.partition(":")[2], 16)
        elif remote.endswith(place):
            found += int(queues.partition(":")[0], 16)
    return found


def one_kill(folder: Path, hz: float, seconds: float) -> tuple[int, float, bool, int]:
    """Record, kill both after a time; return lost poses, the age of the oldest, if a note reported it, and the unread.

    The age is the time since the bridge had read it, at the moment of the kill, s; 0 without any.  What the bridge has
    not read from its connection is not lost: no recorder has had it.
    """
    path = folder / "killed.mcap"
    path.unlink(missing_ok=True)
    gateway = str(Path(sys.executable).with_name("igtl-gateway"))
    command = [gateway, "bridge", "--no-ros", "--listen", "127.0.0.1:0", "--record", str(path), "--log-format", "json"]
    with (folder / "out.txt").open("wb") as out:
        bridge = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    said = folder / "out.txt"
    sent: list[float] = []
    read: list[float] = []
    ends = threading.Event()
    try:
        deadline = time.monotonic() + 120
        while not (found := re.search(rb'"port": (\d{2,5})', said.read_bytes())) or b"started" not in said.read_bytes():
            if time.monotonic() > deadline:
                raise RuntimeError(f"the bridge does not start: {said.read_bytes()[:500]!r}")
            time.sleep(0.05)
        sender = threading.Thread(target=poses, args=(("127.0.0.1", int(found[1])), hz, sent, read, ends), daemon=True)
        sender.start()
        time.sleep(seconds)
        recorder = _recorder(bridge.pid)
        os.kill(recorder, signal.SIGKILL)
        bridge.send_signal(signal.SIGKILL)
        killed = time.monotonic()
    finally:
        ends.set()
        bridge.kill()
        bridge.wait()
    while Path(f"/proc/{recorder}/fd").is_dir() and _is_alive(recorder):
        time.sleep(0.01)
    sender.join()
    with Salvage.open(path) as file:
        kept = {
            int(decode(entry.payload[0]).content.wire_matrix[9])  # type: ignore[attr-defined]
            for entry in file.entries()
            if entry.kind is Kind.IGTL_IN
        }
    lost = [at for number, at in enumerate(read) if number not in kept and at <= killed]
    not_read = sum(at <= killed for at in sent) - len(read)
    return len(lost), killed - min(lost) if lost else 0.0, b"record_late" in said.read_bytes(), max(0, not_read)


def _recorder(bridge: int) -> int:
    """Return the process of the recorder of a bridge."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = path.read_text().rpartition(")")[2].split()
            command = (path.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if int(words[1]) == bridge and b"igtl_gateway.record.host" in command:
            return int(path.parent.name)
    raise RuntimeError(f"process {bridge} has no recorder")


def _is_alive(process: int) -> bool:
    """Return whether a process still runs: one that was killed may wait for its parent."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def main() -> int:
    """Kill recordings and print what was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--loads", type=int, nargs="+", default=[0, 4, 16])
    parser.add_argument("--hz", type=float, default=1000.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page", action="store_true", help=f"write the table of {_PAGE}, after each load")
    options = parser.parse_args()
    chance = random.Random(options.seed)
    late, table, seen = 0, list(_TITLES), pages.Load()
    print(*_TITLES, sep="\n", flush=True)
    for load in options.loads:
        # a hog ends with this process, also if that is killed
        words = [sys.executable, "-c", "import os\nmine = os.getppid()\nwhile os.getppid() == mine:\n    pass"]
        hogs = [subprocess.Popen(words, start_new_session=True) for _ in range(load)]
        try:
            with tempfile.TemporaryDirectory() as name:
                rows: list[tuple[int, float, bool, int]] = []
                for _ in range(options.kills):
                    seconds = chance.uniform(1.0, 6.0)
                    rows.append(one_kill(Path(name), options.hz, seconds))
                    seen.look()
                    if rows[-1][1] > MOST_AGE_S:
                        count, age_s, told, waits = rows[-1]
                        print(
                            f"lost {count:,}, {age_s:.2f} s, {'reported' if told else 'not reported'}, by a kill "
                            f"{seconds:.2f} s after the first; {waits:,} more not read"
                        )
        finally:
            for hog in hogs:
                hog.kill()
                hog.wait()
        old = [row for row in rows if row[1] > MOST_AGE_S]
        late += len(old)
        lost = sorted(row[0] for row in rows)
        table.append(
            f"| {load} (1 min: {os.getloadavg()[0]:.0f}) | {len(rows)} | {len(old)} | {sum(row[2] for row in old)} "
            f"| {max(row[1] for row in rows):.2f} | {lost[len(lost) // 2]:,} | {lost[-1]:,} |"
        )
        print(table[-1], flush=True)
        if options.page:
            pages.write(_PAGE, _HEADING, "tools/flush_kills.py", f"{options.hz:g} poses a second, {seen}", table)
    return 1 if late else 0


if __name__ == "__main__":
    sys.exit(main())
