"""The definitions of the packages, and igtl_msgs as a ROS 2 package for colcon."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from igtl_gateway.base.version import __version__
from igtl_gateway.base.versions import tomllib
from igtl_gateway.convert.interfaces import PACKAGES, SHARES, definition_folder, interface_files
from igtl_gateway.record.sessionfile.schemas import RosTypes
from tests.places import ROOT, needs_sources
from tests.tables import table

IGTL_MSGS = ROOT / "ros2" / "igtl_msgs"
#: Packages whose types may be used: the wheels and each ROS 2 installation have them.
STANDARD = {"builtin_interfaces", "geometry_msgs", "std_msgs"}


@needs_sources
def test_every_package_has_a_stand_in_and_definitions() -> None:
    stand_ins = ROOT / "igtl_gateway" / "edges" / "ros_interfaces" / "python"
    assert sorted(path.parent.name for path in stand_ins.glob("*/__init__.py")) == sorted(PACKAGES)
    for package in PACKAGES:
        assert interface_files(package)
    assert definition_folder("igtl_msgs") == IGTL_MSGS


@needs_sources
def test_the_wheel_contains_the_definitions_and_the_search_path() -> None:
    """The wheel installs the files of ros2/ in a folder of :data:`SHARES` and of Python's search path."""
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert ROOT / wheel["sources"]["ros2/igtl_msgs"] == SHARES[0] / "igtl_msgs"
    assert wheel["sources"]["ros2/site-packages"] == ""
    (path_file,) = (ROOT / "ros2" / "site-packages").iterdir()
    assert path_file.suffix == ".pth"
    assert path_file.read_text().strip() in wheel["dev-mode-dirs"]


@table("path", [path for package in PACKAGES for path in interface_files(package)], ids=str)
def test_ros_reads_the_definition(path: Path) -> None:
    parser = pytest.importorskip("rosidl_adapter.parser", reason="needs the generators of ROS 2")
    package = path.parents[1].name
    if path.suffix == ".msg":
        assert parser.parse_message_file(package, path).fields
    else:
        assert parser.parse_service_file(package, path).srv_name == path.stem  # a service may have no fields


@table(
    "name",
    [
        f"{package}/msg/{path.stem}"
        for package in PACKAGES
        for path in interface_files(package)
        if path.suffix == ".msg"
    ],
)
def test_a_recording_has_the_definition_without_ros(name: str) -> None:
    definition = RosTypes(SHARES).find(name)
    assert definition is not None
    assert definition.type_hash.startswith("RIHS01_")


def test_compressed_video_is_that_of_foxglove() -> None:
    """Names, types and order of the fields, which the type hash depends on, are those of public recordings."""
    (path,) = interface_files("foxglove_msgs")
    lines = [line.partition("#")[0].strip() for line in path.read_text().splitlines()]
    assert [line for line in lines if line] == [
        "builtin_interfaces/Time timestamp",
        "string frame_id",
        "uint8[] data",
        "string format",
    ]


@needs_sources
def test_cmake_lists_every_interface_once() -> None:
    listed = re.findall(r'^  "(.+)"$', (IGTL_MSGS / "CMakeLists.txt").read_text(), re.MULTILINE)
    assert listed == [path.relative_to(IGTL_MSGS).as_posix() for path in interface_files("igtl_msgs")]


def test_package_and_cmake_list_the_used_packages() -> None:
    used = set()
    for path in interface_files("igtl_msgs"):
        used |= set(re.findall(r"^(\w+)/\w+", path.read_text("utf-8"), re.MULTILINE))
    assert used == STANDARD
    package = ET.parse(IGTL_MSGS / "package.xml").getroot()
    assert {element.text for element in package.findall("depend")} == STANDARD
    cmake = (IGTL_MSGS / "CMakeLists.txt").read_text()
    assert STANDARD < set(re.findall(r"find_package\((\w+) REQUIRED\)", cmake))
    (dependencies,) = re.findall(r"^  DEPENDENCIES (.+)$", cmake, re.MULTILINE)
    assert set(dependencies.split()) == STANDARD


def test_package_xml_matches_the_project() -> None:
    package = ET.parse(IGTL_MSGS / "package.xml").getroot()
    assert package.get("format") == "3"
    assert package.findtext("name") == "igtl_msgs"
    assert package.findtext("version") == __version__
    assert package.findtext("license") == "Apache-2.0"
    assert package.findtext("member_of_group") == "rosidl_interface_packages"
