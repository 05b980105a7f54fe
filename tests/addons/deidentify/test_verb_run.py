"""The verb: options that are refused, the key of a file, and what it prints."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.deidentify import verb_run
from igtl_gateway.addons.deidentify.profile import BASIC
from igtl_gateway.addons.deidentify.pseudonyms import MIN_KEY_BYTES
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.quantities import counted
from tests.tables import table

MOST_S = 1 << 32


def options(folder: Path, **given: Any) -> argparse.Namespace:
    usual: dict[str, Any] = {
        "file": folder / "a.mcap", "output": folder / "b.mcap", "overwrite": False, "shift": None, "keep_times": False,
        "profile": None, "secret": None, "json": False,
    }  # fmt: skip
    return argparse.Namespace(**usual | given)


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the verb asks for; it gets an empty report."""
    found: dict[str, Any] = {}

    def deidentify(*words: Any, **more: Any) -> Report:
        found.update(words=words, **more)
        return Report()

    monkeypatch.setattr(verb_run, "deidentify", deidentify)
    return found


@table(
    ("shift", "words"),
    [
        (0, "--shift: found 0, expected another number, or --keep-times"),
        (MOST_S + 1, "--shift: found 4294967297, expected -4294967296 to 4294967296"),
        (-MOST_S - 1, "--shift: found -4294967297, expected"),
    ],
)
def test_a_shift_that_is_none_or_too_far(shift: int, words: str, tmp_path: Path, called: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        verb_run.run(options(tmp_path, shift=shift))
    assert words in str(caught.value) and not called


@table(
    ("given", "shift_ns"),
    [
        ({}, None),
        ({"keep_times": True}, 0),
        ({"shift": 1}, 1_000_000_000),
        ({"shift": -1}, -1_000_000_000),
        ({"shift": MOST_S}, MOST_S * 1_000_000_000),
        ({"shift": -MOST_S}, -MOST_S * 1_000_000_000),
    ],
)
def test_the_shift_is_in_seconds(
    given: dict[str, Any], shift_ns: int | None, tmp_path: Path, called: dict[str, Any]
) -> None:
    assert verb_run.run(options(tmp_path, **given)) == 0
    assert called["shift_ns"] == shift_ns and called["overwrite"] is False
    path, output, profile, key = called["words"]
    assert (path, output, profile, len(key)) == (tmp_path / "a.mcap", tmp_path / "b.mcap", BASIC, 32)


def test_the_recording_is_not_its_own_output(tmp_path: Path, called: dict[str, Any]) -> None:
    (tmp_path / "a.mcap").write_bytes(b"a recording")
    with pytest.raises(ConfigError, match="found the recording itself, expected another file to write to"):
        verb_run.run(options(tmp_path, output=tmp_path / "a.mcap", overwrite=True))
    assert not called


@pytest.mark.parametrize("size", [0, MIN_KEY_BYTES - 1, MIN_KEY_BYTES, MIN_KEY_BYTES + 1])
def test_the_key_of_a_file(size: int, tmp_path: Path, called: dict[str, Any]) -> None:
    (tmp_path / "key").write_bytes(bytes(range(size)))
    if size >= MIN_KEY_BYTES:
        assert verb_run.run(options(tmp_path, secret=tmp_path / "key")) == 0
        assert called["words"][3] == bytes(range(size))
        return
    with pytest.raises(ConfigError, match=f"found {counted(size, 'byte')}, expected at least {MIN_KEY_BYTES}"):
        verb_run.run(options(tmp_path, secret=tmp_path / "key"))


def test_without_a_key_each_run_has_its_own(tmp_path: Path, called: dict[str, Any]) -> None:
    keys = set()
    for _ in range(3):
        verb_run.run(options(tmp_path))
        keys.add(called["words"][3])
    assert len(keys) == 3


@pytest.mark.parametrize("as_json", [True, False])
def test_what_is_printed(
    as_json: bool, tmp_path: Path, called: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    verb_run.run(options(tmp_path, json=as_json))
    printed = capsys.readouterr().out
    if as_json:
        facts = json.loads(printed)
        assert facts["file"] == str(tmp_path / "b.mcap") and "rules" in facts
        return
    assert printed.splitlines()[0] == f"{tmp_path / 'b.mcap'}: 0 inputs, 0 outputs computed again; verified"
    assert "not covered: " in printed
