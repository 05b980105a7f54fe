"""Finds and reads the meshes of a URDF.

A URDF in a recording is foreign text: it may only name files in packages of ROS (``package://``).  A URDF that the
user names may also name files of its own package, or of its own folder if it is in none.  No name leads out of these
folders.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from igtl_gateway.addon import GatewayError, UnsupportedRecording
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import files, parse_xml

#: Bytes of one mesh, and of all meshes of a session.
MAX_BYTES, MAX_ALL_BYTES = 32 << 20, 256 << 20

_STL_HEAD, _STL_TRIANGLE, _DAE_HEAD = 84, 50, 4096
#: Suffix → media type of rerun.
_TYPES = {
    ".stl": "model/stl",
    ".obj": "model/obj",
    ".glb": "model/gltf-binary",
    ".dae": "model/vnd.collada+xml",
}
_PACKAGE, _FILE = "package://", "file://"


@dataclass(frozen=True, slots=True)
class Mesh:
    """A mesh file."""

    data: bytes
    media_type: str


@dataclass(slots=True)
class MeshFolders:
    """The folders in which meshes are looked up.

    Args:
        environment: with AMENT_PREFIX_PATH and ROS_PACKAGE_PATH.
    """

    environment: Mapping[str, str]
    _meshes: dict[Path, Mesh] = field(default_factory=dict)
    _bytes: int = 0

    def find(self, uri: str, urdf: Path | None = None) -> Mesh:
        """Return the mesh that a URDF names.

        Args:
            uri: as in the URDF.
            urdf: the URDF's file; None for a URDF in a recording.

        Raises UnsupportedRecording if there is none, or none that may be read.
        """
        path = self._path(uri, urdf)
        media_type = _TYPES.get(path.suffix.lower())
        if media_type is None:
            raise UnsupportedRecording(f"{uri[:200]}: found {path.suffix[:20]!r}, expected {', '.join(_TYPES)}")
        mesh = self._meshes.get(path)
        if mesh is None:
            size = files.size_of(path)
            if size > MAX_BYTES or self._bytes + size > MAX_ALL_BYTES:
                raise UnsupportedRecording(f"{path}: found {count_text(size, 'byte')}, expected at most {MAX_BYTES:,}")
            with files.open_file(path) as stream:
                data = stream.read(MAX_BYTES)
            _check(data, path)
            self._bytes += len(data)
            mesh = self._meshes[path] = Mesh(data, media_type)
        return mesh

    def _path(self, uri: str, urdf: Path | None) -> Path:
        if "\0" in uri:
            raise UnsupportedRecording(f"{uri[:200]!r}: found a name with a null character")
        if uri.startswith(_PACKAGE):
            package, _, name = uri.removeprefix(_PACKAGE).partition("/")
            return _inside(self._package(package, urdf), name, uri)
        if urdf is None:
            raise UnsupportedRecording(f"{uri[:200]}: found no package:// in a recorded URDF; --urdf FILE reads others")
        own = _own_package(urdf)
        folder = own or urdf.absolute().parent
        name = uri.removeprefix(_FILE) if uri.startswith(_FILE) else str(urdf.absolute().parent / uri)
        found = _inside(folder, os.path.relpath(name, folder), uri)
        if own is None and not Path(os.path.realpath(found)).is_relative_to(os.path.realpath(folder)):
            raise UnsupportedRecording(f"{uri[:200]}: found a link out of {folder}, expected a file in it")
        return found

    def _package(self, package: str, urdf: Path | None) -> Path:
        """Return the folder of a package."""
        if package in {"", ".", ".."} or PurePosixPath(package).name != package:
            raise UnsupportedRecording(f"{package[:80]!r}: found no name of a package, expected one")
        own = _own_package(urdf) if urdf else None
        if own and package in (own.name, _package_name(own)):
            return own
        paths = [f"{prefix}/share/{package}" for prefix in self._folders("AMENT_PREFIX_PATH")]
        for folder in self._folders("ROS_PACKAGE_PATH"):
            paths += [f"{folder}/{package}", *([folder] if Path(folder).name == package else [])]
        for path in map(Path, paths):
            if path.is_dir():
                return path
        raise UnsupportedRecording(f"{package[:80]}: not found in AMENT_PREFIX_PATH or ROS_PACKAGE_PATH")

    def _folders(self, variable: str) -> list[str]:
        return [part for part in self.environment.get(variable, "").split(os.pathsep) if part]


def _inside(folder: Path, name: str, uri: str) -> Path:
    """Return the file ``name`` below a folder; links in a package are the user's own."""
    found = os.path.normpath(name)
    if os.path.isabs(found) or found == "." or found.split(os.sep)[0] == "..":
        raise UnsupportedRecording(f"{uri[:200]}: found a name outside of {folder}, expected one in it")
    return folder / found


def _own_package(urdf: Path) -> Path | None:
    """Return the package in which a URDF is: the next folder above with a package.xml."""
    return next((folder for folder in urdf.absolute().parents if (folder / "package.xml").is_file()), None)


def _package_name(folder: Path) -> str:
    try:
        name = parse_xml(files.read_bytes(folder / "package.xml"), "package.xml").first("name")
    except GatewayError:
        return ""
    return name.text.strip() if name else ""


def _check(data: bytes, path: Path) -> None:
    """Raise UnsupportedRecording for a file that is not what its name states: a pointer of Git LFS, for example."""
    match path.suffix.lower():
        case ".stl":
            count = int.from_bytes(data[_STL_HEAD - 4 : _STL_HEAD], "little")
            good = data[:5] == b"solid" or len(data) == _STL_HEAD + count * _STL_TRIANGLE
        case ".glb":
            good = data[:4] == b"glTF"
        case ".dae":
            good = b"<COLLADA" in data[:_DAE_HEAD] and b"<!DOCTYPE" not in data  # no entities in the viewer
        case _:
            good = data[:7] != b"version"
    if not good:
        found = "a pointer of Git LFS" if data.startswith(b"version https://git-lfs") else "other content"
        raise UnsupportedRecording(f"{path}: found {found}, expected a mesh ({path.suffix})")
