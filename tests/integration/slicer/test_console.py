"""The lines of slicer.md for the console of 3D Slicer, on its own nodes; its timer and its Qt are not in the wheel."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests import slicer
from tests.places import ROOT


def test_four_lines_show_age_and_date_of_each_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (ROOT / "docs" / "how-to" / "slicer.md").read_text("utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    assert len([line for line in code.splitlines() if line]) == 4
    scene = slicer.new_scene(tmp_path / "cache")
    stamped, other = (slicer.new_node(scene, "LinearTransform", name) for name in ("Tool", "Plain"))
    stamped.SetAttribute("OpenIGTLink.ros.stamp", "1700000000123456789")
    calls: list[tuple[str, Callable[[], Any]]] = []
    started: list[int] = []

    class Timer:
        def start(self, ms: int) -> None:
            started.append(ms)

        def connect(self, signal: str, call: Callable[[], Any]) -> bool:
            calls.append((signal, call))
            return True

    def nodes(name: str) -> list[Any]:
        return [scene.GetNthNodeByClass(number, name) for number in range(scene.GetNumberOfNodesByClass(name))]

    monkeypatch.setitem(sys.modules, "qt", SimpleNamespace(QTimer=Timer))
    exec(code, {"slicer": SimpleNamespace(util=SimpleNamespace(getNodesByClass=nodes))})
    assert started == [200]
    ((signal, call),) = calls
    assert signal == "timeout()"
    monkeypatch.setattr(time, "time", lambda: 1_700_000_000.5)
    call()
    assert stamped.GetAttribute("age") == f"0.377 s, {time.ctime(1_700_000_000)}"
    assert other.GetAttribute("age") is None
