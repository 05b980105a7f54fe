"""The tool that draws flame graphs: the places where it is searched, and the error if it draws nothing."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from igtl_gateway_lab.bench import flame
from igtl_gateway_lab.bench.processes import BenchError, Program
from igtl_gateway_lab.programs import ours


def test_a_tool_that_draws_nothing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks, fake = tmp_path / "looks", tmp_path / "py-spy"
    fake.write_text(f"#!/bin/sh\ntrap 'exit 0' INT\n: > {looks}\nwhile :; do sleep 0.02; done\n", "ascii")
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert flame.tool() == str(fake)
    with Program("any", ours("--version")) as program, pytest.raises(BenchError, match="wrote no"):
        with flame.drawn(program, tmp_path / "out.svg"):
            rest, tries = threading.Event(), 1000
            while not looks.exists() and tries:
                tries -= 1
                rest.wait(0.01)
