"""docs/how-to/resim.md: what it names is there, and its recipe is one."""

from __future__ import annotations

import argparse
import re
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from igtl_gateway import cli
from igtl_gateway.addons.resim import verb
from igtl_gateway.addons.resim.recipe import read_recipe
from tests.addons.resim.runs import PROGRAMS
from tests.places import ROOT

PAGE = (ROOT / "docs" / "how-to" / "resim.md").read_text("utf-8")


def test_the_checked_programs_are_there() -> None:
    table = PAGE[PAGE.index("## Checked") :]
    programs = re.findall(r"`(\w+\.(?:py|c))`", table)
    tests = re.findall(r"\| `(\w+)` \|", table)
    assert len(programs) > 8 and len(tests) > 8
    assert [name for name in programs if not (PROGRAMS / name).is_file()] == []
    files = list(PROGRAMS.parent.glob("test_*.py"))
    found = "".join(f"{file.name}\n{file.read_text('utf-8')}" for file in files)
    assert [name for name in tests if not re.search(rf"\btest_{name}", found)] == []


@pytest.mark.ros
@pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")
def test_the_output_is_real(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (block,) = re.findall(r"^```console\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    command, _, shown = block.partition("\n")
    monkeypatch.chdir(ROOT / "examples" / "resim")
    words = [sys.executable if word == "python" else word for word in command.split()]
    assert words[:2] == ["$", "igtl-gateway"] and cli.main(words[2:]) == 0
    seconds = re.compile(r"in [\d.]+ m?s$", re.MULTILINE)
    assert seconds.sub("", capsys.readouterr().out) == seconds.sub("", shown)


def test_the_options_exist() -> None:
    parser = argparse.ArgumentParser()
    verb.add_arguments(parser)
    named = set(re.findall(r"`(--[a-z-]+)", PAGE))
    assert len(named) > 8
    assert named <= set(re.findall(r"--[a-z-]+", parser.format_help()))


def test_the_recipe(tmp_path: Path) -> None:
    (text,) = re.findall(r"^```toml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    (tmp_path / "nodes").mkdir()
    path = tmp_path / "programs.toml"
    path.write_text(text, "utf-8")
    (program,) = read_recipe(path).programs
    assert program.name == "planner" and program.env == {"SEED": "1"} and program.folder == tmp_path / "nodes"
