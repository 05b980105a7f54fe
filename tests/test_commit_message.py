"""``tools/commit_message.py``: which messages pass, and what it reports about the others."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tools.commit_message import SCISSORS, SUBJECT_LENGTH, faults, history_faults, main

BODY = "\n\nA late joiner gets the latched message.\n"


@pytest.mark.parametrize(
    "message",
    [
        "Latched messages are re-sent" + BODY,
        "x" * SUBJECT_LENGTH + BODY,
        "\n# a comment of git's\nSubject\n# another" + BODY,
        "Merge branch 'main'",
        'Revert "Latched messages are re-sent"',
        "fixup! Latched messages are re-sent",
    ],
)
def test_what_passes(message: str) -> None:
    assert faults(message) == []


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("", "empty"),
        ("# only a comment\n", "empty"),
        ("x" * (SUBJECT_LENGTH + 1) + BODY, f"The subject has {SUBJECT_LENGTH + 1} characters"),
        ("Subject", "body is missing"),
        ("Subject\n\n# a comment is no body\n", "body is missing"),
        (f"Subject\n\n{SCISSORS}\n+a line of the diff\n", "body is missing"),
        ("Subject\nBody at once\n", "second line must be blank"),
    ],
)
def test_what_is_refused(message: str, fault: str) -> None:
    (found,) = faults(message)
    assert fault in found


def test_as_git_calls_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "COMMIT_EDITMSG"
    path.write_text("Subject" + BODY, "utf-8")
    assert main([str(path)]) == 0
    path.write_text("x" * 100, "utf-8")
    assert main([str(path)]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 2, "a line for each rule"


def test_the_commits_since_a_moment_are_checked_also_in_a_clone_with_a_part_of_them(tmp_path: Path) -> None:
    whole = tmp_path / "whole"

    def git(*words: str, day: int = 1) -> None:
        when = f"2026-01-0{day}T12:00:00Z"
        env = {"GIT_AUTHOR_DATE": when, "GIT_COMMITTER_DATE": when, "HOME": str(tmp_path), "PATH": os.environ["PATH"]}
        named = ["-c", "user.name=A", "-c", "user.email=a@b.c"]
        subprocess.run(["git", *named, *words], cwd=tmp_path, env=env, check=True, capture_output=True)

    assert history_faults(tmp_path) == [], "no repository"
    git("init", "-q", str(whole))
    for day, message in enumerate(("Before the rule", f"Good{BODY}", "Bad", f"Good again{BODY}"), start=1):
        git("-C", str(whole), "commit", "-q", "--allow-empty", "-m", message, day=day)
    for depth, count in ((3, 1), (1, 0)):
        git("clone", "-q", "--depth", str(depth), f"file://{whole}", str(tmp_path / f"part-{depth}"))
        found = history_faults(tmp_path / f"part-{depth}", "2026-01-02T00:00:00Z")
        assert [fault.partition(": ")[2][:7] for fault in found] == ["The bod"] * count
    assert len(history_faults(whole, "2026-01-01T00:00:00Z")) == 2
    assert len(history_faults(whole, "2026-01-02T00:00:00Z")) == 1
