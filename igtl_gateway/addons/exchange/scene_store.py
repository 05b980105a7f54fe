"""Where the files of a scene are written: a folder, or the zip that 3D Slicer calls a medical reality bundle (.mrb).

A zip is written file by file.  So one stream of pictures goes straight into it while the session is read; what is
written meanwhile waits in files beside it.  Nothing in a bundle is compressed: pictures of ultrasound hardly become
smaller, and a copy is as fast as the disk.
"""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Protocol

from igtl_gateway.addon.writing import make_folder, open_new

#: Folder of all files that the scene refers to.
DATA = "Data"
_COPIED = 4 << 20
#: Every time in a bundle: equal sessions give equal files.
_TIME = (1980, 1, 1, 0, 0, 0)


class Store(Protocol):
    """Files of a scene by their names below its root."""

    #: whether a file can be open beside another one
    direct: bool

    def write(self, name: str, data: bytes) -> None:
        """Write a file."""

    def waiting(self, name: str) -> Path:
        """Return where to write a file that is added later by ``add``."""

    def add(self, name: str) -> None:
        """Add the file that was written at ``waiting``."""

    def opened(self, name: str) -> IO[bytes]:
        """Open a file for writing; until it is closed, no other one is written."""


def entry_info(name: str) -> zipfile.ZipInfo:
    """Return the head of a file in a bundle."""
    info = zipfile.ZipInfo(name, _TIME)
    info.external_attr = 0o644 << 16
    return info


class FolderStore:
    """A folder."""

    direct = True

    def __init__(self, root: Path) -> None:
        self._root = root
        make_folder(root / DATA)

    def write(self, name: str, data: bytes) -> None:
        with open_new(self._root / name) as stream:
            stream.write(data)

    def waiting(self, name: str) -> Path:
        return self._root / name

    def add(self, name: str) -> None:
        """It is there."""

    def opened(self, name: str) -> IO[bytes]:
        return open_new(self._root / name)


class BundleStore:
    """A zip; ``beside`` is a folder for what waits."""

    direct = False

    def __init__(self, bundle: zipfile.ZipFile, root: str, beside: Path) -> None:
        self._zip, self._root, self._beside = bundle, root, beside

    def write(self, name: str, data: bytes) -> None:
        self._zip.writestr(entry_info(f"{self._root}/{name}"), data)

    def waiting(self, name: str) -> Path:
        return self._beside / Path(name).name

    def add(self, name: str) -> None:
        path = self.waiting(name)
        with path.open("rb") as old, self.opened(name) as new:
            shutil.copyfileobj(old, new, _COPIED)
        path.unlink()

    def opened(self, name: str) -> IO[bytes]:
        return self._zip.open(entry_info(f"{self._root}/{name}"), "w", force_zip64=True)


@contextmanager
def bundle(path: Path, root: str) -> Iterator[BundleStore]:
    """Context manager: a new bundle at ``path``, in a folder of its own, which has what waits, too."""
    beside = path.parent / "waiting"
    make_folder(beside)
    try:
        with zipfile.ZipFile(path, "x", zipfile.ZIP_STORED) as opened:
            yield BundleStore(opened, root, beside)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
