"""Files of a scene: the same in a folder and in a bundle, which any reader of zip opens, byte for byte the same."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.scene_store import FolderStore, Store, bundle, entry_info


def fill(store: Store) -> None:
    store.write("scene.mrml", b"<MRML/>")
    store.waiting("Data/late.nrrd").write_bytes(b"late")
    with store.opened("Data/stream.nrrd") as stream:
        stream.write(b"head")
        stream.write(b"pixels")
    store.add("Data/late.nrrd")


FILES = {"scene.mrml": b"<MRML/>", "Data/late.nrrd": b"late", "Data/stream.nrrd": b"headpixels"}


def contents(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as opened:
        assert opened.testzip() is None
        return {info.filename: opened.read(info) for info in opened.infolist()}


def test_a_folder(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    store = FolderStore(tmp_path / "scene")
    fill(store)
    found = {path.relative_to(tmp_path / "scene").as_posix(): path.read_bytes() for path in tmp_path.rglob("*.*")}
    assert found == FILES and store.direct
    with pytest.raises(FileExistsError):
        store.write("scene.mrml", b"")


def test_a_bundle_has_the_same_files_below_its_root(tmp_path: Path) -> None:
    path = tmp_path / "out.mrb"
    with bundle(path, "Scene") as store:
        assert not store.direct
        fill(store)
    assert contents(path) == {f"Scene/{name}": data for name, data in FILES.items()}
    assert [each.name for each in tmp_path.iterdir()] == ["out.mrb"], "nothing waits any more"


def test_equal_scenes_are_equal_bundles(tmp_path: Path) -> None:
    for name in ("a.mrb", "b.mrb"):
        with bundle(tmp_path / name, "Scene") as store:
            fill(store)
    assert (tmp_path / "a.mrb").read_bytes() == (tmp_path / "b.mrb").read_bytes()


def test_files_of_a_bundle_are_not_compressed_and_readable_by_all(tmp_path: Path) -> None:
    with bundle(tmp_path / "a.mrb", "Scene") as store:
        store.write("zeros", bytes(10_000))
    with zipfile.ZipFile(tmp_path / "a.mrb") as opened:
        (info,) = opened.infolist()
    assert (info.compress_type, info.file_size, info.compress_size) == (zipfile.ZIP_STORED, 10_000, 10_000)
    assert info.external_attr >> 16 == 0o644 and info.date_time == (1980, 1, 1, 0, 0, 0)
    assert entry_info("a").date_time == info.date_time


def test_what_waits_is_removed_also_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeyError), bundle(tmp_path / "a.mrb", "Scene") as store:
        store.waiting("Data/late.nrrd").write_bytes(b"late")
        raise KeyError
    assert [each.name for each in tmp_path.iterdir()] == ["a.mrb"]


def test_a_bundle_that_is_there_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.mrb").write_bytes(b"mine")
    with pytest.raises(FileExistsError), bundle(tmp_path / "a.mrb", "Scene"):
        pass
    assert (tmp_path / "a.mrb").read_bytes() == b"mine"
