"""First imports and first starts: what is compiled, where it is found, and what cannot be compiled."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import sysconfig
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path

import pytest

from igtl_gateway.edges.ros_interfaces import cache
from igtl_gateway.edges.ros_interfaces.cache import LIBRARIES, VERSIONS, compiled_ahead, ros_versions

WHEELS = pytest.mark.skipif(
    find_spec("ros_wheels_bootstrapper") is None, reason="the packages are compiled for the ROS wheels only"
)
FIRST_IMPORT = """
import sys
from pathlib import Path
from igtl_gateway.edges.ros_interfaces import cache
cache.cache_folders = lambda: [Path(sys.argv[1])]
import tf2_msgs.msg
import rclpy.serialization
assert rclpy.serialization.serialize_message(tf2_msgs.msg.TFMessage())
print(tf2_msgs.msg.__file__)
"""


@pytest.mark.slow
@WHEELS
def test_two_first_imports_at_once_compile_once(tmp_path: Path) -> None:
    command = [sys.executable, "-c", FIRST_IMPORT, str(tmp_path)]
    both = [
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
        for _ in range(2)
    ]
    outputs = [process.communicate(timeout=100) for process in both]
    assert [process.returncode for process in both] == [0, 0], outputs
    (imported,) = {Path(out.strip()) for out, _ in outputs}
    assert imported.parent.parent.name == "tf2_msgs" and tmp_path in imported.parents
    assert sum(err.count("First start") for _, err in outputs) == 1
    assert {path.name for path in tmp_path.iterdir()} == {imported.parents[2].name}


@WHEELS
def test_a_package_in_any_of_the_folders_is_used(tmp_path: Path) -> None:
    preferred, other = tmp_path / "preferred", tmp_path / "other"
    place = other / cache._key("tf2_msgs", cache.wheels_folder("tf2_msgs")) / "tf2_msgs"
    place.mkdir(parents=True)
    assert cache.compiled("tf2_msgs", [preferred, other]) == place


def test_a_changed_definition_is_compiled_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    definition = tmp_path / "A.msg"
    monkeypatch.setattr(cache, "interface_files", lambda _: [definition])
    definition.write_text("int32 a\n")
    key = cache._key("p_msgs", tmp_path)
    assert cache._key("p_msgs", tmp_path) == key
    assert cache._key("p_msgs", tmp_path / "elsewhere") != key
    definition.write_text("int32 b\n")
    assert cache._key("p_msgs", tmp_path) != key


def test_another_version_of_ros_is_compiled_again(tmp_path: Path) -> None:
    installed = tmp_path / "ros_std_msgs-5.3.6.dist-info"
    installed.mkdir()
    key = cache._key("tf2_msgs", tmp_path)
    (tmp_path / "unrelated-1.0.dist-info").mkdir()
    assert cache._key("tf2_msgs", tmp_path) == key
    installed.rename(tmp_path / "ros_std_msgs-5.3.7.dist-info")
    assert cache._key("tf2_msgs", tmp_path) != key


@pytest.mark.parametrize(
    ("package", "missing", "outputs"),
    [
        ("igtl_msgs", ["ros_wheels_bootstrapper", "rclpy"], "igtl_msgs needs ROS 2: rclpy is not installed here"),
        ("igtl_msgs", ["ros_wheels_bootstrapper"], "ros2/igtl_msgs with colcon"),
        ("tf2_msgs", ["ros_wheels_bootstrapper"], "install ros-lyrical-tf2-msgs"),
    ],
    ids=["no ROS", "sourced ROS, ours", "sourced ROS, its own"],
)
def test_without_the_wheels(
    package: str, missing: list[str], outputs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DISTRO", "lyrical")
    monkeypatch.setattr(cache, "find_spec", lambda name: None if name in missing else ModuleSpec(name, None))
    with pytest.raises(ImportError) as error:
        cache.compiled(package, [tmp_path])
    assert outputs in str(error.value)
    assert error.value.name == package


@WHEELS
def test_without_a_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.setattr(sysconfig, "get_path", lambda *_, **__: str(tmp_path))
    with pytest.raises(ImportError, match=r"no gcc and g\+\+ and Python.h .* apt install g\+\+ python3\.\d+-dev"):
        cache.compiled("tf2_msgs", [tmp_path])


@WHEELS
def test_without_a_writable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ImportError) as error:
        cache.compiled("tf2_msgs", [tmp_path / "file" / "a", tmp_path / "file" / "b"])
    assert str(error.value) == (
        f"tf2_msgs must be compiled once: found {tmp_path}/file/a not writable (Not a directory), and "
        f"{tmp_path}/file/b not writable (Not a directory); expected a folder to write to with 25.0 MB free "
        "(XDG_CACHE_HOME=FOLDER names another)"
    )


def test_a_node_does_not_try_again_what_could_not_be_compiled(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line when it starts; each of its publishers would take a minute otherwise."""
    calls = []

    def fail(packages: list[str], _folders: object) -> Path:
        calls.append(packages)
        raise ImportError("the disk is full")

    monkeypatch.setattr(cache, "_FAILED", set())
    monkeypatch.setattr(cache, "missing_packages", lambda: ["igtl_msgs", "tf2_msgs"])
    monkeypatch.setattr(cache, "find", lambda *_: None)
    monkeypatch.setattr(cache, "_compile", fail)
    cache.make_ready()
    assert capsys.readouterr().err == "igtl-gateway: the disk is full; messages of these packages do not pass.\n"
    with pytest.raises(ImportError, match="tf2_msgs is not compiled, for the reason above"):
        cache.package_path("tf2_msgs")
    assert calls == [["igtl_msgs", "tf2_msgs"]]


def test_nothing_is_missing_without_the_wheels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "find_spec", lambda name: None)
    assert cache.missing_packages() == []


@WHEELS
def test_a_package_that_others_have_installed_is_not_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tf2_msgs").mkdir()
    (tmp_path / "tf2_msgs" / "__init__.py").touch()
    monkeypatch.setattr(cache, "cache_folders", lambda: [tmp_path / "empty"])
    monkeypatch.setattr(cache, "compiled_ahead", lambda *_: None)
    assert set(cache.missing_packages()) >= {"igtl_msgs", "tf2_msgs"}
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "tf2_msgs", raising=False)
    assert "tf2_msgs" not in cache.missing_packages()


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
    monkeypatch.setattr(cache.compiled_ahead, "__defaults__", (compiled(prefix),))
    monkeypatch.setattr("shutil.which", lambda _: None)
    assert cache.package_path("tf2_msgs") == [str(compiled(prefix) / "tf2_msgs")]


def test_a_source_tree_has_none() -> None:
    assert not cache.COMPILED.exists()
