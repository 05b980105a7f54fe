"""NRRD exports: what SimpleITK and pynrrd read of them, for every IMAGE of every fixture; sequences of them, too."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.addons.exchange.folder import FileNames
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, ROS_KINDS, chosen_entries
from igtl_gateway.addons.exchange.sequence_out import export_sequence
from igtl_gateway.addons.exchange.volume_out import export_nrrd
from igtl_gateway.api.placement import ImagePlacement
from igtl_gateway.base.errors import UnsupportedRecording
from igtl_gateway.convert.context import ToIgtlContext
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.images import image_to_igtl
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.convert.volumes import volume_to_image
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import decode
from igtl_gateway.wire.image import SCALARS, Image
from tests.addons.exchange import plus
from tests.addons.exchange.itk import MICROMETRE, corners, images_of, itk_corners, read, sitk
from tests.addons.exchange.memory import InMemory, sent
from tests.places import ROOT
from tests.tables import table

#: Images of a stream that are judged: the others differ in pixels only.
EACH = 3
FIXTURES = sorted((ROOT / "fixtures").glob("*.mcap"))


def image_of(entry: Entry) -> Image | None:
    """The whole image with pixels that a message is, by the decoder and the conversions of the gateway."""
    content: object = None
    if entry.type == "IMAGE":
        content = decode(entry.data()).content
    elif entry.type == Volume.TYPE:
        content = volume_to_image(Volume.unpack(entry.data()), ToIgtlContext()).content
    elif entry.type == RosImage.TYPE:
        content = image_to_igtl(RosImage.unpack(entry.data()), ToIgtlContext()).content
    whole = isinstance(content, Image) and content.sub_size == content.dimensions and content.expected_bytes
    return content if isinstance(content, Image) and whole else None


def values_of(image: Image) -> np.ndarray[Any, Any]:
    return image.array.astype(np.dtype(SCALARS[image.scalar_type])).reshape((*image.dimensions[::-1], -1))


def judge(path: Path, image: Image) -> None:
    """ITK and pynrrd find the same geometry and values in a file."""
    found = read(path)
    values = sitk().GetArrayFromImage(found).reshape((*image.dimensions[::-1], -1))
    assert np.array_equal(values, values_of(image), equal_nan=values.dtype.kind == "f")
    if ImagePlacement.of_image(image):
        assert np.abs(corners(image) - itk_corners(found, image.dimensions)).max() < MICROMETRE
    data, header = pytest.importorskip("nrrd").read(str(path), index_order="C")
    assert np.array_equal(data.reshape(values.shape), values, equal_nan=values.dtype.kind == "f")
    assert header["kinds"][-3:] == ["domain"] * 3


@table("fixture", FIXTURES, ids=lambda path: path.stem)
def test_others_read_each_exported_image_of_a_fixture(tmp_path: Path, fixture: Path) -> None:
    sitk()
    names, judged = FileNames(), Counter[str]()
    with SessionFile.open(fixture) as file:
        account = export_nrrd(file, tmp_path / "out", ())
        written: set[bool] = set()  # whether the last input is
        for entry in chosen_entries(file, (*IGTL_KINDS, *ROS_KINDS), (), on_input=lambda _: written.clear()):
            image = image_of(entry)
            if image is None or (written and not entry.kind.is_input):
                continue
            if entry.kind.is_input:
                written.add(True)
            stream = names.of(entry)
            paths = sorted((tmp_path / "out").glob(f"{stream}.*.nrrd"))
            if judged[stream] < EACH:
                judge(paths[judged[stream]], image)
            judged[stream] += 1
            assert judged[stream] <= len(paths)
    assert sum(judged.values()) == account.files == sum(row.taken for row in account.rows)
    assert all(row.good or "part of an image" in row.why or "no pixels" in row.why for row in account.rows)


@table("fixture", FIXTURES, ids=lambda path: path.stem)
def test_others_read_the_sequence_of_a_fixture(tmp_path: Path, fixture: Path) -> None:
    sitk()
    with SessionFile.open(fixture) as file:
        streams = sorted({channel.topic for channel in file.channels if channel.type == "IMAGE"})
        tracked = any(channel.type == "TRANSFORM" for channel in file.channels)
        for number, stream in enumerate(streams or [""] * tracked):
            path = tmp_path / f"{number}.igs.mha"
            try:
                account = export_sequence(file, path, (stream, "TRANSFORM/*") if stream else ())
            except UnsupportedRecording:
                continue  # a part of an image, or an empty one
            rows = {(row.type, row.stream): row for row in account.rows}
            found = plus.read(path)
            assert plus.faults(path) == []
            image = read(path)
            assert found.count == len(found.frames) == (image.GetSize()[-1] if "list" in found.kinds else 1)
            if image.GetDimension() == 3:
                assert vtk_size(path) == image.GetSize()
            held = sum(fields["ImageStatus"] == "OK" for fields in found.frames.values())
            assert held == sum(row.taken for row in account.rows if row.type == "IMAGE")
            for name in (row.stream for row in account.rows if row.type == "TRANSFORM"):
                key = name.partition("/")[2] + "Transform"
                valid = sum(fields[f"{key}Status"] == "OK" for fields in found.frames.values())
                assert f"{key}: OK in {valid} of {found.count} frames" in account.notes
                poses = {fields[key] for fields in found.frames.values() if fields[f"{key}Status"] == "OK"}
                assert len(poses) <= rows["TRANSFORM", name].taken <= valid
            if held:
                first = images_of(path)[0]
                recorded = next(whole_images(file, stream))
                assert np.abs(corners(first) - corners(recorded)).max() < MICROMETRE
                assert np.abs(corners(recorded) - itk_corners(image, recorded.dimensions)).max() < MICROMETRE
                values = sitk().GetArrayFromImage(image).reshape((found.count, *values_of(recorded).shape))
                assert np.array_equal(values[0], values_of(recorded))


def vtk_size(path: Path) -> tuple[int, ...]:
    """The size of an image as VTK reads it."""
    module = pytest.importorskip("vtkmodules.vtkIOImage", reason="VTK is the judge")
    reader = module.vtkMetaImageReader()
    reader.SetFileName(str(path))
    reader.Update()
    return tuple(reader.GetOutput().GetDimensions())


def whole_images(file: SessionFile, stream: str) -> Iterator[Image]:
    """The IMAGEs of a stream as peers sent them, or else as they were sent to peers."""
    kinds = {entry.kind for entry in file.entries() if entry.channel == stream}
    kind = Kind.IGTL_IN if Kind.IGTL_IN in kinds else Kind.IGTL_OUT
    for entry in chosen_entries(file, (kind,), (stream,)):
        content = decode(entry.data()).content
        if isinstance(content, Image) and content.sub_size == content.dimensions:
            yield content


@table(
    ("matrix", "note"),
    [
        ((1.0, 0, 0, 0, 1, 0, 0, 0, 0, 5, 6, 7), "1 slice without a third axis"),
        ((math.nan, 0, 0, 0, 1, 0, 0, 0, 1, 5, 6, 7), "1 without a position"),
        ((1.0, 0, 0, 2, 0, 0, 0, 0, 1, 5, 6, 7), "1 without a position"),
        ((0.0, 0, 0, 0, 1, 0, 0, 0, 1, 5, 6, 7), "1 without a position"),
        ((1.0, 0, 0, 0, 1, 0, 0, 0, 1, 5, 6, 7), ""),
    ],
)
@table("components", [1, 3])
def test_itk_reads_images_without_a_place_and_the_account_says_so(
    tmp_path: Path, matrix: tuple[float, ...], note: str, components: int
) -> None:
    image = Image((4, 3, 1), 3, bytes(range(12 * components)), components, wire_matrix=matrix)
    account = export_nrrd(InMemory([sent(0, "Scan", "IMAGE", image)]), tmp_path / "out", ())
    (path,) = (tmp_path / "out").iterdir()
    judge(path, image)
    assert [note in told for told in account.notes] == [True] * bool(note)
    if note and "third axis" not in note:
        assert read(path).GetDirection() == (1, 0, 0, 0, 1, 0, 0, 0, 1)
        assert images_of(path)[0].wire_matrix[0] == -1.0
