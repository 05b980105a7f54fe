"""``tools/commit_message.py``: which messages pass, and what it reports about the others."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.commit_message import SCISSORS, SUBJECT_LENGTH, faults, main

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
