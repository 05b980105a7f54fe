"""Opens a scene with the classes of 3D Slicer (slicer-core), plays it, and writes what it found as a pickle.

    python scene_judge.py SCENE OUT.pickle [TIME ...]

A process of its own: Slicer writes its log to standard error, and its libraries stay loaded.
"""

from __future__ import annotations

import pickle
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import slicer
import vtk
from vtk.util.numpy_support import vtk_to_numpy


def matrix_of(node: Any, *, world: bool = False) -> np.ndarray:
    matrix = vtk.vtkMatrix4x4()
    if world:
        node.GetMatrixTransformToWorld(matrix)
    else:
        node.GetMatrixTransformToParent(matrix)
    return np.array([[matrix.GetElement(row, column) for column in range(4)] for row in range(4)])


def content_of(node: Any) -> Any:
    """What a node has, as plain values."""
    if node.IsA("vtkMRMLTransformNode"):
        return matrix_of(node)
    if node.IsA("vtkMRMLVolumeNode"):
        place = vtk.vtkMatrix4x4()
        node.GetIJKToRASMatrix(place)
        image = node.GetImageData()
        return {
            "place": np.array([[place.GetElement(row, column) for column in range(4)] for row in range(4)]),
            "size": image.GetDimensions(),
            "pixels": vtk_to_numpy(image.GetPointData().GetScalars()).copy(),
        }
    if node.IsA("vtkMRMLModelNode"):
        mesh = node.GetPolyData()
        points = mesh.GetPoints() if mesh else None
        colours = mesh.GetPointData().GetArray("colours") if mesh else None
        return {
            "points": vtk_to_numpy(points.GetData()).copy() if points else np.zeros((0, 3)),
            "cells": mesh.GetNumberOfCells() if mesh else 0,
            "colours": vtk_to_numpy(colours).copy() if colours else None,
        }
    if node.IsA("vtkMRMLMarkupsNode"):
        count = node.GetNumberOfControlPoints()
        return {
            "points": np.array([node.GetNthControlPointPosition(n) for n in range(count)]).reshape(-1, 3),
            "labels": [node.GetNthControlPointLabel(n) for n in range(count)],
        }
    return node.GetText() if node.IsA("vtkMRMLTextNode") else None


def drawn_pictures(scene: Any) -> dict[str, np.ndarray]:
    """The colours of each volume as a slice view gets them from its display node, RGBA."""
    drawn = {}
    for number in range(scene.GetNumberOfNodesByClass("vtkMRMLVolumeNode")):
        volume = scene.GetNthNodeByClass(number, "vtkMRMLVolumeNode")
        port = volume.GetDisplayNode().GetImageDataConnection()
        port.GetProducer().Update()
        drawn[volume.GetName()] = vtk_to_numpy(port.GetProducer().GetOutput().GetPointData().GetScalars()).copy()
    return drawn


def opened(path: Path) -> tuple[Any, Any]:
    """The scene of a file, and the logic that plays it."""
    scene, logic = slicer.vtkMRMLScene(), slicer.vtkSlicerSequencesLogic()
    scene.RegisterNodeClass(slicer.vtkMRMLMarkupsJsonStorageNode())
    logic.SetMRMLScene(scene)
    colours = slicer.vtkMRMLColorLogic()
    colours.SetMRMLScene(scene)
    colours.AddDefaultColorNodes()
    scene.colours = colours  # without the logic, its nodes go
    scene.AddNewNodeByClass("vtkMRMLSelectionNode")  # the program has one, by which lines find their units
    cache, data = slicer.vtkCacheManager(), slicer.vtkDataIOManager()
    cache.SetRemoteCacheDirectory(tempfile.mkdtemp())
    data.SetCacheManager(cache)
    scene.SetCacheManager(cache)
    scene.SetDataIOManager(data)
    if path.is_dir():
        (path,) = path.glob("*.mrml")
        scene.SetURL(str(path))
        scene.SetRootDirectory(str(path.parent))
        assert scene.Connect()
    else:
        assert scene.ReadFromMRB(str(path), False)
    return scene, logic


def main(path: Path, out: Path) -> None:
    scene, logic = opened(path)
    browser = scene.GetFirstNodeByClass("vtkMRMLSequenceBrowserNode")
    found: dict[str, Any] = {"sequences": [], "nodes": {}, "tables": {}, "played": []}
    if browser is None:
        out.write_bytes(pickle.dumps(found))
        return
    found["begin_ns"] = int(browser.GetAttribute("IgtlGateway.BeginNs"))
    found["selected"] = browser.GetSelectedItemNumber()
    sequences = vtk.vtkCollection()
    browser.GetSynchronizedSequenceNodes(sequences, True)
    nodes = [sequences.GetItemAsObject(n) for n in range(sequences.GetNumberOfItems())]
    assert len(nodes) == scene.GetNumberOfNodesByClass("vtkMRMLSequenceNode"), "the browser plays all sequences"
    logic.UpdateProxyNodesFromSequences(browser)
    for node in nodes:
        proxy = browser.GetProxyNode(node)
        above = proxy.GetParentTransformNode() if hasattr(proxy, "GetParentTransformNode") else None
        items = range(node.GetNumberOfDataNodes())
        found["sequences"].append(
            {
                "name": proxy.GetName(),
                "class": proxy.GetClassName(),
                "stream": node.GetAttribute("IgtlGateway.Stream"),
                "unit": node.GetIndexUnit(),
                "index": [node.GetNthIndexValue(n) for n in items],
                "items": [content_of(node.GetNthDataNode(n)) for n in items],
                "parent": above.GetName() if above else "",
                "shown": proxy.GetDisplayNode().GetClassName()
                if getattr(proxy, "GetDisplayNode", None) and proxy.GetDisplayNode()
                else "",
            }
        )
    # play all items; what each proxy then has is what its sequence has at that time
    leader = browser.GetMasterSequenceNode()
    for number in range(leader.GetNumberOfDataNodes()):
        browser.SetSelectedItemNumber(number)
        logic.UpdateProxyNodesFromSequences(browser)
        moved = {
            node.GetID(): matrix_of(browser.GetProxyNode(node))
            for node in nodes
            if browser.GetProxyNode(node).IsA("vtkMRMLTransformNode")
        }
        found["played"].append((leader.GetNthIndexValue(number), [moved.get(node.GetID()) for node in nodes]))
    found["drawn"] = drawn_pictures(scene)
    for number in range(scene.GetNumberOfNodesByClass("vtkMRMLTableNode")):
        table = scene.GetNthNodeByClass(number, "vtkMRMLTableNode")
        columns = [table.GetTable().GetColumn(n) for n in range(table.GetTable().GetNumberOfColumns())]
        found["tables"][table.GetName()] = {
            column.GetName(): [
                column.GetValue(row) if column.IsNumeric() else str(column.GetValue(row))
                for row in range(column.GetNumberOfTuples())
            ]
            for column in columns
        }
    for kind in ("Model", "LinearTransform"):
        for number in range(scene.GetNumberOfNodesByClass(f"vtkMRML{kind}Node")):
            node = scene.GetNthNodeByClass(number, f"vtkMRML{kind}Node")
            above = node.GetParentTransformNode()
            found["nodes"][node.GetName()] = (kind, above.GetName() if above else "", content_of(node))
    about = scene.GetFirstNodeByName("About this scene")
    found["about"] = about.GetText() if about else ""
    out.write_bytes(pickle.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
