"""NRRD headers: spaces, kinds and times, with SimpleITK and pynrrd as referees."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.addons.exchange.sequence import DEFAULT_EPOCH_NS, Sequence
from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.wire.image import Image
from tests.addons.exchange.itk import MICROMETRE, corners, images_of, itk_corners, read
from tests.addons.exchange.test_pixels import nrrd
from tests.tables import table

VOLUME = ("type: uchar", "dimension: 3", "sizes: 4 3 2", "kinds: domain domain domain")
OBLIQUE = "space directions: (0.3,0.4,0) (-0.8,0.6,0.1) (0,0.5,2.5)"


@table(
    "space",
    [
        *("right-anterior-superior", "left-anterior-superior", "left-posterior-superior", "RAS", "LAS", "LPS"),
        *("scanner-xyz", "3D-right-handed", "3D-left-handed", ""),
    ],
)
def test_each_space_is_that_of_itk(tmp_path: Path, space: str) -> None:
    line = f"space: {space}" if space else "space dimension: 3"
    path = nrrd(tmp_path / "some.nrrd", bytes(24), *VOLUME, line, OBLIQUE, "space origin: (10,-20,30)")
    assert np.abs(corners(images_of(path)[0]) - itk_corners(read(path), (4, 3, 2))).max() < MICROMETRE
    noted = [note for note in Sequence(path).notes if "as in ITK" in note]
    assert bool(noted) == (space.lower()[:2] in {"sc", "3d", ""})


@pytest.mark.parametrize(
    "lines",
    [
        ("spacings: 1 2 3",),
        ("spacings: 1 2 3", "axis mins: 10 20 30"),
        ("spacings: 1 2 3", "axis mins: 10 20 30", "centers: cell cell cell"),
        ("spacings: -1 2 -3",),
        ("space: RAS", OBLIQUE),
        ("space: LPS", OBLIQUE, "space origin: (1,2,3)", 'space units: "cm" "cm" "cm"'),
    ],
)
def test_less_of_a_place_is_that_of_itk(tmp_path: Path, lines: tuple[str, ...]) -> None:
    path = nrrd(tmp_path / "some.nrrd", bytes(24), *VOLUME, *lines)
    assert np.abs(corners(images_of(path)[0]) - itk_corners(read(path), (4, 3, 2))).max() < MICROMETRE
    assert Sequence(path).notes


@pytest.mark.parametrize(
    ("centers", "spacing", "first"),
    [("cell", (1.0, 2.0, 4.0), (10.5, 11.0, 12.0)), ("node", (4 / 3, 3.0, 8.0), (10.0, 10.0, 10.0))],
)
def test_voxels_between_the_ends_of_their_axes(
    tmp_path: Path, centers: str, spacing: tuple[float, ...], first: tuple[float, ...]
) -> None:
    """As NRRD defines it; ITK ignores the upper ends, which a note states."""
    ends = ("axis mins: 10 10 10", "axis maxs: 14 16 18", f"centers: {centers} {centers} {centers}")
    path = nrrd(tmp_path / "some.nrrd", bytes(24), *VOLUME, *ends)
    found = corners(images_of(path)[0])
    assert np.allclose(found.min(axis=0), first) and np.allclose(np.ptp(found, axis=0), np.multiply(spacing, (3, 2, 1)))
    assert any("ITK reads voxels of 1 mm" in note for note in Sequence(path).notes)


def test_a_space_with_time_has_its_own_name(tmp_path: Path) -> None:
    """RAST is RAS with time, and its origin has the time of the first frame; ITK reads LPS."""
    lines = ("type: uchar", "dimension: 4", "sizes: 2 3 1 4", "kinds: domain domain domain domain", "space: RAST")
    directions = "space directions: (1,0,0,0) (0,1,0,0) (0,0,1,0) (0,0,0,0.5)"
    path = nrrd(tmp_path / "some.nrrd", bytes(24), *lines, directions, "space origin: (1,2,3,9)")
    assert np.allclose(images_of(path)[0].wire_matrix[9:], (1.5, 3.0, 3.0))
    with closing(Sequence(path)) as source:
        times = [item.time_ns - DEFAULT_EPOCH_NS for item in source.items() if item.kind is Kind.IGTL_IN]
        assert [time_ns / 1e9 for time_ns in times] == [9.0, 9.5, 10.0, 10.5]
        assert any("ITK reads it as LPS" in note for note in source.notes)


def test_a_step_that_is_none_is_no_time(tmp_path: Path) -> None:
    """3D Slicer has written a denormal number as time step."""
    lines = ("type: uchar", "dimension: 4", "sizes: 2 3 1 4", "kinds: domain domain domain domain")
    directions = "space directions: (1,0,0,0) (0,1,0,0) (0,0,1,0) (0,0,0,1.2e-313)"
    path = nrrd(tmp_path / "some.nrrd", bytes(24), *lines, "space dimension: 4", directions)
    assert any("the frames have no times" in note for note in Sequence(path).notes)


@table(
    ("unit", "step_s"),
    [("s", 1.0), ("sec", 1.0), ("seconds", 1.0), ("ms", 1e-3), ("msec", 1e-3), ("us", 1e-6), ("MSEC", 1e-3), ("", 0.0)],
)
def test_each_unit_of_times(tmp_path: Path, unit: str, step_s: float) -> None:
    lines = (
        "type: uchar",
        "dimension: 4",
        "sizes: 2 3 1 4",
        "kinds: domain domain domain list",
        "axis 3 index type:=numeric",
    )
    times = ("axis 3 index values:=0 1000 3000 4000", f"axis 3 index unit:={unit}")
    path = nrrd(tmp_path / "some.nrrd", bytes(24), *lines, *times)
    with closing(Sequence(path)) as source:
        found = [item.time_ns - DEFAULT_EPOCH_NS for item in source.items() if item.kind is Kind.IGTL_IN]
        if step_s:
            assert found == [round(each * step_s * 1e9) for each in (0, 1000, 3000, 4000)]
        else:
            assert any("are not times" in note for note in source.notes)


def test_no_place_at_all_is_noted(tmp_path: Path) -> None:
    path = nrrd(tmp_path / "some.nrrd", bytes(24), *VOLUME)
    assert images_of(path)[0].wire_matrix == Image.IDENTITY
    assert any("the header has no position" in note for note in Sequence(path).notes)


@pytest.mark.parametrize("first", [True, False])
def test_sequences_of_slicer(tmp_path: Path, first: bool) -> None:
    """Volumes over time as ``.seq.nrrd``: the list is the first axis in older files, the last in newer ones."""
    nrrd_module = pytest.importorskip("nrrd")
    data = np.arange(3 * 4 * 3 * 2, dtype=np.int16).reshape(3, 4, 3, 2)  # list, i, j, k
    none = [float("nan")] * 3
    axes = [[0.5, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 1.5, 0.0]]
    kinds, labels = ["domain"] * 3, [""] * 3
    header = {
        "space": "right-anterior-superior",
        "space directions": [none, *axes] if first else [*axes, none],
        "kinds": ["list", *kinds] if first else [*kinds, "list"],
        "labels": ["time", *labels] if first else [*labels, "time"],
        "space origin": [1.0, 2.0, 3.0],
        f"axis {0 if first else 3} index type": "numeric",
        f"axis {0 if first else 3} index values": "0 0.5 2.25",
        "DataNodeClassName": "vtkMRMLScalarVolumeNode",
    }
    path = tmp_path / "some.seq.nrrd"
    nrrd_module.write(str(path), data if first else np.moveaxis(data, 0, 3), header)
    with closing(Sequence(path)) as source:
        times = [item.source_ns - DEFAULT_EPOCH_NS for item in source.items() if item.kind is Kind.IGTL_IN]
    assert times == [0, 500_000_000, 2_250_000_000]
    images = images_of(path)
    assert [image.dimensions for image in images] == [(4, 3, 2)] * 3
    for number, image in enumerate(images):
        assert np.array_equal(image.array[..., 0].transpose(2, 1, 0), data[number])
        assert image.wire_matrix == (0.5, 0, 0, 0, 0, 2, 0, 1.5, 0, 1.75, 2.75, 5)


FRAMES = ("sizes: 4 3 2", "kinds: domain domain list", 'labels: "" "" "time"', 'units: "" "" "s"')


@pytest.mark.parametrize("version", ["NRRD0000", "NRRD0007", "NRRD0009", "NRRD00041"])
def test_another_version_is_refused(tmp_path: Path, version: str) -> None:
    path = tmp_path / "some.nrrd"
    path.write_bytes(f"{version}\ntype: uchar\nencoding: raw\nsizes: 4 3 2\n\n".encode() + bytes(24))
    with pytest.raises(UnsupportedRecording, match=f"line 1: found '{version}', expected NRRD0001 to NRRD0006"):
        images_of(path)


@table(
    ("lines", "text"),
    [
        (("sizes: 4 3 2", "dimension: 4"), "dimension '4'"),
        (("sizes: 4",), "one size for each"),
        (("sizes: 4 -3 2",), "expected 0 or more"),
        (("sizes: 4 3 x",), "expected an integer"),
        (("sizes: 4 3 2", "kinds: domain domain"), "kinds: found 2"),
        (("sizes: 4 3 2", "kinds: domain list list"), "axes space, time|expected 2 or 3 spatial axes|frame"),
        (("sizes: 4 3 2", "space: MARS"), "space: found 'MARS'"),
        (("sizes: 4 3 2", "space: RAS", "space directions: (1,0,0) (0,1,0)"), "found 2 vectors"),
        (("sizes: 4 3 2", "space: RAS", "space directions: (1,0,0) (0,1,0) (0,1)"), "4 for all"),
        (("sizes: 4 3 2", "space: RAS", "space directions: (1,0,0) (0,inf,0) (0,0,1)"), "finite"),
        (("sizes: 4 3 2", "space: RAS", "space directions: (1,0,0) (0,nan,0) (0,0,1)"), "finite"),
        (("sizes: 4 3 2", "space: RAS", "space directions: (1,0,0) (0,0,0) (0,0,1)"), "span"),
        (("sizes: 4 3 2", "spacings: 1 0 1"), "other than 0"),
        (("sizes: 4 3 2", "axis mins: 1 2 3"), "axis mins alone"),
        (("sizes: 4 3 2", "axis maxs: 1 2 3"), "axis maxs alone"),
        (("sizes: 4 3 2", "axis mins: 1 2 3", "axis maxs: 1 4 5"), "other than 0"),
        (("sizes: 4 3 2", "spacings: 1 1"), "found 2 numbers"),
        (("sizes: 70000 3 2",), "65535"),
        (("sizes: 300 4 3 2", "kinds: vector domain domain domain"), "values per pixel"),
        (("sizes: 4 3 2", "encoding: zrl"), "encoding: found 'zrl'"),
        (("sizes: 4 3 2", "type: block"), "type: found 'block'"),
        (("sizes: 4 3 2", "data file: LIST"), "one file"),
        (("sizes: 4 3 2", "data file: slice%03d.raw 1 2 1"), "one file"),
        (("sizes: 4 3 2", "data file: /etc/passwd"), "in the same folder"),
        (("sizes: 4 3 2", "data file: ../some.raw"), "in the same folder"),
        (("sizes: 4 3 2", "line skip: 3"), "line skip"),
        (("sizes: 4 3 2", "byte skip: -7"), "byte skip"),
        ((*FRAMES, "axis 2 index values:=0 1 2"), "axis 2 index values: found 3 numbers, expected 2"),
        ((*FRAMES, "axis 2 index values:=0"), "axis 2 index values: found 1 number, expected 2"),
        ((*FRAMES, "axis 2 index values:=0 nan"), "axis 2 index values: found 'nan', expected a finite number"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, lines: tuple[str, ...], text: str) -> None:
    path = tmp_path / "some.nrrd"
    path.write_bytes("\n".join(["NRRD0004", "type: uchar", "encoding: raw", *lines, "", ""]).encode() + bytes(24))
    with pytest.raises((DamagedRecording, UnsupportedRecording), match=text) as caught:
        images_of(path)
    assert str(path) in str(caught.value)
