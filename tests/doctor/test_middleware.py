"""Versions of the ROS middleware that lose messages, and those that are installed."""

from __future__ import annotations

from pathlib import Path

from igtl_gateway.doctor.middleware import Version, installed, losses_of, prefixes, versions_text
from tests.tables import table

RMW = "rmw_fastrtps_cpp"

#: Version, and the numbers of its losses.  Of Humble, Jazzy, Kilted; Lyrical; Rolling.
LOST: list[tuple[Version, list[int]]] = [
    ((6, 2, 10), []),
    ((8, 4, 3), []),
    ((9, 3, 3), []),
    ((9, 4, 5), []),
    ((9, 4, 6), [881, 898, 900]),
    ((9, 4, 8), [881, 898, 900]),
    ((9, 4, 9), [881]),
    ((9, 4, 10), [881]),
    ((9, 4, 11), []),
    ((9, 5, 0), [898, 900]),
    ((9, 5, 1), [898, 900]),
    ((9, 5, 2), []),
    ((9, 10, 0), []),
]


def manifest(folder: Path, text: str) -> Path:
    path = folder / "share" / RMW / "package.xml"
    path.parent.mkdir(parents=True)
    path.write_text(text)
    return folder


@table(("version", "numbers"), LOST)
def test_versions(version: Version, numbers: list[int]) -> None:
    assert [int(loss.source.partition("#")[2]) for loss in losses_of({RMW: version})] == numbers


def test_the_first_folder_with_the_package_counts(tmp_path: Path) -> None:
    sourced = manifest(tmp_path / "ros", "<package>\n<name>a</name><version>\n9.4.8 </version></package>")
    wheels = manifest(tmp_path / "wheels", "<package><version>8.4.3</version></package>")
    assert installed((tmp_path, sourced, wheels)) == {RMW: (9, 4, 8)}
    assert versions_text(installed((wheels, sourced))) == f"{RMW} 8.4.3"


@table("text", ["", "<version>9.4</version>", "<version>nine</version>", "\0\xff"])
def test_a_manifest_without_a_version(tmp_path: Path, text: str) -> None:
    assert installed((manifest(tmp_path / str(hash(text)), text),)) == {}


def test_folders_of_this_environment() -> None:
    found = prefixes({"AMENT_PREFIX_PATH": "/ros/a:/ros/b:"})
    assert found[:2] == (Path("/ros/a"), Path("/ros/b")) and len(found) == 3
