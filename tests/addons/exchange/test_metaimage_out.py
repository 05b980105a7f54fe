"""The sequences that we write: the rules of PLUS's reader, and every orientation with SimpleITK as referee."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.addons.exchange.metaimage_out import IMAGE_TYPES, ORIENTATIONS
from igtl_gateway.addons.exchange.sequence_out import export_sequence
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, LPS, RAS, SCALARS, Image
from igtl_gateway.wire.transform import Transform
from tests.addons.exchange import plus
from tests.addons.exchange.itk import (
    MICROMETRE,
    OBLIQUE,
    corners,
    images_of,
    itk_corners,
    orientations,
    orthonormal,
    read,
)
from tests.addons.exchange.memory import InMemory, sent
from tests.places import ROOT
from tests.tables import table

DOCS = ROOT / "docs" / "reference" / "formats.md"
POSE = Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 1.5, 2.5, 3.5))


def image(size: tuple[int, int, int], scalar: int = 3, components: int = 1, **more: object) -> Image:
    count = size[0] * size[1] * size[2] * components * np.dtype(SCALARS[scalar]).itemsize
    return Image(size, scalar, bytes(range(count % 251)) + bytes(count - count % 251), components, **more)  # type: ignore[arg-type]


def exported(path: Path, images: list[Image], session: dict[str, str] | None = None) -> Path:
    """A sequence of these, with a pose before each."""
    items = []
    for number, one in enumerate(images):
        items += [
            sent(100 * number, "ProbeToTracker", "TRANSFORM", POSE),
            sent(100 * number, "Scan", "IMAGE", one),
        ]
    path.unlink(missing_ok=True)
    account = export_sequence(InMemory(items, session or {}), path, ())
    assert all(row.good and not row.left_out for row in account.rows)
    return path


@table("frames", [1, 3])
@table("size", [(5, 4, 1), (5, 4, 3)])
@table(("scalar", "components"), [*((scalar, 1) for scalar in SCALARS), (3, 3), (3, 4), (10, 2)])
def test_plus_can_read_what_we_write(
    tmp_path: Path, frames: int, size: tuple[int, int, int], scalar: int, components: int
) -> None:
    path = exported(tmp_path / "some.igs.mha", [image(size, scalar, components)] * frames)
    assert plus.faults(path) == []
    found = plus.read(path)
    assert found.count == frames
    assert (found.fields["UltrasoundImageType"] == "RGB_COLOR") == (components == 3)


def test_plus_can_read_a_session_of_transforms(tmp_path: Path) -> None:
    path = tmp_path / "some.igs.mha"
    export_sequence(InMemory([sent(at, "ProbeToTracker", "TRANSFORM", POSE) for at in (0, 50, 100)]), path, ())
    assert plus.faults(path) == []
    assert {fields["ImageStatus"] for fields in plus.read(path).frames.values()} == {"INVALID"}
    assert read(path).GetSize() == (1, 1, 3)
    assert images_of(path) == []


def test_the_rules_are_those_of_the_documentation() -> None:
    text = DOCS.read_text("utf-8")
    assert [rule for rule in plus.RULES if f"| {rule} |" not in text] == []
    assert set(plus.ORIENTATIONS) == set(ORIENTATIONS)
    assert set(plus.TYPES) == set(IMAGE_TYPES)


@pytest.mark.parametrize("bad", ["XX", "", "MX"])
def test_a_rule_that_is_broken_is_found(tmp_path: Path, bad: str) -> None:
    path = exported(tmp_path / "some.igs.mha", [image((5, 4, 1))])
    path.write_bytes(path.read_bytes().replace(b"Orientation = MF", b"Orientation = " + bad.encode()))
    assert [fault for fault in plus.faults(path) if "Orientation" in fault]


@pytest.mark.parametrize(
    ("header", "orientation", "kind"),
    [
        ({"UltrasoundImageOrientation": "UN", "UltrasoundImageType": "RF_REAL"}, "UN", "RF_REAL"),
        ({"UltrasoundImageOrientation": "XX", "UltrasoundImageType": "XX"}, "MF", "BRIGHTNESS"),
        ({"ultrasound image orientation": "mna", "ultrasound image type": "RGB_COLOR"}, "MNA", "BRIGHTNESS"),
    ],
)
def test_the_orientation_of_the_source_is_kept(
    tmp_path: Path, header: dict[str, str], orientation: str, kind: str
) -> None:
    path = exported(tmp_path / "some.igs.mha", [image((5, 4, 1))], {"sequence_header": json.dumps(header)})
    fields = plus.read(path).fields
    assert (fields["UltrasoundImageOrientation"], fields["UltrasoundImageType"]) == (orientation, kind)


@pytest.mark.slow
@table("coordinate", [RAS, LPS])
@table(("size", "frames"), [((5, 4, 3), 1), ((5, 4, 3), 2), ((5, 4, 1), 1), ((5, 4, 1), 2)])
def test_itk_sees_images_where_they_were(
    tmp_path: Path, size: tuple[int, int, int], frames: int, coordinate: int
) -> None:
    directions = [*orientations(), *(orthonormal(OBLIQUE @ matrix) for matrix in orientations()[::6])]
    for direction in directions:
        numbers = np.array([*(direction * (0.7, 1.3, 2.9)).T.ravel(), -87.25, 133.5, 41.125], np.float32)
        one = image(size, coordinate=coordinate, wire_matrix=tuple(numbers.tolist()))
        path = exported(tmp_path / "some.igs.mha", [one] * frames)
        found = read(path)
        assert np.abs(corners(one) - itk_corners(found, size)).max() < MICROMETRE
        assert [np.abs(corners(one) - corners(again)).max() < MICROMETRE for again in images_of(path)] == [
            True
        ] * frames


@table("scalar", SCALARS)
@table("endian", [LITTLE_ENDIAN, BIG_ENDIAN])
def test_itk_sees_the_same_values(tmp_path: Path, scalar: int, endian: int) -> None:
    one = image((5, 4, 3), scalar, 3, endian=endian)
    found = read(exported(tmp_path / "some.igs.mha", [one]))
    import SimpleITK

    values = SimpleITK.GetArrayFromImage(found)
    assert values.dtype == np.dtype(SCALARS[scalar])
    assert np.array_equal(values, one.array.astype(values.dtype), equal_nan=values.dtype.kind == "f")


def test_images_that_move_have_their_place_in_each_frame(tmp_path: Path) -> None:
    shift = [image((5, 4, 1), wire_matrix=(0.5, 0, 0, 0, 0.5, 0, 0, 0, 1, x, 0, 7)) for x in (1.0, 2.0)]
    path = exported(tmp_path / "some.igs.mha", shift)
    assert plus.faults(path) == []
    found = plus.read(path)
    assert found.fields["TransformMatrix"] == "1 0 0 0 1 0 0 0 1"
    assert found.fields["Offset"] == "0 0 0"
    matrices = [fields["ImageToRasTransform"].split() for fields in found.frames.values()]
    assert [[float(row[index]) for index in (0, 5, 3, 7, 11)] for row in matrices] == [
        [0.5, 0.5, 0.0, -0.75, 7.0],
        [0.5, 0.5, 1.0, -0.75, 7.0],
    ]


def test_a_matrix_that_is_no_place_is_noted(tmp_path: Path) -> None:
    nan = replace(image((5, 4, 1)), wire_matrix=(float("nan"), *Image.IDENTITY[1:]))
    path = tmp_path / "some.igs.mha"
    account = export_sequence(InMemory([sent(0, "Scan", "IMAGE", nan)]), path, ())
    assert any("matrix of the images is invalid" in note for note in account.notes)
    assert read(path).GetDirection() == (1, 0, 0, 0, 1, 0, 0, 0, 1)
