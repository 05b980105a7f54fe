"""The ROS package igtl_gateway (``ros2/igtl_gateway_ros``): built with colcon, started, its launch files compared."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from configparser import ConfigParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

from igtl_gateway import __version__
from igtl_gateway.cli.verbs import VERBS
from tests.integration.bridge import ROOT

PACKAGE = ROOT / "ros2" / "igtl_gateway_ros"
#: What the bridge publishes, subscribes to or serves, without the packages of the Python distribution's own wheels.
MESSAGE_PACKAGES = {
    "diagnostic_msgs",
    "geometry_msgs",
    "igtl_msgs",
    "rosgraph_msgs",
    "sensor_msgs",
    "shape_msgs",
    "std_msgs",
    "std_srvs",
    "tf2_msgs",
    "visualization_msgs",
}


def run(*command: str | Path, environment: Mapping[str, str] | None = None, cwd: Path = ROOT) -> str:
    """Standard output of a command that must succeed."""
    done = subprocess.run(
        [*map(str, command)],
        cwd=cwd,
        env=dict(os.environ) | dict(environment or {}),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def executables() -> dict[str, str]:
    """Name → function of each executable in setup.cfg."""
    parser = ConfigParser()
    parser.read(PACKAGE / "setup.cfg", "utf-8")
    lines = parser["options.entry_points"]["console_scripts"].split("\n")
    return {name.strip(): function.strip() for name, _, function in (line.partition("=") for line in lines if line)}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The install folder of a workspace with a copy of the package."""
    workspace = tmp_path_factory.mktemp("workspace")
    shutil.copytree(PACKAGE, workspace / "src" / PACKAGE.name)
    command = [sys.executable, "-m", "colcon", "--log-base", "log", "build"]
    run(*command, environment={"COLCON_HOME": str(workspace / "home"), "COLCON_LOG_LEVEL": "error"}, cwd=workspace)
    return workspace / "install" / "igtl_gateway"


def test_colcon_installs_executables_shared_files_and_the_index(installed: Path) -> None:
    share = installed / "share" / "igtl_gateway"
    assert (installed / "share/ament_index/resource_index/packages/igtl_gateway").is_file()
    assert (share / "package.xml").is_file()
    found = {path.name for path in (installed / "lib" / "igtl_gateway").iterdir()}
    assert found == set(executables())


def test_an_executable_runs_its_verb_from_the_python_distribution(installed: Path, tmp_path: Path) -> None:
    bridge = installed / "lib" / "igtl_gateway" / "bridge"
    site = next((installed / "lib").glob("python*/site-packages"))
    path = {"PYTHONPATH": f"{site}{os.pathsep}{ROOT}"}
    assert run(bridge, "--help", environment=path).startswith("usage: igtl-gateway bridge")
    where = "import igtl_gateway, igtl_gateway_ros; print(igtl_gateway.__file__)"
    assert run(sys.executable, "-c", where, environment=path, cwd=tmp_path).startswith(str(ROOT / "igtl_gateway"))


def test_an_executable_names_the_missing_distribution(installed: Path, tmp_path: Path) -> None:
    site = next((installed / "lib").glob("python*/site-packages"))
    program = "import sys; from igtl_gateway_ros.verb import main; sys.argv[0] = 'bridge'; sys.exit(main())"
    command = [sys.executable, "-S", "-c", program]  # -S: without the environment's packages
    done = subprocess.run(
        command, cwd=tmp_path, env={"PYTHONPATH": str(site)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("igtl_gateway: found no Python distribution igtl-gateway for ")
    assert done.stderr.rstrip().endswith(f"install it: {sys.executable} -m pip install igtl-gateway")


def test_every_verb_is_an_executable() -> None:
    expected = dict.fromkeys(VERBS, "igtl_gateway_ros.verb:main") | {"test_node": "igtl_gateway_ros.tester:main"}
    assert executables() == expected


def test_the_manifest_has_version_licence_and_dependencies() -> None:
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert manifest.get("format") == "3"
    assert manifest.findtext("name") == "igtl_gateway"
    assert manifest.findtext("version") == __version__
    assert manifest.findtext("license") == "Apache-2.0"
    assert manifest.findtext("export/build_type") == "ament_python"
    needs = {need.text for need in manifest.iter("exec_depend")}
    assert needs >= MESSAGE_PACKAGES | {"rclpy", "launch", "launch_ros", "launch_xml"}
    parser = ConfigParser()
    parser.read(PACKAGE / "setup.cfg", "utf-8")
    assert parser["metadata"]["version"] == __version__
    assert parser["metadata"]["name"] != manifest.findtext("name")  # the Python distribution of that name is another
