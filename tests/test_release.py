"""``tools/release.py``: two builds have the same bytes, and what the files of a release contain."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest

from hatch_build import SOURCES, compiled
from igtl_gateway.base.version import __version__
from igtl_gateway.base.versions import tomllib
from tests.places import ROOT
from tools import hashes
from tools import release as module
from tools.constraints import EXTRAS, HEADER, pins_of
from tools.release import SUMS, ReleaseError, release, sha256
from tools.sbom import NAME

#: A packager runs the tests with the recordings; one of these files more, and the sdist is too large to fetch.
LARGEST_SDIST = 22_000_000
PURE = "-py3-none-any.whl"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The release of this tree, with its changes, without compiled wheels: both builds were equal."""
    if not (ROOT / ".git").exists():
        pytest.skip("no git repository here: a release is a commit")
    out = tmp_path_factory.mktemp("release") / "dist"
    run = [sys.executable, "-m", "tools.release", "--out", str(out), "--pure", "--uncommitted"]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


def names(folder: Path, pattern: str) -> set[str]:
    """The files in the archive, relative to its first folder for an sdist."""
    (path,) = folder.glob(pattern)
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as wheel:
            return set(wheel.namelist())
    with tarfile.open(path) as sdist:
        return {name.partition("/")[2] for name in sdist.getnames()}


def metadata(folder: Path, pattern: str) -> Message:
    (path,) = folder.glob(pattern)
    with zipfile.ZipFile(path) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
        return Parser().parsestr(wheel.read(name).decode())


@pytest.mark.ros
def test_the_sums_are_those_of_all_files(folder: Path) -> None:
    lines = [line.split("  ") for line in (folder / SUMS).read_text("utf-8").splitlines()]
    found = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for _, name in lines}
    assert found == {name: digest for digest, name in lines}
    assert {path.name for path in folder.iterdir()} == {
        SUMS,
        f"{NAME}-{__version__}.cdx.json",
        *(f"{name}-{__version__}{end}" for name in ("igtl_gateway", "igtl_gateway_lab") for end in (".tar.gz", PURE)),
    }


@pytest.mark.ros
def test_the_wheels_have_the_package_and_nothing_of_this_machine(folder: Path) -> None:
    wheel = names(folder, f"igtl_gateway-*{PURE}")
    assert {"igtl_gateway/cli/bridge.py", "igtl_gateway/py.typed", "igtl_gateway_ros_interfaces.pth"} <= wheel
    assert "igtl_gateway/convert/interfaces/igtl_msgs/msg/RawMessage.msg" in wheel
    assert {name.partition("/")[0] for name in wheel} == {
        "igtl_gateway",
        "igtl_gateway_ros_interfaces.pth",
        f"igtl_gateway-{__version__}.dist-info",
    }
    both = wheel | names(folder, f"igtl_gateway_lab-*{PURE}")
    assert [name for name in both if name.endswith((".so", ".pyc"))] == []
    assert metadata(folder, f"igtl_gateway-*{PURE}")["Requires-Python"] == ">=3.10"


@pytest.mark.ros
def test_the_sdist_is_what_its_own_tests_need(folder: Path) -> None:
    sdist = names(folder, "igtl_gateway-*.tar.gz")
    assert {"Makefile", "constraints.txt", "tests/conftest.py", "fixtures/star.mcap", "lab/pyproject.toml"} <= sdist
    assert {str(source) for source in SOURCES} <= sdist
    assert [name for name in sdist if name.endswith((".so", ".pyc"))] == []
    (path,) = folder.glob("igtl_gateway-*.tar.gz")
    assert path.stat().st_size < LARGEST_SDIST


def test_pins_and_sbom_are_of_all_extras() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"].keys()
    assert {*EXTRAS.split(","), "lab", "dev"} == extras
    text = (ROOT / "constraints.txt").read_text("utf-8")
    assert text.startswith(HEADER)
    for path in ("tools/setup.sh", "CONTRIBUTING.md", ".github/workflows/ci.yml"):
        assert f"{EXTRAS.removeprefix('ros,')},lab,dev" in (ROOT / path).read_text("utf-8"), path


def test_each_pin_of_users_has_hashes_and_no_address() -> None:
    text, pinned = hashes.HASHES.read_text("utf-8"), hashes.pins()
    wanted = hashes.needed(pinned)
    older = hashes.needed_by_the_oldest(hashes.older_pins(), pinned)
    assert "numpy" in wanted and "numpy" in older and hashes.faults(text, pinned, wanted, older) == []
    one = f"numpy=={pinned['numpy']} ; python_full_version >= '3.11' \\\n"
    first = text[text.index(one) + len(one) :].partition("\n")[0] + "\n"
    for changed, fault in (
        (text.replace(one, "numpy==1.0 \\\n"), "numpy: found 1.0, expected"),
        (text.replace(one, "numpi==1.0 \\\n"), "numpi: found 1.0, expected None"),
        (text.replace(one + first, one + first.replace("sha256:", "md5:")), "numpy: found no hashes"),
        (text.replace(f"numpy=={older['numpy']} ", "numpy==1.0 "), f"numpy: found no hashes of {older['numpy']}"),
        (text + "--index-url https://example.org/simple\n", "found '--index-url"),
    ):
        assert [line for line in hashes.faults(changed, pinned, wanted, older) if line.startswith(fault)], fault


@pytest.mark.ros
def test_the_sbom_has_the_files_and_all_that_users_install(folder: Path) -> None:
    (path,) = folder.glob("*.cdx.json")
    bom = json.loads(path.read_text("utf-8"))
    main = bom["metadata"]["component"]
    files = {file["name"]: file["hashes"][0]["content"] for file in main["components"]}
    assert files == {path.name: sha256(path) for path in folder.iterdir() if path.suffix in {".gz", ".whl"}}
    versions = {component["name"]: component["version"] for component in bom["components"]}
    assert {"numpy", "mcap", "ros-jazzy-rclpy", "rerun-sdk", "pyarrow", "pandas", "matplotlib", "av"} <= versions.keys()
    assert versions.items() <= pins_of((ROOT / "constraints.txt").read_text("utf-8")).items()
    needs = {row["ref"]: row.get("dependsOn", []) for row in bom["dependencies"]}
    reached, waiting = set(), [main["bom-ref"]]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += needs[name]
    assert reached == {main["bom-ref"], *(component["bom-ref"] for component in bom["components"])}
    without = {component["name"] for component in bom["components"] if "licenses" not in component}
    # The first have only requirements, the others no licence in their metadata.
    assert {name for name in without if not name.startswith("ros-jazzy-")} <= {"ros-fastcdr", "ros-fastrtps"}


def test_the_folder_of_a_build_leaves_no_trace(tmp_path: Path) -> None:
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        pytest.skip("no Python headers here")
    source = Path("igtl_gateway/native/_queue.c")
    results = []
    for name in ("one", "a second folder"):
        root = tmp_path / name / "source"
        for path in (source, source.parent / "kernel" / "_queue.h"):
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).write_bytes((ROOT / path).read_bytes())
        target = compiled(root, source, tmp_path / name / "out")
        assert target is not None
        results.append(target.read_bytes())
        assert list(root.rglob("*.so")) == []
    assert results[0] == results[1]


def test_two_builds_that_differ_are_no_release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def distributions(build: module.Build) -> list[Path]:
        for name in ("equal", "different"):
            (build.work / name).write_text(build.conditions.zone if name == "different" else "")
        return [build.work / "different", build.work / "equal"]

    monkeypatch.setattr(module, "_git", lambda *_: "0")
    monkeypatch.setattr(module.Build, "distributions", distributions)
    with pytest.raises(ReleaseError, match=r"two builds differ in different$"):
        release(tmp_path / "dist", "HEAD", ())
    assert not (tmp_path / "dist").exists()


def test_the_tag_of_another_version_is_no_release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_git", lambda *_: "v0.0.9 reviewed")
    with pytest.raises(ReleaseError, match=f"found the tag v0.0.9, expected v{__version__}"):
        release(tmp_path / "dist", "HEAD", ())


def test_a_release_overwrites_nothing(tmp_path: Path) -> None:
    (tmp_path / "old").touch()
    with pytest.raises(ReleaseError, match="found files, expected an empty folder"):
        release(tmp_path, "HEAD", ())


def test_only_compiled_wheels_of_this_version_are_added(tmp_path: Path) -> None:
    ours = tmp_path / f"igtl_gateway-{__version__}-cp313-cp313-manylinux_2_34_aarch64.whl"
    expected = f"expected compiled wheels of igtl-gateway {__version__}"
    with pytest.raises(ReleaseError, match=f"found nothing, {expected}"):
        module.wheels_of_others(tmp_path)
    ours.touch()
    assert module.wheels_of_others(tmp_path) == [ours]
    for name in ("igtl_gateway-0.0.9-cp313-cp313-manylinux_2_34_aarch64.whl", "SHA256SUMS"):
        (tmp_path / name).touch()
        with pytest.raises(ReleaseError, match=f"found {name}, {expected}"):
            module.wheels_of_others(tmp_path)
        (tmp_path / name).unlink()


def test_wheels_of_another_machine_are_part_of_the_release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = tmp_path / "wheels" / f"igtl_gateway-{__version__}-cp313-cp313-manylinux_2_34_aarch64.whl"
    other.parent.mkdir()
    other.write_bytes(b"other")

    def distributions(build: module.Build) -> list[Path]:
        (build.work / "own.whl").write_bytes(b"own")
        return [build.work / "own.whl"]

    monkeypatch.setattr(module, "_git", lambda *_: "0")
    monkeypatch.setattr(module.Build, "distributions", distributions)
    monkeypatch.setattr(
        "tools.sbom.write_sbom", lambda out, files, epoch: Path(shutil.copyfile(files[0], out / "sbom"))
    )
    release(tmp_path / "dist", "HEAD", (), [other.parent])
    lines = [line.split("  ") for line in (tmp_path / "dist" / SUMS).read_text("utf-8").splitlines()]
    sums = {name: digest for digest, name in lines}
    assert sums == {name: sha256(tmp_path / "dist" / name) for name in ("own.whl", other.name, "sbom")}
    release(tmp_path / "compiled", "HEAD", (), compiled_only=True)
    assert [path.name for path in (tmp_path / "compiled").iterdir()] == ["own.whl"]
