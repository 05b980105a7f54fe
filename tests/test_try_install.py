"""tools/try_install.py: installed, run, removed and upgraded by each installer; deploy/conda and ros2/rosdep.yaml."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from ruamel.yaml import YAML

from igtl_gateway.base.version import __version__
from igtl_gateway.base.versions import tomllib
from tests.places import ROOT
from tools import try_extras, try_install
from tools.try_install import RECORDING, WAYS, Way, faults_of

#: A commit of 0.1.0 that is upgraded: the last one of 24 November 2026.
OLDER = "29b3e99e"


def yaml(path: str) -> Any:
    return YAML(typ="safe").load((ROOT / path).read_text("utf-8"))


def names(needs: list[str]) -> set[str]:
    """The names of requirements, as Python distributions have them."""
    return {re.split(r"[^\w-]", need)[0].replace("_", "-") for need in needs}


def test_the_recipe_of_conda_has_what_the_project_has() -> None:
    recipe = yaml("deploy/conda/recipe.yaml")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert recipe["context"]["version"] == __version__
    assert f">={recipe['context']['python_min']}" == project["requires-python"]
    assert names(recipe["requirements"]["run"]) - {"python"} == names(project["dependencies"])
    lowest = {re.sub(r"[ ;].*", "", need).replace("-", "_") for need in project["dependencies"]}
    assert {need.replace(" ", "").replace("-", "_") for need in recipe["requirements"]["run"][1:]} == lowest
    (entry,) = recipe["build"]["python"]["entry_points"]
    assert entry == f"igtl-gateway = {project['scripts']['igtl-gateway']}"


def test_rosdep_has_a_key_of_each_package() -> None:
    manifests = (ElementTree.parse(path).getroot() for path in (ROOT / "ros2").glob("*/package.xml"))
    assert yaml("ros2/rosdep.yaml").keys() == {manifest.findtext("name") for manifest in manifests}


def test_what_fails_and_what_stays_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installer of one file, whose removal leaves it there."""
    monkeypatch.setattr(try_install, "CALLS", (f"-c 0 {RECORDING}", "-n 1 absent"))
    true, head, touch = (str(shutil.which(name)) for name in ("true", "head", "touch"))
    assert [*faults_of(Way((f"{touch} igtl.py work/igtl.csv x.lock",), head, (true,)), tmp_path)] == [
        f"{head} -n 1 absent: exit code 1 [\"{head}: cannot open 'absent' for reading: No such file or directory\"]",
        "igtl.py stays",
    ]
    (text,) = faults_of(Way((f"{head} absent",), true, ()), tmp_path)
    assert "exit code 1" in text


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheels")
    try_extras.build(folder)
    return folder


@pytest.mark.parametrize("way", WAYS)
def test_each_installer(way: str, wheels: Path) -> None:
    if not Path(sys.executable).with_name("uv").exists() and way != "pip":
        pytest.skip("no uv here")
    assert try_install.main([str(wheels), "--ways", way]) == 0


def test_an_upgrade(wheels: Path) -> None:
    known = subprocess.run(["git", "cat-file", "-e", f"{OLDER}^{{commit}}"], cwd=ROOT, capture_output=True, check=False)
    if known.returncode:
        pytest.skip(f"no commit {OLDER} here")
    assert try_install.main([str(wheels), "--ways", "", "--older", OLDER]) == 0
