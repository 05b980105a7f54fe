"""Headers of MetaImage: geometry with SimpleITK as referee, roles of axes, files beside, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addon import GatewayError
from igtl_gateway.addons.exchange.header import ImageFile
from igtl_gateway.addons.exchange.metaimage import MET_NAMES, read_metaimage
from igtl_gateway.addons.exchange.raster import COMPONENT, FRAME, RAW, SPACE, ZLIB
from tests.tables import table

USUAL = {
    "ObjectType": "Image",
    "NDims": "3",
    "DimSize": "2 3 4",
    "ElementType": "MET_SHORT",
    "ElementSpacing": "1 1 1",
    "Offset": "0 0 0",
    "ElementDataFile": "LOCAL",
}


def text(**changes: str | None) -> str:
    """A header; None leaves a field out.  The name of the file with the pixels is the last field."""
    fields = {key: value for key, value in (USUAL | changes).items() if value is not None}
    fields["ElementDataFile"] = fields.pop("ElementDataFile")
    return "".join(f"{key} = {value}\n" for key, value in fields.items())


def read(folder: Path, header: str, pixels: bytes = b"pixels") -> ImageFile:
    path = folder / "a.mha"
    path.write_bytes(header.encode() + pixels)
    with path.open("rb") as stream:
        return read_metaimage(path, stream)


def roles(found: ImageFile) -> list[str]:
    return [axis.role for axis in found.raster.axes]


def test_what_the_header_states(tmp_path: Path) -> None:
    found = read(tmp_path, text(BinaryDataByteOrderMSB="True", Comment="a = b"))
    raster = found.raster
    assert (raster.size, raster.components, raster.frames, raster.dtype) == ((2, 3, 4), 1, 1, "i2")
    assert (raster.big_endian, raster.packing, raster.data) == (True, RAW, tmp_path / "a.mha")
    assert (tmp_path / "a.mha").read_bytes()[raster.offset :] == b"pixels"
    assert not raster.is_beside and found.fields["Comment"] == "a = b" and not found.frames and not found.notes


@table(
    ("value", "set_"),
    [("True", True), ("true", True), ("T", True), ("1", True), ("yes", True), ("False", False), ("0", False)],
)
def test_words_for_true(value: str, set_: bool, tmp_path: Path) -> None:
    found = read(tmp_path, text(ElementByteOrderMSB=value, CompressedData=value)).raster
    assert (found.big_endian, found.packing) == (set_, ZLIB if set_ else RAW)


def test_types_have_the_sizes_of_metaio(tmp_path: Path) -> None:
    for dtype, name in MET_NAMES.items():
        assert read(tmp_path, text(ElementType=name)).raster.dtype == dtype
    assert read(tmp_path, text(ElementType="MET_LONG")).raster.dtype == "i4"
    assert read(tmp_path, text(ElementType="MET_ULONG")).raster.dtype == "u4"
    assert "MET_LONG" not in MET_NAMES.values()


_turns = st.integers(0, 2**32 - 1).map(lambda seed: np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0])
_numbers = st.integers(-500, 500).map(lambda number: number / 8)


@given(_turns, st.lists(st.integers(1, 80).map(lambda number: number / 16), min_size=3, max_size=3), st.data())
def test_geometry_is_that_of_itk(
    tmp_path_factory: pytest.TempPathFactory, turn: np.ndarray, spacing: list[float], data: st.DataObject
) -> None:
    """Written by ITK itself; in RAS, the first two axes of LPS are negative."""
    SimpleITK = pytest.importorskip("SimpleITK", reason="SimpleITK is the referee")  # noqa: N806
    origin = data.draw(st.lists(_numbers, min_size=3, max_size=3))
    image = SimpleITK.GetImageFromArray(np.zeros((4, 3, 2), np.int16))
    image.SetSpacing(spacing)
    image.SetOrigin(origin)
    image.SetDirection(turn.reshape(-1).tolist())
    path = tmp_path_factory.mktemp("itk") / "a.mha"
    SimpleITK.WriteImage(image, str(path))
    with path.open("rb") as stream:
        place = read_metaimage(path, stream).raster.place
    assert place is not None
    signs = np.array([-1.0, -1.0, 1.0])
    assert np.allclose(place.origin, signs * origin, atol=1e-6)
    for axis in range(3):
        index = [0, 0, 0]
        index[axis] = 1
        step = np.array(image.TransformIndexToPhysicalPoint(index)) - origin
        assert np.allclose(place.axes[axis], signs * step, atol=1e-5)


def test_names_of_one_field(tmp_path: Path) -> None:
    found = read(tmp_path, text(Offset=None, Position="1 2 3", ElementSpacing=None, ElementSize="4 5 6")).raster.place
    assert found is not None and found.origin == (-1.0, -2.0, 3.0)
    assert [abs(sum(axis)) for axis in found.axes] == [4.0, 5.0, 6.0]
    both = read(tmp_path, text(Origin="9 9 9", Offset="1 2 3")).raster.place
    assert both is not None and both.origin == (-1.0, -2.0, 3.0)


def test_a_header_without_a_position(tmp_path: Path) -> None:
    found = read(tmp_path, text(Offset=None, ElementSpacing=None))
    assert found.raster.place is None
    assert found.notes == ["the header has no position: the image is centred, with voxels of 1 mm"]


@table(
    ("changes", "found", "note"),
    [
        ({"DimSize": "2 3", "NDims": "2"}, [COMPONENT, SPACE, SPACE], ""),
        ({"ElementNumberOfChannels": "3"}, [COMPONENT, SPACE, SPACE, SPACE], ""),
        ({"Kinds": "domain domain list"}, [SPACE, SPACE, SPACE], "imported as one volume"),
        ({"Kinds": "domain domain TIME", "DimSize": "2 3 1"}, [SPACE, SPACE, FRAME], ""),
        ({"Kinds": "vector domain domain"}, [COMPONENT, SPACE, SPACE, FRAME], ""),  # PLUS: one frame
        (
            {"Kinds": "vector space space list", "DimSize": "3 2 3 4", "NDims": "4"},
            [COMPONENT, SPACE, SPACE, FRAME],
            "",
        ),
        ({"DimSize": "2 3 4 5", "NDims": "4"}, [SPACE, SPACE, SPACE, FRAME], "the fourth axis is imported as time"),
        ({"Seq_Frame0000_Timestamp": "0"}, [SPACE, SPACE, FRAME], ""),
        ({"Seq_Frame0000_Timestamp": "0", "DimSize": "2 3", "NDims": "3"}, [SPACE, SPACE, FRAME], ""),
    ],
)
def test_roles_of_axes(changes: dict[str, str], found: list[str], note: str, tmp_path: Path) -> None:
    numbers = len(changes.get("DimSize", "2 3 4").split())
    ones = " ".join(["1"] * max(numbers, len([each for each in found if each != COMPONENT])))
    read_ = read(tmp_path, text(**({"ElementSpacing": ones, "Offset": ones.replace("1", "0")} | changes)))
    assert [role for role in roles(read_) if role != COMPONENT or role in found] == found
    assert any(note in each for each in read_.notes) if note else not read_.notes


def test_pixels_beside(tmp_path: Path) -> None:
    (tmp_path / "a.raw").write_bytes(bytes(100))
    found = read(tmp_path, text(ElementDataFile="a.raw", HeaderSize="7")).raster
    assert (found.data, found.offset, found.is_beside) == (tmp_path / "a.raw", 7, True)
    assert read(tmp_path, text(ElementDataFile="a.raw", HeaderSize="-1")).raster.offset == -1
    assert read(tmp_path, text(ElementDataFile="local", HeaderSize="-1")).raster.data == tmp_path / "a.mha"


@table(
    ("changes", "times"),
    [
        ({}, (0.0, 0.5, 1.0)),
        ({"axis 3 index values": "5 6 8.5", "NRRD_units[3]": "s"}, (5.0, 6.0, 8.5)),
        ({"axis 3 index values": "5 6 8.5", "NRRD_labels[3]": "time"}, (5.0, 6.0, 8.5)),
        ({"axis 3 index values": "5 6 8.5", "NRRD_units[3]": "mm"}, (0.0, 0.5, 1.0)),
        ({"ElementSpacing": "1 1 1 0"}, ()),
        ({"ElementSpacing": "1 1 1 1e6"}, ()),
        ({"ElementSpacing": None}, ()),
    ],
)
def test_times_of_a_fourth_axis(changes: dict[str, str | None], times: tuple[float, ...], tmp_path: Path) -> None:
    usual = {"DimSize": "2 3 4 3", "NDims": "4", "ElementSpacing": "1 1 1 0.5", "Offset": "0 0 0 0"}
    assert read(tmp_path, text(**(usual | changes))).raster.times_s == times


def test_the_spacing_of_frames(tmp_path: Path) -> None:
    frames = {f"Seq_Frame000{number}_ElementSpacing": "0.5 0.25" for number in range(2)}
    found = read(tmp_path, text(DimSize="2 3 2", Kinds="domain domain list", **frames))
    assert found.notes == ["the spacing is that of the frames: 0.5 0.25"]
    assert found.raster.place is not None
    assert [abs(sum(axis)) for axis in found.raster.place.axes[:2]] == [0.5, 0.25]
    with pytest.raises(GatewayError, match=r"ElementSpacing: found 0\.5 0\.25 in frame 0 and 1 1 in frame 1, expected"):
        read(tmp_path, text(**(frames | {"Seq_Frame0001_ElementSpacing": "1 1"})))


def test_axes_that_run_the_other_way_are_noted(tmp_path: Path) -> None:
    found = read(tmp_path, text(ElementSpacing="1 -1 1"))
    assert found.notes == ["ElementSpacing has negative numbers: these axes run the other way, as in ITK"]


@table(
    ("header", "reason"),
    [
        (text().replace("ElementDataFile = LOCAL\n", ""), "found a header without ElementDataFile, expected one"),
        ("", "found a header without ElementDataFile"),
        (text(DimSize=None), "DimSize: found '', expected 2 … 5 sizes"),
        (text(DimSize="5"), "DimSize: found '5', expected 2 … 5 sizes"),
        (text(DimSize="2 3 x"), "DimSize: found 'x', expected an integer"),
        (text(DimSize="2 -3 4"), "found sizes"),
        (text(Kinds="domain domain"), "Kinds: found 'domain domain', expected one of"),
        (text(Kinds="domain domain colour"), "Kinds: found 'domain domain colour'"),
        (text(ElementNumberOfChannels="256"), "found 256 values per pixel"),
        (text(ElementType="MET_STRING"), "ElementType: found 'MET_STRING', expected one of MET_CHAR"),
        (text(BinaryData="False"), "BinaryData: found 'False', expected True"),
        (text(ElementDataFile="LIST"), "ElementDataFile: found 'LIST', expected one file for all slices"),
        (text(ElementDataFile="a%03d.raw"), "expected one file for all slices"),
        (text(ElementDataFile="a.raw", HeaderSize="-2"), "HeaderSize: found -2, expected -1 or more"),
        (text(ElementDataFile="../../etc/passwd"), "a.mha"),
        (text(Offset="0 0"), "Offset: found 2 numbers, expected 3"),
        (text(Offset="0 0 x"), "Offset: found 'x', expected a number"),
        (text(Offset="0 0 nan"), "expected finite millimetres"),
        (text(ElementSpacing="1 0 1"), "ElementSpacing: found 1 0 1, expected numbers other than 0"),
        (text(TransformMatrix="1 0 0 1 0 0 0 0 1"), "expected ones that span the image"),
        (
            text(DimSize="2 2 2 2", NDims="4", ElementSpacing="1 1 1 1", Offset="0 0 0 0",
                 TransformMatrix="1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1"),
            "TransformMatrix: found spatial axes with a time component, expected none",
        ),
        (
            text(DimSize="2 2 2 3", NDims="4", ElementSpacing="1 1 1 1", Offset="0 0 0 0",
                 **{"axis 3 index values": "1 2", "NRRD_units[3]": "s"}),
            "axis 3 index values: found 2 numbers, expected 3",
        ),
    ],
)  # fmt: skip
def test_what_is_refused(header: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(GatewayError) as error:
        read(tmp_path, header)
    assert reason in str(error.value) and str(tmp_path / "a.mha") in str(error.value)
    assert "\n" not in str(error.value)


def test_a_header_without_pixels_needs_no_type(tmp_path: Path) -> None:
    assert read(tmp_path, text(DimSize="0 0 2", ElementType=None)).raster.dtype == ""
