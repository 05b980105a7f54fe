"""A session of hours: TRANSFORM at 1 kHz both ways, of which each part of five minutes has the stamps of its own time.

    python -m tools.evidence.long_session HOURS OUT.mcap [--measure]

The first part is that of ``bench --case offline``; the others are the same with later stamps, so the file is written at
the speed of the disk (1 hour: 14.4 million entries, 0.7 GB).  ``--measure`` runs verify, slice (ten minutes from the
middle on) and info on it, and prints the CPU time, the time and the memory of each.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.interfaces import SHARES
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.record.sessionfile.columns import EntryColumns, Stream
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.stream_rows import ColumnsWriter
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire.header import TICKS_AT
from igtl_gateway_lab.bench import recordings, spent
from igtl_gateway_lab.programs import ours

_PART_S = 300
_CDR_STAMP_AT = 4
_SLICE_S = 600


def write(path: Path, hours: float) -> int:
    """Write the session; return the number of its entries."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        first = Path(folder, "first.mcap")
        recordings.small(first, min(_PART_S, hours * 3600))
        with SessionFile.open(first) as file:
            writer = SessionWriter(path, dict(file.session), types=RosTypes(SHARES), counted=True)
            in_bulk, begun = ColumnsWriter(writer), 0
            for part in range(max(1, round(hours * 3600 / _PART_S))):
                for columns in file.columns():
                    begun = begun or int(columns.numbers[~columns.of(_is_pose)].max())
                    rest = columns.where(columns.numbers > begun) if part else columns
                    in_bulk.write(later(rest, part, part * (file.entry_count - begun)))
            writer.close({})
    return writer.entries


def _is_pose(stream: Stream) -> bool:
    return stream.type in ("TRANSFORM", TransformStamped.TYPE)


def later(columns: EntryColumns, part: int, before: int) -> EntryColumns:
    """Return poses with the stamps of a later part, and numbers behind the ``before`` ones of the parts between."""
    data, wire, shift_s = bytearray(columns.data), columns.wire(), part * _PART_S
    octets, is_ros = np.frombuffer(data, np.uint8), columns.of(lambda stream: stream.type == TransformStamped.TYPE)
    for places, dtype in ((wire.begins + TICKS_AT, ">u4"), (columns.begins[is_ros] + _CDR_STAMP_AT, "<i4")):
        at = places[:, np.newaxis] + np.arange(4)
        octets[at] = (octets[at].view(dtype) + shift_s).astype(dtype).view(np.uint8)
    return replace(
        columns,
        data=bytes(data),
        numbers=columns.numbers + before,
        times=columns.times + shift_s * NS_PER_S,
        publish_times=columns.publish_times + shift_s * NS_PER_S,
    )


def measured(path: Path, hours: float, folder: Path) -> Iterator[dict[str, object]]:
    """Yield what each verb takes."""
    middle = hours * 3600 / 2
    part = folder / "part.mcap"
    for words in (
        ["info", str(path)],
        ["verify", str(path)],
        ["slice", str(path), "-o", str(part), "--start", f"{middle:g}", "--end", f"{middle + _SLICE_S:g}"],
        ["verify", str(part)],
    ):
        clock, figures = SystemClock(), folder / f"{words[0]}-{Path(words[1]).name}"
        begun_ns = clock.monotonic_ns()
        subprocess.run(
            [sys.executable, "-S", spent.__file__, figures, *ours(*words)], check=True, stdout=subprocess.DEVNULL
        )
        wall_s = (clock.monotonic_ns() - begun_ns) / NS_PER_S
        found = json.loads(figures.read_text("ascii"))
        yield {
            "verb": words[0],
            "of": Path(words[1]).name,
            "cpu_s": round(found["cpu_s"], 1),
            "wall_s": round(wall_s, 1),
            "peak_mb": round(found["peak_kib"] / 1000),
            "code": found["code"],
        }


def main() -> None:
    """Write the session, and measure what works on it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hours", type=float)
    parser.add_argument("out", type=Path)
    parser.add_argument("--measure", action="store_true")
    options = parser.parse_args()
    if not options.out.exists():
        print(f"{options.out}: {write(options.out, options.hours):,} entries", flush=True)
    if options.measure:
        with tempfile.TemporaryDirectory(dir=options.out.parent) as folder:
            for row in measured(options.out, options.hours, Path(folder)):
                print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
