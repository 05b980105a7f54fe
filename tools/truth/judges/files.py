"""Files of surfaces, pictures and sequences: VTK, meshio, pynrrd and SimpleITK, in the convention of each format."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import meshio
import nrrd
import numpy as np
import SimpleITK
import vtk
from vtk.util import numpy_support

from tools.truth import world
from tools.truth.judges.samples import Sample

#: Names of files whose number is that of the message.
_NUMBERED = re.compile(r"(.+)\.(\d+)$")


def _stream(path: Path) -> str:
    found = _NUMBERED.match(path.stem)
    return found.group(1) if found else path.stem


def _in_ras(points: Any, header: str) -> Any:
    """Points as 3D Slicer takes them: a file without ``SPACE=RAS`` is LPS, and loses its sign in x and y."""
    return points if "SPACE=RAS" in header else points * np.array([-1.0, -1.0, 1.0])


def by_vtk(folder: Path) -> Iterator[Sample]:
    """Legacy VTK files by VTK."""
    for path in sorted(folder.glob("*.vtk")):
        reader: Any = vtk.vtkPolyDataReader()
        reader.SetFileName(str(path))
        reader.Update()
        data = reader.GetOutput().GetPoints()
        if data and data.GetNumberOfPoints() == world.POINTS:
            points = numpy_support.vtk_to_numpy(data.GetData()).astype(float)
            yield Sample(_stream(path), "", "cloud", _in_ras(points, reader.GetHeader()))


def by_meshio(folder: Path) -> Iterator[Sample]:
    """PLY files by meshio; the comments, which meshio does not have, by VTK."""
    for path in sorted(folder.glob("*.ply")):
        reader: Any = vtk.vtkPLYReader()
        reader.SetFileName(str(path))
        reader.Update()
        comments = reader.GetComments()
        header = "\n".join(comments.GetValue(number) for number in range(comments.GetNumberOfValues()))
        points = np.asarray(meshio.read(path).points, float)
        if len(points) == world.POINTS:
            yield Sample(_stream(path), "", "cloud", _in_ras(points, header))


def by_nrrd(folder: Path) -> Iterator[Sample]:
    """NRRD files: pixels by pynrrd, places by SimpleITK, which has LPS."""
    for path in sorted(folder.glob("*.nrrd")):
        pixels, _ = nrrd.read(str(path))
        pixels = np.squeeze(pixels).T
        if pixels.dtype == np.uint16:
            yield Sample(_stream(path), "", "depth", pixels)
            continue
        place = SimpleITK.ReadImage(str(path))
        stream = _stream(path)
        yield Sample(stream, "", "picture", pixels if _is_placed(place, stream) else np.zeros_like(pixels))


def _is_placed(image: Any, stream: str) -> bool:
    """Whether the corners of a picture of the peer are where the world has them; others have no place."""
    if "IMAGE" not in stream:
        return True
    matrix = world.placement()
    for index in ((0, 0, 0), (world.WIDTH - 1, world.HEIGHT - 1, 0)):
        found = np.array(image.TransformIndexToPhysicalPoint(index)) * np.array([-1.0, -1.0, 1.0])
        if np.abs(found - (matrix[:, :3] @ np.array(index) + matrix[:, 3])).max() > 0.01:
            return False
    return True


def by_itk(path: Path) -> Iterator[tuple[Sample, list[Sample]]]:
    """The frames of a sequence by SimpleITK: the picture, and the transforms with the status OK."""
    image = SimpleITK.ReadImage(str(path))
    facts = {key: image.GetMetaData(key) for key in image.GetMetaDataKeys()}
    frames: dict[int, dict[str, str]] = {}
    for key, value in facts.items():
        if found := re.match(r"Seq_Frame(\d+)_(.+)", key):
            frames.setdefault(int(found.group(1)), {})[found.group(2)] = value
    pixels = SimpleITK.GetArrayFromImage(image)
    placed = pixels.shape[1:] != (world.HEIGHT, world.WIDTH) or _is_placed(image, "IMAGE")
    epoch_ns = int(facts.get("IgtlGatewayEpochNs", 0))
    for number, fields in sorted(frames.items()):
        whole, _, rest = fields["Timestamp"].partition(".")
        time_ns = int(whole) * 10**9 + int(rest.ljust(9, "0")[:9]) + epoch_ns
        others = []
        for name, value in fields.items():
            if name.endswith("Transform") and fields.get(f"{name}Status") == "OK" and name != "ImageToRasTransform":
                matrix = np.array(value.split(), float).reshape(4, 4)
                others.append(Sample(path.name, name.removesuffix("Transform"), "pose", matrix, frame=number))
        if pixels.shape[1:] != (world.HEIGHT, world.WIDTH):  # no pictures in the sequence: frames of transforms alone
            if others:
                yield others[0], others[1:]
            continue
        shown = pixels[number] if placed else np.zeros_like(pixels[number])
        if fields.get("ImageStatus", "OK") == "OK":
            yield Sample("IMAGE/Image", "", "picture", shown, source_ns=time_ns, frame=number), others
