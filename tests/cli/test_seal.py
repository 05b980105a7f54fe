"""``seal``, ``keys`` and ``verify --seal`` as a user has them: files, words and exit codes."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.cli import main
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from tests.places import ROOT
from tests.record import samples

SOURCE = ROOT / "fixtures" / "every-type.mcap"


def _run(*words: object) -> int:
    return main([str(word) for word in words])


def test_from_a_new_key_to_a_changed_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key, sealed = tmp_path / "key", tmp_path / "sealed.mcap"
    assert _run("seal", "keys", "new", key) == 0
    assert key.stat().st_mode & 0o777 == 0o600
    assert _run("seal", SOURCE, "--key", key, "-o", sealed) == 0
    assert _run("verify", sealed, "--seal", "--trusted", f"{key}.pub") == 0
    assert _run("verify", sealed) == 0
    capsys.readouterr()
    assert _run("info", sealed) == 0
    assert "sealed    by key " in capsys.readouterr().out
    data = bytearray(sealed.read_bytes())
    data[len(data) // 2] ^= 1
    sealed.write_bytes(data)
    assert _run("verify", sealed, "--seal") == 1
    out = capsys.readouterr().out
    assert "CHANGED" in out
    assert "chunk" in out
    assert _run("verify", sealed, "--seal", "--json") == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["state"], found["parts"][0]["first"]["what"]) == ("changed", "changed")
    sealed.write_bytes(data[:-100])
    assert _run("verify", SOURCE, "--seal") == 1
    assert "NOT SEALED" in capsys.readouterr().out


def test_marks_added_later_are_named_as_not_sealed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key, sealed = tmp_path / "key", tmp_path / "sealed.mcap"
    assert _run("seal", "keys", "new", key) == 0
    assert _run("seal", SOURCE, "--key", key, "-o", sealed) == 0
    assert _run("mark", sealed, "--at", 0, "--label", "later") == 0
    capsys.readouterr()
    assert _run("verify", sealed, "--seal") == 0
    line = f"{sealed}.marks.jsonl: NOT SEALED: no seal covers marks that were added later"
    assert line in capsys.readouterr().out.splitlines()
    assert _run("verify", sealed, "--seal", "--json") == 0
    assert json.loads(capsys.readouterr().out)["not_sealed"] == [f"{sealed}.marks.jsonl"]


def test_a_rotated_key_is_trusted_by_those_who_trust_the_old_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new, sealed = tmp_path / "old", tmp_path / "new", tmp_path / "sealed.mcap"
    assert _run("seal", "keys", "new", old) == 0
    assert _run("seal", "keys", "rotate", old, new) == 0
    assert _run("seal", SOURCE, "--key", new, "-o", sealed) == 0
    capsys.readouterr()
    assert _run("verify", sealed, "--seal", "--trusted", f"{old}.pub") == 0
    assert "as a trusted key introduces it" in capsys.readouterr().out
    assert _run("seal", "keys", "show", new, f"{new}.pub") == 0
    assert "introduced by 1 key" in capsys.readouterr().out
    assert _run("seal", "keys", "new", tmp_path / "third") == 0
    assert _run("verify", sealed, "--seal", "--trusted", tmp_path / "third.pub") == 1


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["verify", SOURCE, "--trusted", "x"], "--trusted: found no --seal"),
        (["verify", SOURCE, "--seal", "--all"], "--seal: found --config or --all"),
        (["seal", "keys", "rotate", "x"], "keys rotate: found 1 files, expected two files"),
        (["seal", "keys", "new", "x", "y"], "keys new: found 2 files"),
        (["seal", SOURCE, "--key", "none", "-o", "x"], "key none: No such file"),
        (["bridge", "--seal", "x"], "--seal: found no --record FILE"),
    ],
)
def test_wrong_words(words: list[object], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(*words) == 2
    assert expected in capsys.readouterr().err


def test_keys_are_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "key"
    path.write_text("precious")
    assert _run("seal", "keys", "new", path) == 2
    assert path.read_text() == "precious"
    assert "keys are not replaced" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["key"]


def test_of_a_pair_of_keys_there_are_both_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    public = tmp_path / "key.pub"
    public.write_text("precious")
    assert _run("seal", "keys", "new", tmp_path / "key") == 2
    assert [each.name for each in tmp_path.iterdir()] == ["key.pub"] and public.read_text() == "precious"
    public.unlink()
    written = 0

    def sync(handle: int) -> None:
        nonlocal written
        written += 1
        if written == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", sync)
    assert _run("seal", "keys", "new", tmp_path / "key") != 0
    assert written == 2 and not list(tmp_path.iterdir())
    assert _run("seal", "keys", "new", tmp_path / "key") == 0
    assert {each.name for each in tmp_path.iterdir()} == {"key", "key.pub"}


def test_a_split_recording_is_checked_with_its_side_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key, folder = tmp_path / "key", tmp_path / "out"
    assert _run("seal", "keys", "new", key) == 0
    recorder = Recorder(
        tmp_path / "out.mcap",
        samples.SESSION,
        qos_of=lambda _topic, _type: None,
        on_note=lambda _note: None,
        clock=ManualClock(),
        host=in_thread,
        options=RecordOptions(seal=key, split_bytes=1, chunk_bytes=100),
    )
    for number in range(1, 21):
        recorder(samples.ros(number))
    recorder.close({})
    capsys.readouterr()
    assert _run("verify", folder, "--seal") == 0
    assert "  metadata.yaml: follows from the sealed parts" in capsys.readouterr().out
    side = folder / "metadata.yaml"
    side.write_text(side.read_text("utf-8").replace("out_0.mcap", "out_9.mcap"), "utf-8")
    assert _run("verify", folder, "--seal") == 1
    out = capsys.readouterr().out
    assert "CHANGED" in out and "  metadata.yaml: relative_file_paths: differs from what the sealed parts state" in out
