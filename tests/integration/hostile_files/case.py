"""A hostile file, the sorts of files with the verbs that read them, and the parts that bombs are made of."""

from __future__ import annotations

import bz2
import gzip
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]

from igtl_gateway.addons.exchange.targets import TARGETS
from igtl_gateway.base.versions import StrEnum
from tests.places import ROOT

GOOD, SMALL = ROOT / "fixtures" / "ultrasound.mcap", ROOT / "fixtures" / "acquisition.mcap"
MIB = 1 << 20
GIB = 1 << 30

#: What a forged line begins with, and what a terminal would execute.
FORGED = "FORGED verified: all outputs equal"
ESCAPE = "\x1b]0;owned\x07\x1b[2J"
NAUGHTY = f"a{ESCAPE}\n{FORGED}\r\u202e"


class Danger(StrEnum):
    """What a file is out for."""

    BOMB = "bomb"
    LIE = "lie"
    SHAPE = "wrong shape"
    TERMINAL = "terminal"


@dataclass(frozen=True, slots=True)
class Hostile:
    """One hostile file.

    Attributes:
        name: of the case, and of its folder.
        sort: key of ``VERBS``.
        danger: what it is out for.
        what: the same for people.
        build: makes it in a new folder and gives the path that the verbs get.
        expected: part of the output of the first verb of its sort; empty for a file that is read without an error.
    """

    name: str
    sort: str
    danger: Danger
    what: str
    build: Callable[[Path], Path]
    expected: str = ""


def file(name: str, data: Callable[[], bytes]) -> Callable[[Path], Path]:
    """A builder of one file with these bytes."""

    def build(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(data())
        return path

    return build


_SESSION_VERBS = (
    "info F",
    "info F --json",
    "verify F",
    "verify F --json",
    "recover F -o OUT.mcap",
    "lint F",
    "lint F --json",
    "slice F -o OUT.mcap --start 0 --end 2",
    "diff F F",
    "diff F GOOD --json",
    "replay F --to igtl --listen 127.0.0.1:0 --wait-peers 0 --as-fast-as-possible",
    "replay F --to igtl --through-gateway --listen 127.0.0.1:0 --wait-peers 0 --as-fast-as-possible",
    "import F -o OUT.mcap",
    *(f"export F --to {target} -o OUT" for target in TARGETS),
    "sync F",
    "sync F --json",
    "view F -o OUT.rrd",
    "review F",
    "review F --json",
    "deidentify F -o OUT.mcap",
    "deidentify F -o OUT.mcap --profile PROFILE --json",
    "seal F --key KEY -o OUT.mcap",
    "verify F --seal",
    "verify F --seal --trusted KEY.pub --json",
    "export F --to lerobot --write-recipe OUT.toml",
    "export F --to lerobot --recipe RECIPE -o OUT",
    "merge F SMALL -o OUT.mcap",
    "merge F --extract a -o OUT.mcap",
    "merge SMALL F -o OUT.mcap --json",
    "merge a=SMALL b=F -o OUT.mcap --offset b=0.5",
    "keep FOLDER --retention 1MB --dry-run",
    "keep FOLDER --retention 1h,1MB --only-sealed --json",
    "keep FOLDER --upload s3://bucket/prefix --patience 0",
)

#: Files that verbs get besides the hostile one, all of them sound: name in ``VERBS`` → content.
BESIDES = {
    "PROFILE": '[[mask]]\nstream = "**"\nrectangles = [[0, 0, 8, 8]]\n[[text]]\nstream = "**"\naction = "keep"\n',
    "RECIPE": '[dataset]\nfps = 20\ntask = "none"\nrobot_type = "none"\n[episodes]\nby = "whole"\n'
    + "".join(
        f'[[feature]]\nname = "{name}"\nstream = "TRANSFORM/Probe**"\n' for name in ("observation.state", "action")
    ),
}

#: Sort of file → the verbs that read it.  F is the file, FOLDER its folder, CONTENT its text; GOOD, SMALL, SEALED and
#: STAMPED are sound recordings, KEY is the key of SEALED, COHORT a folder of tables; OUT is what is written.  Words
#: with an equals sign before the verb are its environment.
VERBS: dict[str, tuple[str, ...]] = {
    "session": _SESSION_VERBS,
    "foreign MCAP": _SESSION_VERBS,
    "ROS 1 bag": ("import F -o OUT.mcap", "import F -o OUT.mcap --json", "info F"),
    "ROS 2 bag": ("import F -o OUT.mcap", "import F -o OUT.mcap --json", "info F"),
    "sequence": ("import F -o OUT.mcap", "import F -o OUT.mcap --json", "info F"),
    "scene": ("import F -o OUT.mcap", "import F -o OUT.mcap --json", "info F"),
    "file of 3D Slicer": ("import F -o OUT.mcap", "import F -o OUT.mcap --json", "info F"),
    "capture": ("import F -o OUT.mcap", "import F -o OUT.mcap --json", "decode F"),
    "stream": ("decode F", "decode F -o OUT.igtl", "import F -o OUT.mcap", "info F"),
    "robot": ("view SMALL -o OUT.rrd --urdf F", "view SMALL -o OUT.rrd --json --urdf F"),
    "configuration": (
        "verify GOOD --config F",
        "slice GOOD -o OUT.mcap --config F --start 0 --end 1",
        "lint GOOD --config F",
        "bridge --no-ros --listen 127.0.0.1:0 --duration 0.1 --config F",
    ),
    "key": (
        "keys show F",
        "keys rotate F OUT.key",
        "seal SMALL --key F -o OUT.mcap",
        "verify SEALED --seal --trusted F",
        "deidentify SMALL -o OUT.mcap --secret F",
        "bridge --no-ros --listen 127.0.0.1:0 --duration 0.1 --record OUT.mcap --seal F",
    ),
    "profile": ("deidentify SMALL -o OUT.mcap --profile F", "deidentify SMALL -o OUT.mcap --profile F --json"),
    "recipe": (
        "export SMALL --to lerobot --recipe F -o OUT",
        "export SMALL --to lerobot --recipe F -o OUT --json",
    ),
    "time stamp": (
        "seal SEALED --time-stamp F -o OUT.mcap",
        "verify STAMPED --seal --tsa F",
    ),
    "certificate": (
        "verify STAMPED --seal --tsa F",
        "verify STAMPED --seal --tsa F --json",
        "verify SEALED --seal --tsa F",
        "verify SEALED --seal --trusted F",
    ),
    "folder": (
        "keep F --retention 1MB --only-uploaded --dry-run",
        "keep F --retention 1h,1MB --only-uploaded --json",
        "keep F --upload s3://bucket/prefix --patience 0",
        "keep F --upload s3://bucket/prefix --patience 0 --json",
        "keep F --retention 1MB",
    ),
    "AWS file": (
        "AWS_ACCESS_KEY_ID= AWS_SHARED_CREDENTIALS_FILE=F keep GOODS --upload s3://bucket/prefix --patience 0",
        "AWS_CONFIG_FILE=F keep GOODS --upload s3://bucket/prefix --patience 0",
    ),
    "Zenoh configuration": (
        "ZENOH_ROUTER_CONFIG_URI=F zenoh-router",
        "ZENOH_SESSION_CONFIG_URI=F bridge --ros zenoh --listen 127.0.0.1:0 --duration 0.1",
    ),
    "cohort": (
        *(
            f"cohort {words} -o F --limit memory=64000000"
            for words in (
                "query 'SELECT * FROM tasks'",
                "query 'SELECT * FROM sessions' --json",
                "query 'SELECT * FROM findings' --csv OUT.csv",
                "report --html OUT.html",
            )
        ),
        "cohort info SMALL -o F --workers 1",
    ),
    "question": tuple(
        f"cohort query CONTENT -o COHORT{words} --limit seconds=2 --limit memory=64000000"
        for words in ("", " --json", " --csv OUT.csv", " --parquet OUT.parquet")
    ),
    "sources": tuple(f"cohort {verb} F -o OUT --workers 2" for verb in ("info", "lint", "verify", "review", "sync")),
    # not decode: it reads a stream, which a FIFO or a device may be
    "place": (
        "info F",
        "import F -o OUT.mcap",
        "verify GOOD --config F",
        "recover F -o OUT.mcap",
        "export F --to csv -o OUT",
        "deidentify F -o OUT.mcap",
        "seal F --key KEY -o OUT.mcap",
        "verify F --seal",
        "verify SEALED --seal --trusted F",
        "deidentify SMALL -o OUT.mcap --profile F",
        "export SMALL --to lerobot --recipe F -o OUT",
        "keep F --retention 1MB --dry-run",
        "keep F --upload s3://bucket/prefix --patience 0",
        "cohort query 'SELECT 1' -o F",
        "merge SMALL F -o OUT.mcap",
        "seal SEALED --time-stamp F -o OUT.mcap",
        "verify STAMPED --seal --tsa F",
        "ZENOH_ROUTER_CONFIG_URI=F zenoh-router",
    ),
}


# --- bombs: built packed, so that making them costs nothing ----------------------------------------------------------


def zstd_zeros(size: int, declared: int | None = None) -> bytes:
    """A zstd frame of ``size`` zeros as run-length blocks, 4 bytes for each 128 KiB; it may declare another size.

    https://www.rfc-editor.org/rfc/rfc8878
    """
    block = 128 * 1024
    blocks = max(1, size // block)
    body = bytearray()
    for number in range(blocks):
        last = number == blocks - 1
        body += ((block << 3) | (1 << 1) | last).to_bytes(3, "little") + b"\0"
    if declared == 0:  # none declared: a window of 128 KiB
        head = struct.pack("<IBB", 0xFD2FB528, 0b00000000, (17 - 10) << 3)
    else:
        head = struct.pack("<IBBQ", 0xFD2FB528, 0b11000000, (17 - 10) << 3, size if declared is None else declared)
    return head + bytes(body)


@cache
def lz4_zeros(size: int, declared: int = 0) -> bytes:
    """An LZ4 frame of ``size`` zeros, which declares ``declared`` bytes if that is not 0."""
    block = 4 * MIB
    one = lz4.frame.compress(
        bytes(block),
        block_size=lz4.frame.BLOCKSIZE_MAX4MB,
        block_linked=False,
        content_checksum=False,
        store_size=False,
    )
    packed = one[7:-4]
    if not declared:
        return bytes(one[:7] + packed * max(1, size // block) + bytes(4))
    real = lz4.frame.compress(bytes(block), block_size=lz4.frame.BLOCKSIZE_MAX4MB, block_linked=False, store_size=True)
    # the checksum of the descriptor covers the size: it is a byte of xxHash, which is tried
    for check in range(256):
        head = real[:6] + struct.pack("<Q", declared) + bytes([check])
        try:
            lz4.frame.get_frame_info(head + packed + bytes(4))
        except RuntimeError:
            continue
        return bytes(head + packed * max(1, size // block) + bytes(4))
    raise AssertionError


@cache
def gzip_zeros(size: int) -> bytes:
    """Members of gzip, each 16 MiB of zeros."""
    return gzip.compress(bytes(16 * MIB), 9, mtime=0) * max(1, size // (16 * MIB))


@cache
def zlib_zeros(size: int) -> bytes:
    """A zlib stream of zeros in parts that repeat; its checksum is wrong, but no reader should get there."""
    packer = zlib.compressobj(9)
    first = packer.compress(bytes(16 * MIB)) + packer.flush(zlib.Z_FULL_FLUSH)
    second = packer.compress(bytes(16 * MIB)) + packer.flush(zlib.Z_FULL_FLUSH)
    return first + second * max(1, size // (16 * MIB) - 1) + packer.flush()


@cache
def bz2_zeros(size: int) -> bytes:
    """Streams of bz2, each 32 MiB of zeros."""
    return bz2.compress(bytes(32 * MIB)) * max(1, size // (32 * MIB))
