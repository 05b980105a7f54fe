"""The ROS package igtl_gateway (``ros2/igtl_gateway_ros``): built with colcon, started, its launch files compared."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from configparser import ConfigParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from ruamel.yaml import YAML

from igtl_gateway.base.addons import ADDONS
from igtl_gateway.base.version import __version__
from igtl_gateway.cli import complete
from igtl_gateway.cli.options import DEFAULT_HOST, DEFAULT_PORT
from igtl_gateway.cli.verbs import VERBS, own_verb
from igtl_gateway.config.settings import parameters
from tests.integration.bridge import START_S, Program, RawPeer, RosClient, environment, string
from tests.launch_commands import commands
from tests.launch_files import LaunchFile, every, read
from tests.places import ROOT

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


@pytest.mark.slow
def test_colcon_installs_executables_shared_files_and_the_index(installed: Path) -> None:
    share = installed / "share" / "igtl_gateway"
    assert (installed / "share/ament_index/resource_index/packages/igtl_gateway").is_file()
    assert (share / "package.xml").is_file()
    for folder in ("launch", "config"):
        names = {path.name for path in (PACKAGE / folder).iterdir() if path.is_file()}
        assert {path.name for path in (share / folder).iterdir()} == names
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
    own = [*VERBS, *(verb for verbs in ADDONS.values() for verb in verbs)]
    expected = dict.fromkeys(own, "igtl_gateway_ros.verb:main") | {"test_node": "igtl_gateway_ros.tester:main"}
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


LAUNCH = PACKAGE / "launch"
BOTH = ("bridge", "recorded_test", "replay", "two_bridges")
PYTHON_ONLY = "managed_bridge"
NAMES = (*BOTH, PYTHON_ONLY)
FILES = {name: read(LAUNCH / f"{name}.launch.{'xml' if name in BOTH else 'py'}") for name in NAMES}


def test_every_launch_file_but_one_has_both_notations() -> None:
    names = {path.name for path in LAUNCH.iterdir() if path.is_file()}
    assert names == {f"{name}.launch.{kind}" for name in BOTH for kind in ("py", "xml")} | {f"{PYTHON_ONLY}.launch.py"}


@pytest.mark.parametrize("name", BOTH)
def test_python_and_xml_declare_and_start_the_same(name: str) -> None:
    assert read(LAUNCH / f"{name}.launch.py") == FILES[name]


def test_two_bridges_do_not_share_tf() -> None:
    groups = every(FILES["two_bridges"].actions, "group")
    remaps = [("set_remap", {"from": f"/{name}", "to": name}) for name in ("tf", "tf_static")]
    assert [group["actions"][:2] for group in groups] == [remaps, remaps]
    assert [len(every(group["actions"], "include")) for group in groups] == [1, 1]


@pytest.mark.parametrize("name", NAMES)
def test_every_argument_is_described_and_used(name: str) -> None:
    file = FILES[name]
    used = set(re.findall(r"\$\(var (\w+)\)", str(file.actions)))
    assert used == file.arguments.keys()
    for default, text in file.arguments.values():
        assert len(text) > 10
        assert not text.endswith(".")
        assert default is None or default == default.strip()


@pytest.mark.parametrize("name", NAMES)
def test_an_include_gives_arguments_of_the_other_file(name: str) -> None:
    for include in every(FILES[name].actions, "include"):
        assert include["arguments"].keys() <= FILES[include["file"].removeprefix("$(dirname)/")].arguments.keys()


@pytest.mark.parametrize("name", NAMES)
def test_every_node_is_an_executable_with_options_that_it_has(name: str) -> None:
    for node in every(FILES[name].actions, "node"):
        assert node["pkg"] == "igtl_gateway"
        assert node["exec"] in executables()
        if verb := own_verb(node["exec"]):
            parser = argparse.ArgumentParser(exit_on_error=False)
            complete(parser, verb)
            parser.parse_args(with_defaults(FILES[name], node.get("args", "")).split())


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_of_a_bridge_is_a_setting(name: str) -> None:
    known = parameters()
    for each in every(FILES[name].actions, "set_parameter"):
        if each["name"] == "use_sim_time":
            continue
        argument = f"$(var {each['name']})"
        assert each["value"] == (f"'[\"{argument}\"]'" if known[each["name"]].is_list else argument)
        assert each["if"] == f"given {each['name']}"


def test_the_example_of_parameters_has_settings_with_their_defaults() -> None:
    text = (PACKAGE / "config" / "bridge.yaml").read_text("utf-8")
    known = parameters()
    (nodes,) = YAML(typ="safe", pure=True).load(text).items()
    assert nodes[0] == "/**"
    values = nodes[1]["ros__parameters"]
    assert len(values) > 10
    for name, value in values.items():
        default = (f"{DEFAULT_HOST}:{DEFAULT_PORT}",) if name == "listen" else known[name].default
        assert known[name].check(value) == default
    commented = re.findall(r"^    # (\w+): (.*?)(?: +#.*)?$", text, re.MULTILINE)
    assert len(commented) > 5
    for name, value in commented:
        known[name].check(YAML(typ="safe", pure=True).load(value))
    units = {name: unit for name, unit in re.findall(r"^    (\w+): \S+ +# (\w+)(?:;.*)?$", text, re.MULTILINE)}
    assert {name: known[name].unit for name in units} == units


def test_a_launch_file_configures_and_activates_a_bridge_once() -> None:
    """Once: a bridge that an operator deactivates also becomes inactive, and must stay so."""
    actions = FILES[PYTHON_ONLY].actions
    (bridge,) = (node for node in every(actions, "node") if node["exec"] == "bridge")
    assert bridge["managed"] and bridge["args"] == "--no-autostart"
    assert actions[-1] == ("change_state", {"node": ("node", bridge), "transition": 1})
    configured, active = (each for kind, each in actions if kind == "on_transition")
    assert (configured["from"], configured["to"]) == ("configuring", "inactive")
    assert configured["actions"] == [("change_state", {"node": ("node", bridge), "transition": 3})]
    assert (active["from"], active["to"], active["once"]) == ("activating", "active", True)
    assert [node["exec"] for node in every(active["actions"], "node")] == ["test_node"]


@pytest.mark.slow
@pytest.mark.ros
def test_the_nodes_run_as_launch_starts_them(installed: Path, tmp_path: Path) -> None:
    session, file = tmp_path / "session.mcap", tmp_path / "or1.yaml"
    file.write_text('/**:\n  ros__parameters:\n    deny_in: ["SENSOR"]\n    record: refused\n', "utf-8")
    given = {"namespace": "or1", "listen": "127.0.0.1:0", "record": str(session), "params_file": str(file)}
    given |= {"rate": "20.0"}
    remaps = {"igtl/in/Raw/string": "/said"}
    lines = commands(LAUNCH / "recorded_test.launch.xml", given, remaps)
    assert commands(LAUNCH / "recorded_test.launch.py", given, remaps) == lines
    site = next((installed / "lib").glob("python*/site-packages"))
    env = environment(PYTHONPATH=f"{site}{os.pathsep}{ROOT}")
    bridge, node = (Program([str(installed / "lib" / "igtl_gateway" / name), *words], env) for name, *words in lines)
    room = RosClient("room", subscribe={"/said": "std_msgs/msg/String"})

    def asked(service: str, kind: str, fields: dict[str, object]) -> dict[str, Any]:
        name = f"/or1/igtl_gateway/{service}"
        room.call(name, f"lifecycle_msgs/srv/{kind}", fields)
        answer: dict[str, Any] = room.receive(name)
        return answer

    def changed(transition: str) -> str:
        """The state after a transition."""
        assert asked("change_state", "ChangeState", {"transition": {"label": transition}}) == {"success": True}
        return str(asked("get_state", "GetState", {})["current_state"]["label"])

    def shows(text: str) -> None:
        bridge.wait_until(lambda: any(text in line for line in bridge.lines), text, START_S)

    try:
        shows("Press Ctrl-C to stop.")
        shows("node /or1/igtl_gateway")
        shows("denied       from peers: SENSOR")
        (port,) = re.findall(r"server on 127\.0\.0\.1:(\d+)", bridge.said())
        with RawPeer(int(port)) as peer:
            assert peer.receive("NodeTransform").type == "TRANSFORM"
            assert peer.receive("NodeString").body.endswith("of the node: Grüße".encode())
            peer.send(string("before"))
            assert room.receive("/said")["data"] == "before"
            assert changed("deactivate") == "inactive"
            peer.send(string("refused"))
            shows("STRING/Raw is refused: the gateway is not active")
            assert changed("activate") == "active"
            peer.send(string("after"))
            assert room.receive("/said")["data"] == "after"
        assert node.end().code == 0
        assert bridge.end().code == 0
    finally:
        for program in (room, node, bridge):
            program.close()
    assert run(installed / "lib" / "igtl_gateway" / "verify", session, environment=env).endswith("byte for byte\n")


def with_defaults(file: LaunchFile, text: str) -> str:
    """A string of a launch file for the defaults of its arguments; one without a default is its name."""
    return re.sub(r"\$\(var (\w+)\)", lambda match: file.arguments[match[1]][0] or match[1], text)
