"""``info`` of a bag of rosbag2, in both storages, and of the standard input."""

from __future__ import annotations

import io
import json
import shutil
import sqlite3
from pathlib import Path
from types import SimpleNamespace

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.cli import main
from tests.tables import table

CRTK = Path("fixtures/crtk.mcap")


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_a_bag_of_ros_2(storage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin[storage]) as writer:
        topic = writer.add_connection("/said", "std_msgs/msg/String", typestore=types)
        for number in range(5):
            content = types.types["std_msgs/msg/String"](data=f"{number}")
            writer.write(topic, 1_700_000_000_000_000_000 + number, types.serialize_cdr(content, "std_msgs/msg/String"))
    bag = tmp_path / "bag"
    assert main(["info", str(bag), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["file"] == str(bag)
    # what is stated is of the bag, not of the temporary session in which it is read
    size = sum(file.stat().st_size for file in bag.iterdir())
    assert (found["foreign"], found["bytes"], found["session"], found["ledger"]) == (True, size, {}, None)
    assert not any("unit" in stream for stream in found["streams"])
    assert main(["info", str(bag)]) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"{bag}: bag of rosbag2, ") and "made by" not in told and "units" not in told
    (step,) = told.split("next\n")[1].splitlines()
    assert step.split("  ")[1] == f"igtl-gateway import {bag} -o session.mcap"
    assert [(each["stream"], each["messages"]) for each in found["streams"] if each["stream"] == "/said"] == [
        ("/said", 5)
    ]


def test_a_bag_that_is_damaged_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: [", "utf-8")
    assert main(["info", str(tmp_path / "bag")]) in (1, 2)
    assert len(capsys.readouterr().err.splitlines()) == 1
    sqlite3.connect(tmp_path / "bag" / "bag_0.db3").close()
    assert main(["info", str(tmp_path / "bag")]) in (1, 2)


def test_the_standard_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shutil.copytree("fixtures", tmp_path / "fixtures").parent)
    assert main(["info", str(CRTK), "--json"]) == 0
    expected = json.loads(capsys.readouterr().out)
    with CRTK.open("rb") as stream:
        monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=stream, isatty=lambda: False))
        assert main(["info", "-", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == expected | {"file": "-"}
    with CRTK.open("rb") as stream:
        monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=stream, isatty=lambda: False))
        assert main(["info", "-"]) == 0
    assert "next" not in capsys.readouterr().out.splitlines(), "no other verb reads the standard input"
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    assert main(["info", "-"]) == 2
    assert "expected one: igtl-gateway info - < out.mcap" in capsys.readouterr().err


@table(
    "data, why",
    [
        (b"", "-: the file is empty"),
        (b"\x00" * 99, "-: not an MCAP file"),
        (CRTK.read_bytes()[:5000], "-: was cut off after 5,000 bytes; run: igtl-gateway recover FILE"),
    ],
)
def test_a_damaged_standard_input_is_no_temporary_file(
    data: bytes, why: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(data), isatty=lambda: False))
    assert main(["info", "-"]) in (1, 2)
    told = capsys.readouterr().err
    assert f"igtl-gateway info: {why}" in told and "session.mcap" not in told


def test_a_standard_input_without_end_is_refused_at_its_first_bytes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was copied until the disk was full."""
    endless = SimpleNamespace(read=lambda size: b"y\n" * (size // 2))
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=endless, isatty=lambda: False))
    assert main(["info", "-"]) == 2
    assert "-: not an MCAP file: found 79 0a" in capsys.readouterr().err
