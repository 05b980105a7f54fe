"""The command line as a user meets it: help, wrong use, files of the wrong kind."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from igtl_gateway.app.note_rate import Event
from igtl_gateway.cli import main, verbs
from igtl_gateway.cli.bridge_output import TextOutput
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway_lab.cli.simulate_run import scenario_facts
from tests.integration.hostile_files import bags, foreign, images
from tests.places import ROOT
from tests.tables import table

FIXTURE = ROOT / "fixtures" / "paper-types.mcap"


def outcome(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a call."""
    try:
        code = main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    told = capsys.readouterr()
    return code, told.out, told.err


def test_without_a_verb_there_is_help(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = outcome(capsys)
    assert code == 2
    assert out.startswith("usage: igtl-gateway [-h] [--version] [--help-all] VERB ...\n")


def listed(out: str) -> dict[str, list[str]]:
    """The groups of the help, with the names of their verbs."""
    found: dict[str, list[str]] = {}
    for line in out.partition("\noptions:")[0].splitlines():
        if line.endswith(":"):
            found[line[:-1]] = []
        elif found and line.startswith("  "):
            found[list(found)[-1]].append(line.split()[0])
    return found


def test_help_has_the_verbs_in_groups_with_a_line_each(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = outcome(capsys, "--help")
    assert code == 0 and max(map(len, out.splitlines())) <= 82
    found = listed(out)
    assert found["Start"] == ["demo", "simulate", "doctor"] and found["Run"] == ["bridge", "replay"]
    assert [*found] == ["Start", "Run", "Inspect", "Convert", "Keep", "Many", "Measure"]
    shown = [verb for group in found.values() for verb in group]
    code, out, _ = outcome(capsys, "--help-all")
    every = [verb for group in listed(out).values() for verb in group]
    assert code == 0 and sorted(every) == sorted(verbs.available())
    assert set(every) - set(shown) == {"completion", "zenoh-router", "keys", "lint", "retain", "upload"}


@table(
    ("old", "new"),
    [
        (["lint", str(FIXTURE)], ["doctor", str(FIXTURE)]),
        (["lint", "absent.mcap"], ["doctor", "absent.mcap"]),
        (["retain", "absent", "--retention", "1 d"], ["keep", "absent", "--retention", "1 d"]),
        (["upload", "absent", "--upload", "s3://bucket"], ["keep", "absent", "--upload", "s3://bucket"]),
        (["keys", "show", "absent.key"], ["seal", "keys", "show", "absent.key"]),
    ],
)
def test_old_spellings_work_and_name_the_new_ones(
    old: list[str], new: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = outcome(capsys, *new)
    expected = f"igtl-gateway {old[0]}: the new spelling is `igtl-gateway {' '.join(new[: 1 - len(old)])}`\n"
    assert outcome(capsys, *old) == (code, out, expected + err)


def test_a_recording_has_no_options_of_a_connection(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = outcome(capsys, "doctor", str(FIXTURE), "--ros")
    assert code == 2 and "--ros: found a recording or --host, expected a peer" in err


@table(
    ("words", "question"),
    [
        (["reply"], "did you mean 'replay'?"),
        (["record", "out.mcap"], "expected igtl-gateway bridge --record FILE"),
        (["play", "out.mcap"], "expected igtl-gateway replay FILE"),
        (["recrod", "out.mcap"], "did you mean 'bridge --record FILE'"),
        (["paly", "out.mcap"], "did you mean 'replay FILE'?"),
        (["key", "new"], "did you mean 'seal keys'?"),
        (["replay", "a.mcap", "--too", "igtl"], "arguments are required: --to; unrecognized arguments: --too"),
        (["seal", "a.mcap", "--kee", "a.key", "-o", "b.mcap"], "did you mean '--key'?"),
        (["convert", "a.bag"], "expected igtl-gateway import FILE"),
        (["bridge", "--recrd", "a.mcap"], "did you mean '--record'"),
        (["info", "a.mcap", "--jsn"], "did you mean '--json'?"),
    ],
)
def test_a_word_that_means_nothing_is_answered_with_the_near_one(
    words: list[str], question: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = outcome(capsys, *words)
    assert (code, out) == (2, "") and question in err


@table("verb", verbs.available())
def test_every_verb_has_help_with_examples(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = outcome(capsys, verb, "--help")
    assert code == 0
    assert "examples:" in out and f"igtl-gateway {verbs.available()[verb].now or verb}" in out


def test_an_unknown_verb_is_usage(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = outcome(capsys, "fly")
    assert code == 2
    assert "'fly'" in err


def bad_file(kind: str, folder: Path) -> Path:
    """A file that is not a valid recording."""
    path = folder / f"{kind}.mcap"
    data = FIXTURE.read_bytes()
    with FIXTURE.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary
    chunk = summary.chunk_indexes[0].chunk_start_offset + 1000
    contents = {
        "empty": b"",
        "text": b"this is a text\n" * 50,
        "foreign": b"\x89PNG\r\n\x1a\n" + bytes(500),
        "truncated": data[: len(data) // 2],
        "flipped": data[:chunk] + bytes(byte ^ 0xFF for byte in data[chunk : chunk + 100]) + data[chunk + 100 :],
        "short": data[:6],
    }
    if kind == "folder":
        path.mkdir()
    elif kind in contents:
        path.write_bytes(contents[kind])
    return path


BAD = ("missing", "empty", "folder", "text", "foreign", "truncated", "short")


@table(
    ("verb", "kind"),
    # damage in the middle is met while reading on, so a replay meets it behind its first peer: see test_replay
    [(verb, kind) for verb in ("info", "verify") for kind in (*BAD, "flipped")] + [("replay", kind) for kind in BAD],
)
def test_bad_files_end_in_one_clear_line(
    verb: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bad_file(kind, tmp_path)
    options = ("--to", "igtl", "--listen", "127.0.0.1:0") if verb == "replay" else ()
    code, _, err = outcome(capsys, verb, str(path), *options)
    assert code in (1, 2)
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    assert lines[0].startswith(f"igtl-gateway {verb}: ") and str(path) in lines[0]


def test_json_is_for_programs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    copy = tmp_path / "copy.mcap"
    shutil.copy(FIXTURE, copy)
    for verb, key in (("info", "streams"), ("verify", "good")):
        code, out, err = outcome(capsys, verb, str(copy), "--json")
        assert code == 0 and not err
        assert key in json.loads(out)


def test_info_tells_what_was_meant_for_links_that_were_gone(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "losses.mcap"
    links = {
        "0": {"dropped": {"STRING/A": 2}, "ignored": {"STRING/A": 3}},
        "7": {"dropped": {"STRING/B": 4}, "ignored": {}},
    }
    SessionWriter(path, scenario_facts("losses", Config())).close({"links": links})
    code, out, _ = outcome(capsys, "info", str(path))
    assert code == 0
    assert "no entries" in out and "1970" not in out
    losses = [line.split() for line in out.partition("losses\n")[2].partition("next\n")[0].splitlines()]
    assert [(line[0], "closed" in line[1:4], line[-1]) for line in losses] == [
        ("2", True, "closed"),
        ("3", True, "already"),
        ("4", False, "closed"),
    ]


@pytest.mark.parametrize("duration", ["0", "-1", "nan", "inf"])
def test_a_duration_that_never_ends_is_usage(duration: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = outcome(capsys, "bridge", "--no-ros", "--listen", ":0", "--duration", duration)
    assert code == 2
    assert "--duration" in err


@pytest.mark.slow
@pytest.mark.parametrize("how", [">&-", "2>&-", ">&- 2>&-", "| :"])
def test_closed_outputs_end_nothing_with_a_traceback(how: str, tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    command = f'"$0" -m igtl_gateway bridge --no-ros --listen :0 --duration 0.1 --record "$1" {how}'
    ended = subprocess.run(
        ["sh", "-c", command, sys.executable, str(path)], capture_output=True, text=True, check=False, timeout=60
    )
    assert "Traceback" not in ended.stderr and "Exception" not in ended.stderr
    assert main(("verify", str(path))) == 0, "the recording was closed"


@pytest.mark.parametrize("words", [("--version",), ("--help",), ("info", "--help"), ("bridge", "--help-all"), ()])
def test_versions_and_help_need_no_reader(words: tuple[str, ...]) -> None:
    """`igtl-gateway --version | head -1`: the reader has ended before the last line."""
    reader, writer = os.pipe()
    os.close(reader)
    ended = subprocess.run(
        [sys.executable, "-m", "igtl_gateway", *words],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=60,
    )
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (1, "")


def test_decode_says_nothing_of_a_reader_that_has_seen_enough(tmp_path: Path) -> None:
    path = tmp_path / "many.igtl"
    path.write_bytes((Path(__file__).parents[1] / "data" / "corpus" / "STRING_v1_s1.bin").read_bytes() * 5000)
    command = ["sh", "-c", '"$0" -m igtl_gateway decode "$1" | head -1', sys.executable, str(path)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert ended.stdout.count("\n") == 1
    assert ended.stderr == ""


def test_a_bridge_whose_recording_failed_ends_with_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    # 2,560 bytes: enough to begin a recording, not enough to close it
    command = 'ulimit -f 5; exec "$0" -m igtl_gateway bridge --no-ros --listen :0 --duration 0.1 --record "$1"'
    ended = subprocess.run(
        ["sh", "-c", command, sys.executable, str(path)],
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},  # Python would leave compiled modules that are cut off
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert ended.returncode == 1, ended.stderr
    assert "File too large" in ended.stdout
    assert "Traceback" not in ended.stderr


def test_a_peer_that_invents_names_does_not_flood_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = TextOutput(terminal=False)
    for index in range(5000):
        note = Note(Level.ERROR, "bad_crc", f"message refused: {index}", f"STRING/{index}")
        terminal.events([Event(0, Kind.NOTE, note, (1,))])
    assert capsys.readouterr().out.count("\n") <= 1001


def test_every_type_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = outcome(capsys, "bridge", "--types")
    assert code == 0
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert "TRANSFORM transform geometry_msgs/msg/TransformStamped" in lines
    assert "TDATA/QTDATA /tf tf2_msgs/msg/TFMessage" in lines
    assert "std_msgs/msg/String STRING CLIENTINFO" in lines
    assert "igtl_msgs/msg/TrackingData TDATA QTDATA" in lines


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--tf-out", "tool"], "--tf-out: found 'tool', expected FRAME"),
        (["--peer", "127.0.0.1=unknown"], "--peer: found '127.0.0.1=unknown', expected HOST:PORT=PROFILE"),
        (["--kinds", "Probe=colour"], "--kinds: found 'Probe=colour', expected DEVICE=KIND"),
        (["--video-codec", "h264", "--no-ros"], "--video-codec: found --no-ros or --relay, expected neither"),
    ],
)
def test_routes_that_cannot_be_are_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], reason: str
) -> None:
    code, _, err = outcome(capsys, "bridge", *arguments)
    assert code == 2 and reason in err and len(err.splitlines()) == 1


def test_a_name_that_no_file_can_have_is_usage(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = outcome(capsys, "info", "x" * 300)
    assert (code, out) == (2, "")
    assert err.endswith("File name too long\n") and err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["info", "verify", "lint", "recover", "slice", "diff", "export", "review"])
def test_limits_are_lowered_and_raised_for_each_verb(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fixture = str(ROOT / "fixtures" / "star.mcap")
    more = {
        "recover": ["-o", str(tmp_path / "out.mcap")],
        "slice": ["-o", str(tmp_path / "out.mcap"), "--end", "0.5"],
        "diff": [fixture],
        "export": ["--to", "csv", "-o", str(tmp_path / "out")],
    }.get(verb, [])
    code, _, err = outcome(capsys, verb, fixture, *more, "--limit", "memory=1000")
    assert code == 1
    assert "expected at most 1000 (--limit memory=1000)" in err
    code, _, err = outcome(capsys, verb, fixture, *more, "--limit", "memory=1099511627776", "--limit", "seconds=9999")
    assert "--limit" not in err and code in (0, 1)


@table("name", ["a.mha", "a.nrrd", "a.nii", "a.bag", "a.mcap", "a.db3"])
def test_limits_of_an_import(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / name
    contents: dict[str, Callable[[], bytes]] = {
        "a.mha": images.mha,
        "a.nrrd": images.nrrd,
        "a.nii": images.nifti,
        "a.bag": bags.bag1,
        "a.mcap": foreign.bag,
    }
    if name in contents:
        path.write_bytes(contents[name]())
    else:
        bags.database(path)
    command = ["import", str(path), "-o", str(tmp_path / "out.mcap"), "--overwrite"]
    code, _, err = outcome(capsys, *command, "--limit", "memory=8", "--limit", "free=8")
    assert code == 1
    assert "expected at most 8 (--limit" in err or "too big" in err
    code, _, err = outcome(capsys, *command, "--limit", "memory=1099511627776", "--limit", "count=1000000")
    assert (code, err) == (0, "")
