"""Randomly mutated headers: an error of the program, or an import; no traceback, nothing that takes long."""

from __future__ import annotations

import gzip
import zlib
from contextlib import closing
from pathlib import Path
from random import Random

import pytest

from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.base.errors import GatewayError, LimitExceeded
from igtl_gateway.base.untrusted import limits
from tests.integration.hostile_files.images import mha, nifti, nrrd
from tests.timing import quick

CASES = 700
SEEDS = {
    "mha": mha(extra=("TransformMatrix = 1 0 0 0 1 0 0 0 1", "Offset = 1 2 3", "ElementSpacing = 1 1 1")),
    "packed mha": mha(zlib.compress(bytes(36)), packed="True"),
    "nrrd": nrrd(extra=("space: RAS", "space directions: (1,0,0) (0,1,0) none", "space origin: (1,2,3)")),
    "packed nrrd": nrrd(gzip.compress(bytes(36)), encoding="gzip"),
    "list first": nrrd(kinds="list domain domain", extra=("axis 0 index values:=0 1 2 3", 'labels: "time" "" ""')),
    "nifti": nifti(),
    "packed nifti": gzip.compress(nifti(), mtime=0),
}
KEYS = (
    *("NDims", "DimSize", "Kinds", "ElementType", "TransformMatrix", "Offset", "ElementSpacing", "CompressedData"),
    *("ElementNumberOfChannels", "HeaderSize", "BinaryData", "ElementDataFile", "IgtlGatewayEpochNs"),
    *("Seq_Frame0000_Timestamp", "Seq_Frame0001_ImageStatus", "Seq_Frame0002_XTransform", "Seq_Frame99_Timestamp"),
    *("sizes", "kinds", "space", "space directions", "space origin", "spacings", "axis mins", "type", "encoding"),
    *("endian", "data file", "byte skip", "line skip", "dimension", "axis 0 index values", "labels", "units"),
)
VALUES = (
    *("0", "-1", "1", "2", "3", "4", "65535", "65536", "9" * 30, "9" * 5000, "0x10", "1_0", "٣", "²"),
    *("1e309", "1e-320", "nan", "inf", "-inf", "", "x", "none", "(1,0,0)", "(nan,nan,nan)", "()", "(1,2)", "(((("),
    *("list", "domain", "vector", "time", "space", "???", "LOCAL", "True", "raw", "gzip", "bz2", "int64", "double"),
    *("MET_LONG_LONG", "MET_FLOAT", "RAS", "LPS", "left-posterior-superior-time", "\x1b[2J", "1 0 0 0 1 0 0 0 1"),
)


def bent(random: Random, data: bytes) -> bytes:
    """Data with one to four fields, bytes or ends that are not what they should be."""
    for _ in range(random.choice((1, 1, 2, 4))):
        is_text = data[:1] in b"ONS" and data[:1]
        if is_text and random.random() < 0.6:
            between = b": " if data.startswith(b"NRRD") else b" = "
            key = random.choice(KEYS).encode()
            value = " ".join(random.choice(VALUES) for _ in range(random.choice((1, 1, 2, 3, 4))))
            lines = data.split(b"\n")
            places = [number for number, line in enumerate(lines) if line.startswith(key)]
            place = places[0] if places else random.randrange(1, 8)
            lines[place : place + bool(places)] = [key + between + value.encode()]
            data = b"\n".join(lines)
        elif random.random() < 0.7:
            place = random.randrange(len(data))
            data = data[:place] + random.choice((b"\0", b"\1", b"\x7f", b"\x80", b"\xff")) + data[place + 1 :]
        else:
            data = data[: random.randrange(1, len(data) + 1)]
    return data


@pytest.mark.parametrize("name", SEEDS)
def test_bent_headers_end_in_our_errors(tmp_path: Path, name: str) -> None:
    random, path = Random(name), tmp_path / "some"
    ends = {True: 0, False: 0}
    for _ in range(CASES // len(SEEDS)):
        path.write_bytes(data := bent(random, SEEDS[name]))
        try:
            with quick(), closing(open_source(path)) as source:
                assert all(item.payload for item in source.items())
            ends[True] += 1
        except GatewayError as error:
            assert "Error: " not in str(error), data  # what a library raised, instead of what is wrong
            ends[False] += 1
    assert ends[False] > 10


@pytest.mark.parametrize(
    ("name", "value", "data"),
    [
        ("count", 20, mha(extra=[f"Key{number} = 1" for number in range(30)])),
        ("count", 20, nrrd(extra=[f"Key{number}:=1" for number in range(30)])),
        ("free", 900, mha(extra=["Comment = " + "x" * 2000])),
        ("fields", 2, mha(extra=[f"Seq_Frame0000_T{number}Transform = 1" for number in range(3)])),
        ("memory", 10, mha()),
        ("ratio", 1, mha(zlib.compress(bytes(10**6)), size="1000 1000 1", packed="True", frames=1)),
    ],
)
def test_each_limit_is_named(tmp_path: Path, name: str, value: int, data: bytes) -> None:
    path = tmp_path / "some.mha"
    path.write_bytes(data)
    bounds = [f"{name}={value}", *(["free=5000"] if name == "ratio" else [])]
    with (
        limits.limits_in_force(limits.parse_limits(bounds)),
        pytest.raises(LimitExceeded, match=rf"--limit {name}={value}\b"),
    ):
        open_source(path)
