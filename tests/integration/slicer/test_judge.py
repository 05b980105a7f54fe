"""The judge itself: it reads, refuses and logs, beside the other libraries that the tests load."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests import slicer


def test_a_scene_reads_what_it_wrote(tmp_path: Path) -> None:
    scene = slicer.new_scene(tmp_path / "cache")
    node = slicer.new_node(scene, "LinearTransform")
    placed = np.array([[0.0, -1, 0, 5], [1, 0, 0, -6], [0, 0, 1, 7], [0, 0, 0, 1]])
    node.SetMatrixTransformToParent(slicer.new_matrix(placed))
    path = slicer.write(node, "Transform", tmp_path / "t.h5")
    assert np.array_equal(slicer.to_parent(slicer.read(scene, "Transform", "Transform", path)), placed)


def test_a_log_line_fails_and_a_refusal_has_its_text(tmp_path: Path) -> None:
    scene = slicer.new_scene(tmp_path / "cache")
    (tmp_path / "t.tfm").write_text("no transform\n")
    with pytest.raises(AssertionError, match=r"t\.tfm"):
        slicer.read(scene, "LinearTransform", "Transform", tmp_path / "t.tfm")
    assert slicer.refused(scene, "LinearTransform", "Transform", tmp_path / "t.tfm")
    with slicer.log_of() as log:
        scene.AddNewNodeByClass("vtkMRMLUnknownNode")
    assert log
