"""``python -m igtl_gateway.edges.ros_interfaces``."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from igtl_gateway.convert.interfaces import PACKAGES
from igtl_gateway.edges.ros_interfaces import __main__ as program


@pytest.fixture(autouse=True)
def _only_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use the packages of this checkout, even if an earlier test imported others."""
    monkeypatch.syspath_prepend(Path(program.__file__).parent / "python")
    for package in PACKAGES:
        monkeypatch.delitem(sys.modules, package, raising=False)
    monkeypatch.setattr(program, "compile_missing", lambda: None)


def test_each_package_is_printed_with_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed = tmp_path / "tf2_msgs" / "__init__.py"
    installed.parent.mkdir()
    installed.touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(program, "package_path", lambda package: [f"/compiled/{package}"])
    assert program.main() == 0
    printed = capsys.readouterr().out.splitlines()
    places = {package: f"/compiled/{package}" for package in PACKAGES}
    places["tf2_msgs"] = f"{installed.parent} (installed)"
    assert printed == [f"{package}: {places[package]}" for package in PACKAGES]


def test_stand_ins_of_an_installed_package_are_not_compiled_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the folder of a checkout, its module runs, and finds the stand-ins of the environment."""
    folder = tmp_path / "igtl_gateway" / "edges" / "ros_interfaces" / "python"
    for package in PACKAGES:
        (folder / package).mkdir(parents=True)
        (folder / package / "__init__.py").touch()
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(program, "package_path", lambda package: [f"/compiled/{package}"])
    assert program.main() == 0
    assert capsys.readouterr().out.splitlines() == [f"{package}: /compiled/{package}" for package in PACKAGES]


def test_a_package_that_cannot_be_compiled_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def package_path(package: str) -> list[str]:
        if package == "tf2_msgs":
            return ["/compiled/tf2_msgs"]
        raise ImportError(f"{package}: no compiler")

    monkeypatch.setattr(program, "package_path", package_path)
    assert program.main() == 1
    printed = capsys.readouterr()
    assert printed.out == "tf2_msgs: /compiled/tf2_msgs\n"
    others = ("igtl_msgs", "foxglove_msgs", "rosbag2_interfaces", "crtk_msgs")
    assert printed.err == "".join(f"{package}: no compiler\n" for package in others)


def test_what_imports_have_compiled_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [tmp_path / place / "igtl_gateway" / "ros_interfaces" for place in ("environment", "user")]
    (folders[0] / "key" / "igtl_msgs").mkdir(parents=True)
    (folders[0] / "igtl_msgs.lock").touch()
    monkeypatch.setattr(program, "cache_folders", lambda: folders)
    monkeypatch.setattr(sys, "argv", ["ros_interfaces", "--remove"])
    assert program.main() == 0
    assert capsys.readouterr().out == f"removed {folders[0]}\n"
    assert [*tmp_path.iterdir()] == [tmp_path / "environment"] and not [*(tmp_path / "environment").iterdir()]
