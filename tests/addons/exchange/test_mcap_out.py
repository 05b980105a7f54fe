"""Every verb reads a recording with digests as one with all bytes, and what it writes verifies."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from igtl_gateway.cli import USAGE, main
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.record.sessionfile.test_derived import large, plain, session, written
from tests.tables import table


@pytest.fixture(scope="module")
def log() -> list[Entry]:
    return session(2).log


@pytest.fixture(scope="module")
def folder(log: list[Entry], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the session in all three forms."""
    folder = tmp_path_factory.mktemp("recordings")
    written(folder / "full.mcap", log, "full")
    written(folder / "digest.mcap", log, "digest")
    written(folder / "none.mcap", log, "none")
    return folder


Run = Callable[..., str]


@pytest.fixture
def run(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[Run]:
    """Runs a verb on a recording of the folder, with OUT in a folder of the test."""

    def call(words: str, code: int = 0) -> str:
        given = [word.replace("OUT", str(tmp_path / "out")) for word in words.split()]
        assert main([str(folder / word) if word in _FILES else word for word in given]) == code, words
        return capsys.readouterr().out

    yield call


_FILES = ("full.mcap", "digest.mcap", "none.mcap")


def contents(path: Path) -> list[tuple[Any, ...]]:
    with SessionFile.open(path) as file:
        return plain(file.entries())


def digests_of(path: Path) -> int:
    with path.open("rb") as stream:
        return sum("/igtl_gateway/digest/" in each.topic for _, each, _ in make_reader(stream).iter_messages())


@table(
    "words, keeps",
    [
        ("slice FILE -o OUT.mcap --start 0.05 --end 0.3", True),
        ("slice FILE -o OUT.mcap --streams **camera**", True),
        ("recover FILE -o OUT.mcap", True),
        ("deidentify FILE -o OUT.mcap", False),
        ("export FILE --to mcap -o OUT.mcap", False),
        ("export FILE --to mcap --outputs full -o OUT.mcap", False),
        ("export FILE --to mcap --outputs digest -o OUT.mcap", True),
    ],
)
def test_what_a_verb_writes_verifies_and_has_all_bytes(run: Run, tmp_path: Path, words: str, keeps: bool) -> None:
    found = []
    for name in ("full.mcap", "digest.mcap"):
        out = tmp_path / name
        run(words.replace("FILE", name).replace("OUT.mcap", str(out)))
        assert "verified" in run(f"verify {out}")
        found.append(contents(out))
    assert [each[2:] for each in found[0]] == [each[2:] for each in found[1]] or "deidentify" in words
    assert (digests_of(tmp_path / "digest.mcap") > 0) == keeps


def test_a_merged_session_has_all_bytes(run: Run, tmp_path: Path, folder: Path) -> None:
    run("merge full.mcap digest.mcap -o OUT.mcap --offset digest=0")
    printed = run("verify OUT.mcap")
    assert printed.count("verified: all") == 2
    assert not digests_of(tmp_path / "out.mcap")


def test_diff_finds_no_difference(run: Run) -> None:
    run("diff full.mcap digest.mcap")


@table("to", ["csv", "nrrd", "ply", "rosbag2"])
def test_exports_are_those_of_all_bytes(run: Run, tmp_path: Path, to: str) -> None:
    made = []
    for name in ("full", "digest"):
        # nrrd refuses one of the messages
        run(f"export {name}.mcap --to {to} -o {tmp_path / name}", code=int(to == "nrrd"))
        files = sorted(path for path in (tmp_path / name).rglob("*") if path.is_file())
        made.append([path.read_bytes() for path in files if path.suffix not in (".mcap", ".yaml")])
        if to == "rosbag2":
            with AnyReader([tmp_path / name]) as bag:
                made[-1] = [bytes(data) for _, _, data in bag.messages()]
    assert made[0] == made[1] != []


def test_an_exported_file_has_all_topics_for_other_programs(run: Run, tmp_path: Path, log: list[Entry]) -> None:
    run("export digest.mcap --to mcap -o OUT.mcap")
    expected = Counter(entry.channel for entry in log if entry.kind in (Kind.ROS_IN, Kind.ROS_OUT))
    with AnyReader([tmp_path / "out.mcap"]) as bag:
        found = Counter(connection.topic for connection, _, _ in bag.messages())
        decoded = [bag.deserialize(data, each.msgtype) for each, _, data in bag.messages()]
    assert len(decoded) == found.total()
    assert {topic: found[topic] for topic in expected} == expected


def test_without_outputs_the_account_and_verify_count_them(run: Run, tmp_path: Path, log: list[Entry]) -> None:
    count = len(large(log, outputs=True))
    account = json.loads(run("export digest.mcap --to mcap --outputs none -o OUT.mcap --json"))
    assert sum(row["left_out"] for row in account["rows"]) == count
    for path in (str(tmp_path / "out.mcap"), "none.mcap"):
        assert json.loads(run(f"verify {path} --json"))["lost"] == count


def test_streams_of_an_export_leave_nothing_that_cannot_be_computed(run: Run, tmp_path: Path) -> None:
    run("export digest.mcap --to mcap --outputs digest --streams /igtl/in/Probe/* -o OUT.mcap")
    found = contents(tmp_path / "out.mcap")
    assert {each[3] for each in found if each[2] is Kind.ROS_OUT} == {"/igtl/in/Probe/image"}
    assert not digests_of(tmp_path / "out.mcap")


def test_outputs_of_another_format_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "a.mcap", "--to", "csv", "--outputs", "full", "-o", "out"]) == USAGE
    assert "--outputs: found --to csv, expected mcap" in capsys.readouterr().err


def test_info_has_the_same_figures(run: Run) -> None:
    full, digest = (json.loads(run(f"info {name}.mcap --json")) for name in ("full", "digest"))
    assert (full.pop("format_version"), digest.pop("format_version")) == (1, 2)
    for each in (full, digest):
        for name in ("file", "bytes"):
            del each[name]
        del each["session"]["format_version"]
    assert full == digest


def test_info_says_where_the_outputs_are(run: Run) -> None:
    line = "outputs   large ones are digests; for other programs: export --to mcap"
    assert line in run("info digest.mcap") and line not in run("info full.mcap")


def test_doctor_looks_at_the_same_messages(run: Run) -> None:
    full, digest = (json.loads(run(f"doctor {name}.mcap --json")) for name in ("full", "digest"))
    assert full | {"file": ""} == digest | {"file": ""}
