"""``cohort export``: programs of their own make the same set as this process."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addon import NS_PER_S, SystemClock
from igtl_gateway.addons.cohort.task import JobProgram
from igtl_gateway.addons.lerobot.appending import append_sessions
from igtl_gateway.addons.lerobot.export import export_sessions
from igtl_gateway.cli import main
from tests.addons.lerobot.sessions import write_session
from tests.addons.lerobot.test_assembling import bytes_of, messages, recipe_of


@pytest.mark.slow
def test_workers_give_the_bytes_of_this_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [write_session(tmp_path / f"{name}.mcap", messages(10.0 * at)) for at, name in enumerate("abc")]
    recipe = recipe_of(tmp_path, "v3.0")
    export_sessions(files, recipe, tmp_path / "one")
    words = ["cohort", "export", str(tmp_path), "--recipe", str(recipe), "--workers", "2"]
    assert main([*words, "-o", str(tmp_path / "two")]) == 0
    assert "two: LeRobot v3.0, 27 frames in 3 episodes of 3 sessions" in capsys.readouterr().out
    assert bytes_of(tmp_path / "one") == bytes_of(tmp_path / "two")


@pytest.mark.slow
@pytest.mark.long
def test_killed_workers_append_the_bytes_of_this_process(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of the first three programs that write is killed when there is a part of its part, or all of it."""
    (study := tmp_path / "study").mkdir()
    files = [write_session(study / f"{name}.mcap", messages(10.0 * at)) for at, name in enumerate("abcde")]
    recipe = recipe_of(tmp_path, "v3.0")
    export_sessions(files[:2], recipe, tmp_path / "one")
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    append_sessions(files[2:], None, tmp_path / "one")
    ask, killed, lock = JobProgram.ask, list[str](), threading.Lock()

    def killing(program: JobProgram, job: Mapping[str, Any], timeout_s: float) -> dict[str, Any] | None:
        inner, limit = job["settings"]["job"], SystemClock().monotonic_ns() + 60 * NS_PER_S
        with lock:
            is_chosen = inner["kind"] == "write" and len(killed) < 3
            killed.extend([inner["part"]] * is_chosen)
        if not is_chosen:
            return ask(program, job, timeout_s)
        part = Path(inner["part"])
        program._child.write(f"{json.dumps(job)}\n")
        while not (part.exists() or any(part.parent.glob(f"{part.name}-*/*/*"))):
            assert SystemClock().monotonic_ns() < limit
            time.sleep(0.001)
        program._child.kill()
        return None

    monkeypatch.setattr(JobProgram, "ask", killing)
    words = ["cohort", "export", *map(str, files[2:]), "--append", "--workers", "2", "-o", str(tmp_path / "two")]
    assert main(words) == 0 and len(killed) == 3
    assert "27 frames in 3 episodes were appended" in capsys.readouterr().out
    assert bytes_of(tmp_path / "one") == bytes_of(tmp_path / "two")


def test_what_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_session(tmp_path / "a.mcap", messages(0.0))
    words = ["cohort", "export", str(path), "-o", str(tmp_path / "set")]
    assert main(words) == 2 and "found no --recipe" in capsys.readouterr().err
    assert main(["cohort", "info", *words[2:], "--recipe", "r.toml"]) == 2
    assert "--recipe: found it with info, expected it with export" in capsys.readouterr().err
