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


#: Name → how such a file begins, and what is printed of it.
OTHERS = {
    "a.csv": (b"a,b\n1,2\n", "a table, which `import` takes by a recipe (examples/kinematics.toml)"),
    "plus.log": (b"|INFO|000|", "a log of a program, which no verb reads"),
    "a.txt": (b"hello\n", "text, which no verb reads"),
    "a.toml": (b"listen = []\n", "a configuration, which `bridge --config` and `resim --recipe` take"),
    "a.urdf": (b"<robot name='a'/>", "a robot, which `view --urdf` takes"),
    "a.parquet": (b"PAR1", "a table of Parquet, which no verb imports, but pandas and DuckDB read"),
    "a.rrd": (b"RRF2", "a recording of rerun, which the program rerun shows"),
    "a.zip": (b"PK\3\4", "an archive, which must be unpacked first"),
    "a.png": (b"\x89PNG\r\n", "a picture, which has no times and is not imported"),
}


def test_what_no_import_reads_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, (start, what) in OTHERS.items():
        Path(name).write_bytes(start)
        for command in ("info X", "verify X", "doctor X"):
            found = printed(command, name, capsys)
            assert " ".join(found.split()).endswith(
                f"{name}: found {what}; expected a recording of igtl-gateway (MCAP)"
            ), command


@pytest.mark.parametrize("first", ["a.mcap", "0-damaged.mcap"])
def test_a_folder_of_recordings_is_no_bag(
    first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study" / "monday").mkdir(parents=True)
    data = Path(A).read_bytes()
    (tmp_path / "study" / first).write_bytes(data if first == "a.mcap" else data[:-100])
    for name in ("b.mcap", "monday/c.mcap"):
        (tmp_path / "study" / name).write_bytes(data)
    for verb, many in {
        "info": "info",
        "verify": "verify",
        "doctor": "lint",
        "review": "review",
    }.items():
        for folder in ("study", "."):
            found = " ".join(printed(f"{verb} X", folder, capsys).split())
            assert f"{folder}: found a directory with 3 recordings, expected one of them" in found, verb
            assert f"of all of them: igtl-gateway cohort {many} {folder} -o study" in found and "import" not in found
    for verb in ("slice X -o o.mcap", "view X -o o.rrd"):
        assert printed(verb, "study", capsys).endswith("found a directory with 3 recordings, expected one of them\n")


def test_several_recordings_are_those_of_a_cohort(capsys: pytest.CaptureFixture[str]) -> None:
    for verb, many in (("verify", "verify"), ("info", "info"), ("doctor", "lint")):
        with pytest.raises(SystemExit, match="2"):
            main([verb, A, A])
        found = " ".join(capsys.readouterr().err.split())
        assert found.endswith(
            f"unrecognized arguments: {A}; of all of them: igtl-gateway cohort {many} {A} {A} -o study"
        )
    with pytest.raises(SystemExit, match="2"):
        main(["verify", A, "absent.mcap"])
    assert "cohort" not in capsys.readouterr().err
