"""``seal``, ``keys`` and ``verify --seal`` as a user has them: files, words and exit codes."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.cli import main
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.seal.keys import SigningKey, load_trusted
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
        (["seal", "keys", "rotate", "x"], "keys rotate: found 1 file, expected two files"),
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


#: Runs ``seal keys`` again and again, each run in a folder and a process of its own, and ends the run number N by
#: SIGKILL before its Nth line of these modules: so between all calls of the system that make a file.
_KILLS = """
import argparse, itertools, os, signal, sys
from pathlib import Path
from igtl_gateway.cli import seal_keys
from igtl_gateway.base.systems import files
from igtl_gateway.record.seal import keys
from igtl_gateway.record.sessionfile import whole_files, new_file

keys.SigningKey.generate().private_pem()  # loads the library
traced = {module.__file__ for module in (seal_keys, files, whole_files, new_file)}
folder, options = Path(sys.argv[1]), argparse.Namespace(action=sys.argv[3], files=[Path(word) for word in sys.argv[4:]])
for number in itertools.count(1, int(sys.argv[2])):
    (folder / str(number)).mkdir()
    process = os.fork()
    if not process:
        left = number

        def step(frame, event, _):
            global left
            if frame.f_code.co_filename not in traced:
                return None
            left -= event == "line"
            if not left:
                os.kill(os.getpid(), signal.SIGKILL)
            return step

        os.chdir(folder / str(number))
        sys.settrace(step)
        os._exit(seal_keys.run(options))
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if code != -signal.SIGKILL:
        sys.exit(code)
"""


@pytest.mark.parametrize(("action", "stride"), [("new", 1), ("rotate", 5)])
def test_a_kill_at_any_moment_leaves_nothing_or_what_the_next_run_completes(
    action: str, stride: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old, runs = tmp_path / "old", tmp_path / "runs"
    runs.mkdir()
    assert _run("seal", "keys", "new", old) == 0
    words = ["seal", "keys", action, *[str(old)] * (action == "rotate"), "key"]
    subprocess.run([sys.executable, "-c", _KILLS, str(runs), str(stride), *words[2:]], check=True, timeout=120)
    left = dict[str, int]()
    for folder in sorted(runs.iterdir(), key=lambda each: int(each.name)):
        monkeypatch.chdir(folder)
        before = sorted(each.name for each in folder.iterdir() if not each.name.startswith("."))
        key = Path("key").read_bytes() if "key" in before else b""
        capsys.readouterr()
        code = _run(*words)
        captured = capsys.readouterr()
        if before == ["key", "key.pub"]:
            assert code == 2 and "keys are not replaced" in captured.err
            assert "key" in {each.name for each in folder.iterdir()}
        else:
            assert code == 0, (folder.name, before, captured.err)
            assert before in ([], ["key"])
        if key:
            assert Path("key").read_bytes() == key
            assert code or ("key: private key" in captured.out and "kept" in captured.out)
        found = SigningKey.load(Path("key"))
        assert load_trusted([Path("key.pub")]) == {found.public}
        assert len(found.introductions) == (action == "rotate")
        assert Path("key").stat().st_mode & 0o777 == 0o600
        left[" ".join(before)] = left.get(" ".join(before), 0) + 1
    assert len(left) == 3 and sum(left.values()) > 20, left


def test_a_key_without_its_public_half_is_not_taken_for_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, key = tmp_path / "old", tmp_path / "key"
    assert _run("seal", "keys", "new", old) == 0 and _run("seal", "keys", "new", key) == 0
    (tmp_path / "key.pub").unlink()
    assert _run("seal", "keys", "rotate", old, key) == 2
    assert "keys are not replaced" in capsys.readouterr().err
    assert not (tmp_path / "key.pub").exists()


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
