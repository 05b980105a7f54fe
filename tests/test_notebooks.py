"""docs/notebooks: they print what is stored; their numbers equal those of info, export and a plain reader."""

from __future__ import annotations

import csv
import json
import struct
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from igtl_gateway.cli import main
from tests.places import ROOT
from tools import notebooks

STAR = ROOT / "fixtures" / "star.mcap"
TOOL, CLOUD = "TRANSFORM/ToolToBase", "POLYDATA/TissueCloud"


@pytest.fixture(scope="module")
def numbers() -> dict[str, float]:
    """What the notebook has printed, by name."""
    document = json.loads((notebooks.FOLDER / "star.ipynb").read_text("utf-8"))
    printed = notebooks.shown(document)[-2][0].splitlines()
    return {name: float(value) for name, value in (line.split() for line in printed)}


@pytest.fixture(scope="module")
def recorded() -> list[Any]:
    """The messages of the gateway to its peers, by the readers of MCAP alone."""
    reader = make_reader(BytesIO(STAR.read_bytes()), decoder_factories=[DecoderFactory()])
    topics = ["/igtl_gateway/wire/out/transform/ToolToBase", "/igtl_gateway/wire/out/polydata/TissueCloud"]
    return [decoded for _, _, _, decoded in reader.iter_decoded_messages(topics=topics)]


def test_they_print_what_is_stored() -> None:
    # A process of its own: Jupyter's libraries warn about themselves.
    command = [sys.executable, "tools/notebooks.py", "--check"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def test_the_numbers_are_those_of_info(numbers: dict[str, float], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--json", str(STAR)]) == 0
    streams = {stream["stream"]: stream for stream in json.loads(capsys.readouterr().out)["streams"]}
    assert numbers["poses"] == streams[TOOL]["messages"]


def test_the_numbers_are_those_of_export(
    numbers: dict[str, float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(STAR), "--to", "csv", "-o", str(tmp_path / "t"), "--streams", TOOL]) == 0
    (table,) = (tmp_path / "t").glob("*.csv")
    with table.open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    positions = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows])
    assert numbers["poses"] == len(rows)
    assert numbers["path_mm"] == round(float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()), 3)
    assert numbers["lowest_mm"] == round(float(positions[:, 2].min()), 3)


def test_the_numbers_are_those_of_a_plain_reader(numbers: dict[str, float], recorded: list[Any]) -> None:
    poses = [message for message in recorded if message.type == "TRANSFORM"]
    matrices = np.array([struct.unpack_from(">12f", message.data, 58) for message in poses], np.float64)
    steps = np.diff(matrices[:, 9:], axis=0)
    delays = [
        (message.stamp.sec - message.source_stamp.sec) * 1e3
        + (message.stamp.nanosec - message.source_stamp.nanosec) / 1e6
        for message in poses
    ]
    cloud = next(message for message in recorded if message.type == "POLYDATA")
    (points,) = struct.unpack_from(">I", cloud.data, 58)
    assert numbers == {
        "poses": len(poses),
        "path_mm": round(float(np.linalg.norm(steps, axis=1).sum()), 3),
        "lowest_mm": round(float(matrices[:, 11].min()), 3),
        "points": points,
        "latency_median_ms": pytest.approx(np.median(delays), abs=1e-6),
        "latency_maximum_ms": pytest.approx(max(delays), abs=1e-6),
    }
