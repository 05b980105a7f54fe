"""SIGKILL for a recorder that seals, at random moments: what is left must be a cut file whose beginning verifies.

.venv/bin/python tools/evidence/seal_kills.py [--kills 50] [--seed 1]     print the results
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile.seal_check import CUT, SealReport, check_seal

#: The recorder flushes, and so seals, at this interval.
FLUSH_S = 0.02


def killed(path: Path, key: Path, seconds: float, chance: random.Random) -> int:
    """Record until ``seconds`` after the start, then kill the recorder; return the size of the file."""
    before = _children()
    options = RecordOptions(flush_s=FLUSH_S, seal=key, overwrite=True, chunk_bytes=30_000)
    clock = SystemClock()
    recorder = Recorder(
        path, {}, qos_of=lambda _topic, _type: None, on_note=lambda _note: None, clock=clock, options=options
    )
    process = (_children() - before).pop()
    timer = threading.Timer(seconds, os.kill, (process, signal.SIGKILL))
    timer.start()
    number = 0
    while timer.is_alive():
        number += 1
        stamp_ns = clock.utc_ns()
        topic = f"/topic_{number % 7}"
        data = chance.randbytes(chance.choice((40, 400, 9_000)))
        recorder(Entry(number, stamp_ns, Kind.ROS_IN, topic, "std_msgs/msg/ByteMultiArray", (data,)))
        time.sleep(0.0005)
    timer.join()
    recorder.close({})
    return path.stat().st_size


def fault(report: SealReport, size: int) -> str:
    """Return what is wrong with the report of a killed recording; "" if nothing is."""
    if report.state != CUT or report.sealed_bytes + report.unsealed_bytes != size:
        return f"found {report}, expected a cut file of {size} bytes"
    return ""


def _children() -> set[int]:
    """Return the processes that this one has started."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(words[1]) == os.getpid():
            found.add(int(path.parent.name))
    return found


def main() -> int:
    """Kill recorders and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    key = SigningKey.generate()
    right, sealed, unsealed = 0, [], []
    with tempfile.TemporaryDirectory() as folder:
        file, path = Path(folder) / "key", Path(folder) / "killed.mcap"
        file.touch(0o600)
        file.write_bytes(key.private_pem())
        for number in range(options.kills):
            size = killed(path, file, chance.uniform(0.01, 1.0), chance)
            report = check_seal(path, frozenset([key.public]))
            if wrong := fault(report, size):
                print(f"kill {number}: {wrong}")
            right += not wrong
            sealed.append(report.sealed_bytes)
            unsealed.append(report.unsealed_bytes)
    print(f"{right} of {options.kills} are cut files whose beginning verifies; seed {options.seed}")
    print(f"sealed bytes {min(sealed):,} to {max(sealed):,}, unsealed {min(unsealed):,} to {max(unsealed):,}")
    return 0 if right == options.kills else 1


if __name__ == "__main__":
    sys.exit(main())
