"""The wheels: the gateway's has nothing of the laboratory, and the laboratory's adds its verbs."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from igtl_gateway.base.version import __version__
from igtl_gateway.base.versions import tomllib
from igtl_gateway.cli.verbs import GROUP, LABORATORY, Verb
from igtl_gateway_lab import __version__ as lab_version
from tests.places import ROOT
from tools import core

#: The Python of this test run, which imports all modules anyway.
OWN = f"python{sys.version_info[0]}.{sys.version_info[1]}"


def configuration(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))


def test_the_wheel_of_the_gateway_has_no_file_of_the_laboratory() -> None:
    build = configuration(ROOT)["tool"]["hatch"]["build"]["targets"]
    assert build["wheel"]["only-include"] == ["igtl_gateway", "ros2/igtl_msgs", "ros2/site-packages"]
    assert all(source.startswith("ros2/") for source in build["wheel"]["sources"])
    assert "force-include" not in build["wheel"]
    for verb in LABORATORY:
        assert not (ROOT / "igtl_gateway" / verb).exists()
        assert not (ROOT / "igtl_gateway" / "cli" / f"{verb}.py").exists()


def test_the_gateway_needs_its_laboratory_only_for_an_extra() -> None:
    project = configuration(ROOT)["project"]
    assert not any("lab" in need for need in project["dependencies"])
    assert project["optional-dependencies"]["lab"] == ["igtl-gateway-lab"]


def test_the_laboratory_adds_its_verbs_and_needs_the_gateway() -> None:
    project = configuration(ROOT / "lab")["project"]
    entries = project["entry-points"][GROUP]
    assert tuple(entries) == LABORATORY
    assert all(isinstance(EntryPoint(name, value, GROUP).load(), Verb) for name, value in entries.items())
    assert "igtl-gateway" in project["dependencies"]
    assert lab_version == __version__


def test_the_core_runs_on_every_python_with_requirements_of_the_project() -> None:
    extras = configuration(ROOT)["project"]["optional-dependencies"]
    needs = core.requirements(ros=True)
    assert core.TEST_NEEDS <= {Requirement(need).name for need in extras["dev"]}
    assert core.TEST_NEEDS <= {Requirement(need).name for need in needs}
    assert {*extras["ros"], *configuration(ROOT)["project"]["dependencies"]} <= {*needs}
    assert all((ROOT / folder).is_dir() for folder in (*core.TESTS, *core.ROS_TESTS))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in core.NAMES if name != OWN])
def test_every_module_compiles_without_a_warning(name: str) -> None:
    python = core.present(name)
    if python is None:
        pytest.skip(f"no {name} here")
    program = (
        "import pathlib, sys\n"
        "for path in map(pathlib.Path, sys.argv[1:]):\n"
        "    for module in path.rglob('*.py'):\n"
        "        compile(module.read_bytes(), str(module), 'exec', dont_inherit=True)\n"
    )
    folders = [ROOT / "igtl_gateway", ROOT / "lab" / "igtl_gateway_lab", ROOT / "ros2" / "igtl_gateway_ros"]
    command = [python, "-S", "-W", "error", "-c", program, *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
