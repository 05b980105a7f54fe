"""A file of another program: each verb that reads recordings names the command that imports it."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.cli import main
from tests.places import FIXTURES

#: Name → how such a file begins, and what it is called.
FILES = {
    "a.bag": (b"#ROSBAG V2.0\n", "a bag of ROS 1"),
    "a.db3": (b"SQLite format 3\0", "a bag of rosbag2"),
    "a.igs.mha": (b"ObjectType = Image\nNDims = 3\n", "pictures of MetaImage or NRRD"),
    "a.nrrd": (b"NRRD0004\ntype: uchar\n", "pictures of MetaImage or NRRD"),
    "a.tfm": (b"#Insight Transform File V1.0\n", "a transform of ITK"),
    "a.pcap": (b"\xd4\xc3\xb2\xa1\x02\0\x04\0" + bytes(16), "a capture of network traffic"),
}
VERBS = (
    "info X", "verify X", "doctor X", "diff X A", "diff A X", "slice X -o o.mcap", "recover X -o o.mcap",
    "export X --to csv -o o", "sync X", "merge a=X b=A -o o.mcap", "deidentify X -o o.mcap", "view X -o o.rrd",
    "review X", "replay X --to igtl", "mark X --label a --at 1",
)  # fmt: skip
A = str(FIXTURES / "acquisition.mcap")


def printed(command: str, name: str, capsys: pytest.CaptureFixture[str]) -> str:
    words = {"X": name, "a=X": f"a={name}", "A": A, "b=A": f"b={A}"}
    assert main([words.get(word, word) for word in command.split()]) == 2, command
    return capsys.readouterr().err


def test_each_verb_names_the_import(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, (start, what) in FILES.items():
        Path(name).write_bytes(start + bytes(512))
        for command in VERBS if name == "a.db3" else VERBS[:3]:
            told = printed(command, name, capsys)
            assert f"{name}: found {what}, expected a recording" in told, command
            assert f"; run: igtl-gateway import {name} -o session.mcap" in told, command


def test_the_folder_of_a_bag_of_several_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", A, "--to", "rosbag2", "-o", "my bag"]) == 0
    capsys.readouterr()
    for command in ("view X -o o.rrd", "slice X -o o.mcap", "diff X A", "diff A X", "verify X", "merge a=X b=A -o o"):
        assert "; run: igtl-gateway import 'my bag' -o session.mcap" in printed(command, "my bag", capsys), command


@pytest.mark.parametrize("start", [b"a,b\n1,2\n", b"hello\n"])
def test_what_no_import_reads_has_no_such_command(
    start: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(start)
    assert "igtl-gateway import" not in printed("info X", str(path), capsys)
