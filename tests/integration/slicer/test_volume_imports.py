"""Volumes and sequences that 3D Slicer writes and ``import`` reads: values, places in RAS and times."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.cli import main
from tests import slicer
from tests.addons.exchange.itk import corners, images_of

#: Turned, with unequal spacing, in RAS millimetres.
TURNED = np.array([[0.0, -0.5, 0.0, 12.5], [0.75, 0.0, 0.0, -33.25], [0.0, 0.0, 2.0, 7.125], [0, 0, 0, 1]])
SIZE = (5, 4, 3)
VALUES = np.arange(60, dtype=np.int16).reshape(SIZE[::-1])
#: Node, components, number type and suffix.
VOLUMES = [
    (node, components, kind, suffix)
    for suffix in (".nrrd", ".nhdr", ".mha", ".nii.gz")
    for node, components, kind in (("Scalar", 1, np.int16), ("LabelMap", 1, np.int16), ("Vector", 3, np.uint8))
    if not (node == "Vector" and suffix == ".nii.gz")
]


def volume(node: Any, values: np.ndarray, components: int = 1) -> Any:
    """The node with these voxels."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk

    image = vtk.vtkImageData()
    image.SetDimensions(*SIZE)
    flat = values.reshape(-1, components) if components > 1 else values.ravel()
    image.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(flat), deep=1))
    node.SetAndObserveImageData(image)
    node.SetIJKToRASMatrix(slicer.new_matrix(TURNED))
    return node


def places() -> np.ndarray:
    """The corners in LPS."""
    found = [(TURNED @ [*each, 1.0])[:3] for each in itertools.product(*((0, count - 1) for count in SIZE))]
    return np.array(found) * (-1, -1, 1)


@pytest.mark.parametrize(("node", "components", "kind", "suffix"), VOLUMES)
def test_a_volume_that_slicer_wrote(tmp_path: Path, node: str, components: int, kind: Any, suffix: str) -> None:
    values = np.stack([VALUES + 60 * at for at in range(components)], -1).astype(kind).squeeze()
    scene = slicer.new_scene(tmp_path / "cache")
    made = volume(slicer.new_node(scene, f"{node}Volume"), values, components)
    (image,) = images_of(slicer.write(made, "VolumeArchetype", tmp_path / f"v{suffix}"))
    assert image.dimensions == SIZE
    assert np.array_equal(np.asarray(image.array).reshape(values.shape), values)
    assert np.allclose(corners(image), places(), atol=1e-4)


@pytest.mark.parametrize("suffix", [".seq.nrrd", ".seq.mha"])
def test_a_sequence_of_volumes_that_slicer_wrote(tmp_path: Path, suffix: str) -> None:
    scene = slicer.new_scene(tmp_path / "cache")
    sequence = slicer.new_node(scene, "Sequence")
    sequence.SetIndexName("time")
    sequence.SetIndexUnit("s")
    for at in range(4):
        made = volume(slicer.slicer().vtkMRMLScalarVolumeNode(), VALUES + at)
        sequence.SetDataNodeAtValue(made, f"{at * 0.25:.3f}")
    path, back = slicer.write(sequence, "VolumeSequence", tmp_path / f"q{suffix}"), tmp_path / "q.mcap"
    images = images_of(path)
    assert len(images) == 4
    for at, image in enumerate(images):
        assert np.array_equal(np.asarray(image.array).reshape(VALUES.shape), VALUES + at)
        assert np.allclose(corners(image), places(), atol=1e-4)
    assert main(["import", str(path), "-o", str(back), "--epoch", "2026-01-01T00:00:00Z"]) == 0
    with igtl_gateway.open(back) as session:
        (stream,) = [session[name] for name in session if "IMAGE" in str(name)]
        times = stream.stamps
    assert np.allclose(np.asarray(times - times[0]) / 1e9, [0, 0.25, 0.5, 0.75], atol=1e-6)
