"""3D Slicer as a judge: its scene, storage nodes and log, from the wheel ``slicer-core`` (without window and Qt).

Strategy: a scene as the program has it: all node classes are registered, and a cache and an input-output manager stand
behind it, without which Slicer does not read a scene.  VTK, ITK and MRML write their log to the standard error of the
process, so ``log_of`` takes what arrives there, and every function here fails where Slicer logs a line.

``import slicer`` needs 1 s and goes together with rclpy, rerun and SimpleITK in one process, in any order.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest


def slicer() -> Any:
    """The module, or skip: there is no wheel for Python 3.14."""
    return pytest.importorskip("slicer", reason="slicer-core is the judge")


def new_scene(cache: Path) -> Any:
    """An empty vtkMRMLScene with all node classes; ``cache`` is a folder for what it reads from elsewhere."""
    module = slicer()
    scene = module.vtkMRMLScene()
    for name in dir(module):
        if name.startswith("vtkMRML") and issubclass(getattr(module, name), module.vtkMRMLNode):
            _register(scene, getattr(module, name))
    manager, files = module.vtkCacheManager(), module.vtkDataIOManager()
    cache.mkdir(parents=True, exist_ok=True)
    manager.SetRemoteCacheDirectory(str(cache))
    files.SetCacheManager(manager)
    scene.SetCacheManager(manager)
    scene.SetDataIOManager(files)
    return scene


def _register(scene: Any, node: Any) -> None:
    try:
        instance = node()
    except TypeError:  # abstract
        return
    if not scene.GetClassNameByTag(instance.GetNodeTagName() or ""):
        scene.RegisterNodeClass(instance)


def new_node(scene: Any, node: str, name: str = "Node") -> Any:
    """A node of a class, such as ``ScalarVolume``, in the scene."""
    return scene.AddNewNodeByClass(f"vtkMRML{node}Node", name)


def read(scene: Any, node: str, storage: str, path: Path, **setting: Any) -> Any:
    """A file as a new node: ``read(scene, "Model", "Model", path)``.

    Args:
        scene: of ``new_scene``.
        node: its class without ``vtkMRML`` and ``Node``.
        storage: that of its storage node, without ``StorageNode`` too.
        path: the file.
        **setting: of the storage node: ``SingleFile=1``.

    Raises AssertionError, with Slicer's text, if Slicer does not read it or logs a line.
    """
    found, log = read_with_log(scene, node, storage, path, **setting)
    assert not log, (path, log)
    return found


def read_with_log(scene: Any, node: str, storage: str, path: Path, **setting: Any) -> tuple[Any, list[str]]:
    """As ``read``, with the lines that Slicer logs.  Raises AssertionError if Slicer does not read it."""
    found = new_node(scene, node, path.name)
    chosen = _storage(scene, storage, path, setting)
    with log_of() as log:
        done = chosen.ReadData(found)
    assert done, (path, chosen.GetUserMessages().GetAllMessagesAsString(), log)
    return found, log


def write(node: Any, storage: str, path: Path, **setting: Any) -> Path:
    """Write a node of a scene by a storage node of a class; the log, which warns of old formats, is not looked at."""
    with log_of():
        done = _storage(node.GetScene(), storage, path, setting).WriteData(node)
    assert done, path
    return path


def refused(scene: Any, node: str, storage: str, path: Path) -> str:
    """The text of Slicer where it does not read a file.  Raises AssertionError if it reads it."""
    chosen = _storage(scene, storage, path, {})
    with log_of() as log:
        assert not chosen.ReadData(new_node(scene, node)), path
    return str(chosen.GetUserMessages().GetAllMessagesAsString()) + "\n".join(log)


def _storage(scene: Any, storage: str, path: Path, setting: dict[str, Any]) -> Any:
    chosen = scene.AddNewNodeByClass(f"vtkMRML{storage}StorageNode")
    chosen.SetFileName(str(path))
    for name, value in setting.items():
        getattr(chosen, f"Set{name}")(value)
    return chosen


@contextmanager
def log_of() -> Iterator[list[str]]:
    """The lines that reach the standard error of the process meanwhile: those of Slicer's log; filled at the end."""
    lines: list[str] = []
    sys.stderr.flush()
    before = os.dup(2)
    with tempfile.TemporaryFile() as kept:
        os.dup2(kept.fileno(), 2)
        try:
            yield lines
        finally:
            sys.stderr.flush()
            os.dup2(before, 2)
            os.close(before)
            kept.seek(0)
            lines += kept.read().decode("utf-8", "replace").splitlines()


def matrix(of: Any) -> np.ndarray:
    """A vtkMatrix4x4 as an array of 4 by 4."""
    return np.array([[of.GetElement(row, column) for column in range(4)] for row in range(4)])


def new_matrix(values: Any) -> Any:
    """The same the other way."""
    import vtk

    found = vtk.vtkMatrix4x4()
    found.DeepCopy(np.asarray(values, float).ravel().tolist())
    return found


def ijk_to_ras(volume: Any) -> np.ndarray:
    """The place of a volume's voxels in RAS, millimetres, 4 by 4."""
    found = new_matrix(np.eye(4))
    volume.GetIJKToRASMatrix(found)
    return matrix(found)


def to_parent(transform: Any) -> np.ndarray:
    """The matrix of a linear transform node from its child to its parent, RAS, millimetres."""
    found = new_matrix(np.eye(4))
    assert transform.GetMatrixTransformToParent(found), "not linear"
    return matrix(found)


def voxels(volume: Any) -> np.ndarray:
    """The values of a volume as (slices, rows, columns), with a last axis for more than one component."""
    image = volume.GetImageData()
    columns, rows, slices = image.GetDimensions()
    components = image.GetNumberOfScalarComponents()
    values = values_of(image.GetPointData().GetScalars())
    return values.reshape((slices, rows, columns) + ((components,) if components > 1 else ()))


def values_of(array: Any) -> np.ndarray:
    """A vtkDataArray as an array."""
    from vtk.util import numpy_support

    return np.asarray(numpy_support.vtk_to_numpy(array))


def items(sequence: Any) -> list[tuple[str, Any]]:
    """The items of a sequence node: index and data node."""
    return [
        (sequence.GetNthIndexValue(at), sequence.GetNthDataNode(at)) for at in range(sequence.GetNumberOfDataNodes())
    ]


def add_point(markups: Any, position: tuple[float, float, float], label: str) -> None:
    """Add a control point to a markups node; RAS, millimetres."""
    import vtk

    with log_of():  # a scene without the units of the program
        markups.AddControlPoint(vtk.vtkVector3d(*position), label)
