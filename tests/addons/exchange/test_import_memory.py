"""An import holds its largest message once: a honest file that packs well needs no multiple of that."""

from __future__ import annotations

import sqlite3
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

SIZE = 64 << 20
#: Peak of the memory of an import beyond that of an empty one, in sizes of the largest message.
MOST = 1.5

_CHILD = """
import sys
from pathlib import Path
from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.source import numbered
from igtl_gateway.record.sessionfile.writer import SessionWriter

def peak():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024

for name in sys.argv[1:]:
    path = Path(name)
    source = open_source(path)
    writer = SessionWriter(path.with_suffix(".mcap"), {"config": "{}"})
    for entry in numbered(source.items()):
        writer.write(entry)
    writer.close({})
    source.close()
    assert all(row.good for row in source.rows), source.rows
    print(peak())
"""


def volume(path: Path, slices: int) -> Path:
    """NIfTI of 1 MiB for each slice, packed by gzip to a hundredth."""
    head = bytearray(352)
    struct.pack_into("<i", head, 0, 348)
    struct.pack_into("<8h", head, 40, 3, 1024, 1024, slices, 1, 1, 1, 1)
    struct.pack_into("<hh", head, 70, 2, 8)
    struct.pack_into("<8f", head, 76, *[1.0] * 8)
    struct.pack_into("<f", head, 108, 352.0)
    head[344:348] = b"n+1\0"
    packer = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS | 16)
    one = bytes(range(256)) * 4096
    path.write_bytes(packer.compress(head) + b"".join(packer.compress(one) for _ in range(slices)) + packer.flush())
    return path


def bag(path: Path, slices: int) -> Path:
    """A storage file of rosbag2 with one message of 1 MiB for each slice."""
    size = slices << 20
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles)")
    base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    base.execute("INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/UInt8MultiArray', 'cdr', '')")
    base.execute(f"INSERT INTO messages VALUES (1, 1, 1700000000000000000, zeroblob({size}))")
    with base.blobopen("messages", "data", 1) as blob:  # type: ignore[attr-defined]  # from Python 3.11 on
        blob.write(b"\0\1\0\0" + struct.pack("<III", 0, 0, size - 16))
    base.commit()
    base.close()
    return path


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs the /proc of Linux")
@pytest.mark.parametrize("kind", ["volume", "bag"])
def test_the_largest_message_is_held_once(kind: str, tmp_path: Path) -> None:
    make, end = {"volume": (volume, ".nii.gz"), "bag": (bag, ".db3")}[kind]
    files = [make(tmp_path / f"{name}{end}", slices) for name, slices in (("small", 1), ("large", SIZE >> 20))]
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, *map(str, files)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    small, large = map(int, done.stdout.split())
    assert large - small < MOST * SIZE
