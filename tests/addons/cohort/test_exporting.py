"""``cohort export``: programs of their own make the same set as this process."""

from __future__ import annotations

from pathlib import Path

import pytest

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


def test_what_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_session(tmp_path / "a.mcap", messages(0.0))
    words = ["cohort", "export", str(path), "-o", str(tmp_path / "set")]
    assert main(words) == 2 and "found no --recipe" in capsys.readouterr().err
    assert main(["cohort", "info", *words[2:], "--recipe", "r.toml"]) == 2
    assert "--recipe: found it with info, expected it with export" in capsys.readouterr().err
