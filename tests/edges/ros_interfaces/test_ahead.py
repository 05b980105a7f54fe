"""Packages that are compiled ahead: used with the ROS wheels that they fit to, and with no others."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from igtl_gateway.edges.ros_interfaces import ahead, cache
from igtl_gateway.edges.ros_interfaces.ahead import LIBRARIES, VERSIONS, compiled_ahead, ros_versions


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """An environment with two ROS wheels and, compiled ahead for them, tf2_msgs."""
    folder = compiled(tmp_path)
    (folder / "tf2_msgs").mkdir(parents=True)
    for name in ("ros_std_msgs-5.3.6", "ros_rclpy-7.1.5", "unrelated-1.0"):
        (packages(tmp_path) / f"{name}.dist-info").mkdir()
    (folder / VERSIONS).write_text(json.dumps(ros_versions(packages(tmp_path))), "utf-8")
    return tmp_path


def packages(prefix: Path) -> Path:
    return prefix / "lib" / "python3.11" / "site-packages"


def compiled(prefix: Path) -> Path:
    return packages(prefix) / "igtl_gateway" / "edges" / "ros_interfaces" / "compiled"


def used(prefix: Path, package: str = "tf2_msgs") -> bool:
    return compiled_ahead(package, packages(prefix), prefix, compiled(prefix)) == compiled(prefix) / package


def test_the_package_is_used_where_it_fits(prefix: Path) -> None:
    assert used(prefix)
    assert not used(prefix, "igtl_msgs"), "it is not there"


@pytest.mark.parametrize(
    ("before", "after", "fits"),
    [
        ("ros_std_msgs-5.3.6", "ros_std_msgs-5.3.7", True),
        ("ros_std_msgs-5.3.6", "ros_std_msgs-5.4.0", False),
        ("ros_rclpy-7.1.5", "ros_rclpy-8.1.5", False),
        ("ros_rclpy-7.1.5", "ros_other-1.0.0", True),
        ("unrelated-1.0", "unrelated-2.0", True),
    ],
)
def test_other_ros_wheels_fit_with_the_first_two_numbers(prefix: Path, before: str, after: str, fits: bool) -> None:
    (packages(prefix) / f"{before}.dist-info").rename(packages(prefix) / f"{after}.dist-info")
    assert used(prefix) is fits


def test_wheels_of_another_environment_do_not_fit(prefix: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    other = tmp_path_factory.mktemp("other")
    assert compiled_ahead("tf2_msgs", packages(prefix), other, compiled(prefix)) is None
    assert (compiled(prefix) / "tf2_msgs" / LIBRARIES).resolve() == prefix / "lib"


def test_it_goes_before_the_cache_and_before_the_compiler(prefix: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "wheels_folder", lambda _: packages(prefix))
    monkeypatch.setattr(cache, "prefix_of", lambda _: prefix)
    monkeypatch.setattr(ahead.compiled_ahead, "__defaults__", (compiled(prefix),))
    monkeypatch.setattr("shutil.which", lambda _: None)
    assert cache.package_path("tf2_msgs") == [str(compiled(prefix) / "tf2_msgs")]


def test_a_source_tree_has_none() -> None:
    assert not ahead.COMPILED.exists()
