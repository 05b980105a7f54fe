"""Tracked sequences: written here line by line, read by us."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.sequence import DEFAULT_EPOCH_NS, EPOCH_FIELD, TRANSFORM_STATUS, Sequence
from igtl_gateway.addons.exchange.source import ImportedItem
from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.wire import decode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.transform import Transform
from tests import plus_sequences
from tests.addons.exchange.itk import images_of
from tests.tables import table

WIDTH, HEIGHT, FRAMES = 4, 3, 3
PIXELS = bytes(range(WIDTH * HEIGHT * FRAMES))
STATUSES = ("OK", "INVALID", "OK")


def matrix(frame: int) -> str:
    return f"1 0 0 {frame}.5 0 1 0 -2 0 0 1 3 0 0 0 1"


def fields() -> list[tuple[str, str]]:
    told = []
    for frame in range(FRAMES):
        name = f"Seq_Frame{frame:04}_"
        told += [
            (f"{name}ProbeToTrackerTransform", matrix(frame)),
            (f"{name}ProbeToTrackerTransformStatus", STATUSES[frame]),
            (f"{name}Timestamp", f"{10 + frame}.123456789"),
            (f"{name}ImageStatus", "OK"),
        ]
    return told


def mha(path: Path, *, packed: bool = False, header: str = "", local: bool = True, pixels: bytes = PIXELS) -> Path:
    data = zlib.compress(pixels) if packed else pixels
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "BinaryDataByteOrderMSB = False",
        f"CompressedData = {packed}",
        f"DimSize = {WIDTH} {HEIGHT} {FRAMES}   ",
        "ElementType = MET_UCHAR",
        "UltrasoundImageOrientation = MF",
        *header.splitlines(),
        *(f"{key} = {value}" for key, value in fields()),
        f"ElementDataFile = {'LOCAL' if local else 'pixels.raw'}",
    ]
    if not local:
        (path.parent / "pixels.raw").write_bytes(data)
    path.write_bytes("\n".join(lines).encode() + b"\n" + (data if local else b""))
    return path


def nrrd(path: Path, *, packed: bool = False) -> Path:
    lines = [
        "NRRD0004",
        "# a comment",
        "type: uchar",
        "dimension: 3",
        f"sizes: {WIDTH} {HEIGHT} {FRAMES}",
        "kinds: domain domain list",
        f"encoding: {'gzip' if packed else 'raw'}",
        "UltrasoundImageOrientation:=MF",
        *(f"{key}:={value}" for key, value in fields()),
    ]
    path.write_bytes("\n".join(lines).encode() + b"\n\n" + (gzip.compress(PIXELS) if packed else PIXELS))
    return path


@dataclass
class Read:
    items: list[ImportedItem]
    source: Sequence

    def images(self) -> list[tuple[int, Image]]:
        return [(item.source_ns, content) for item, content in self._contents() if isinstance(content, Image)]

    def transforms(self) -> list[tuple[int, str, list[float]]]:
        return [
            (item.source_ns, item.channel, [row[3] for row in content.rows[:3]])
            for item, content in self._contents()
            if isinstance(content, Transform)
        ]

    def _contents(self) -> list[tuple[ImportedItem, object]]:
        return [(item, decode(item.payload).content) for item in self.items if item.kind is Kind.IGTL_IN]


def read(path: Path, epoch_ns: int | None = None) -> Read:
    with closing(Sequence(path, epoch_ns)) as source:
        return Read(list(source.items()), source)


def stamp(frame: int, epoch_ns: int = DEFAULT_EPOCH_NS) -> int:
    return epoch_ns + (10 + frame) * 1_000_000_000 + 123_456_789


@pytest.mark.parametrize("form", ["mha", "packed mha", "mhd", "packed mhd", "nrrd", "packed nrrd"])
def test_frames_become_transforms_and_images(tmp_path: Path, form: str) -> None:
    packed = form.startswith("packed")
    if form.endswith("nrrd"):
        told = read(nrrd(tmp_path / "some.igs.nrrd", packed=packed))
    else:
        told = read(mha(tmp_path / f"some.{form[-3:]}", packed=packed, local=form.endswith("mha")))
    size = WIDTH * HEIGHT
    assert [(at, bytes(image.pixels), image.dimensions) for at, image in told.images()] == [
        (stamp(frame), PIXELS[frame * size : (frame + 1) * size], (WIDTH, HEIGHT, 1)) for frame in range(FRAMES)
    ]
    assert all(image.wire_matrix == Image.IDENTITY for _, image in told.images())
    assert told.transforms() == [
        (stamp(frame), "TRANSFORM/ProbeToTracker", [frame + 0.5, -2.0, 3.0]) for frame in (0, 2)
    ]
    assert [(row.stream, row.declared, row.taken, row.left_out) for row in told.source.rows] == [
        ("ProbeToTracker", 3, 2, 1),
        ("Image", 3, 3, 0),
    ]
    assert '"UltrasoundImageOrientation": "MF"' in told.source.facts["sequence_header"]


def test_links_and_what_is_not_valid_are_noted(tmp_path: Path) -> None:
    items = read(mha(tmp_path / "some.mha")).items
    notes = [(item.kind, Note.unpack(bytes(item.payload))) for item in items if item.kind is not Kind.IGTL_IN]
    assert [(kind, note.code) for kind, note in notes] == [
        (Kind.LINK, "link_up"),
        (Kind.EDGE_NOTE, "imported"),
        (Kind.EDGE_NOTE, TRANSFORM_STATUS),
        (Kind.LINK, "link_down"),
    ]
    assert (notes[2][1].stream, notes[2][1].data["status"]) == ("TRANSFORM/ProbeToTracker", "INVALID")


def test_the_epoch_is_the_one_given_or_the_files_own(tmp_path: Path) -> None:
    path = mha(tmp_path / "some.mha", header=f"{EPOCH_FIELD} = 5000000000")
    assert read(path).images()[0][0] == stamp(0, 5_000_000_000)
    assert read(path, 7_000_000_000).images()[0][0] == stamp(0, 7_000_000_000)


def test_spacing_and_offset_place_the_image(tmp_path: Path) -> None:
    path = mha(tmp_path / "some.mha", header="ElementSpacing = 0.5 0.25 1\nOffset = 10 20 0")
    (_, image), *_ = read(path).images()
    # the file is LPS, the message RAS with the centre
    assert image.wire_matrix == (-0.5, 0, 0, 0, -0.25, 0, 0, 0, 1.0, -10.75, -20.25, 0.0)


def test_volumes_and_colours_over_time(tmp_path: Path) -> None:
    pixels = bytes(range(2 * 2 * 2 * 2 * 3))
    stamps = "".join(f"Seq_Frame000{frame}_Timestamp:={frame}\n" for frame in range(2))
    head = (
        "NRRD0005\ntype: uint8\ndimension: 5\nsizes: 3 2 2 2 2\nkinds: vector domain domain domain list\n"
        "space directions: none (0.5,0,0) (0,0.5,0) (0,0,2) none\nencoding: raw\n"
    )
    (tmp_path / "some.nrrd").write_bytes((head + stamps + "\n").encode() + pixels)
    images = [image for _, image in read(tmp_path / "some.nrrd").images()]
    assert [(image.dimensions, image.num_components) for image in images] == [((2, 2, 2), 3)] * 2
    assert b"".join(bytes(image.pixels) for image in images) == pixels
    assert images[0].wire_matrix[:9] == (-0.5, 0, 0, 0, -0.5, 0, 0, 0, 2.0)
    lines = ["NDims = 4", "DimSize = 2 2 3 2", "ElementType = MET_SHORT", "BinaryDataByteOrderMSB = True"]
    lines += [f"Seq_Frame000{frame}_Timestamp = {frame}" for frame in range(2)]
    (tmp_path / "some.mha").write_bytes("\n".join([*lines, "ElementDataFile = LOCAL", ""]).encode() + pixels)
    images = [image for _, image in read(tmp_path / "some.mha").images()]
    assert [(image.dimensions, image.scalar_type, image.endian) for image in images] == [((2, 2, 3), 4, 1)] * 2
    assert b"".join(bytes(image.pixels) for image in images) == pixels


def test_long_names_are_cut_and_stay_different(tmp_path: Path) -> None:
    path = mha(tmp_path / "some.mha")
    path.write_bytes(path.read_bytes().replace(b"ProbeToTracker", b"SomeVeryLongNameOfAProbeToTracker"))
    told = read(path)
    assert {channel for _, channel, _ in told.transforms()} == {"TRANSFORM/SomeVeryLongNameOfAP"}
    assert any("shortened to SomeVeryLongNameOfAP" in note for note in told.source.notes)


@pytest.mark.parametrize("packed", [False, True])
def test_missing_pixels_are_said(tmp_path: Path, packed: bool) -> None:
    path = mha(tmp_path / "some.mha", packed=packed, pixels=PIXELS[:20])
    with closing(Sequence(path)) as source:
        with pytest.raises(DamagedRecording, match="frame 1: found 8 bytes of pixels, expected 12"):
            list(source.items())
        assert not source.rows[1].good


def test_what_is_damaged_is_refused(tmp_path: Path) -> None:
    path = mha(tmp_path / "some.mha")
    path.write_bytes(path.read_bytes().replace(b"LOCAL", b"../../etc/passwd"))
    with pytest.raises(DamagedRecording, match="in the same folder"):
        Sequence(path)
    path.write_bytes(b"ObjectType = Image\nDimSize = 1 x 1\nElementDataFile = LOCAL\n")
    with pytest.raises(DamagedRecording, match=r"some\.mha: DimSize: found 'x', expected an integer"):
        Sequence(path)


@pytest.mark.parametrize(
    ("matrix", "why"),
    [
        ("nan 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "not finite"),
        ("1 0 0 inf 0 1 0 0 0 0 1 0 0 0 0 1", "not finite"),
        ("1 0 0 1e300 0 1 0 0 0 0 1 0 0 0 0 1", "beyond float32"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1", "its last row is not 0 0 0 1"),
    ],
)
def test_a_matrix_that_is_no_pose_is_left_out_and_counted(tmp_path: Path, matrix: str, why: str) -> None:
    path = tmp_path / "some.mha"
    good = "1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 1"
    frames = "".join(
        f"Seq_Frame{number:04}_AToBTransform = {text}\nSeq_Frame{number:04}_Timestamp = {number}\n"
        for number, text in enumerate((good, matrix, good))
    )
    path.write_text(
        f"ObjectType = Image\nNDims = 3\nDimSize = 0 0 3\nElementType = MET_UCHAR\n{frames}ElementDataFile = LOCAL\n"
    )
    with closing(Sequence(path)) as source:
        items = [item for item in source.items() if item.kind is Kind.IGTL_IN]
        (row,) = [row for row in source.rows if row.type == "TRANSFORM"]
    assert len(items) == 2 and (row.declared, row.taken, row.left_out) == (3, 2, 1) and why in row.why


#: Shapes of headers that PLUS writes → size, components and number of the images that they are.
SHAPES = {
    "a volume with the status of its one frame": (
        "NDims = 3\nDimSize = 34 15 3\nKinds = domain domain domain\nSeq_Frame0000_ImageStatus = OK",
        ((34, 15, 3), 1, 1),
    ),
    "a reconstructed volume of an old PLUS": (
        "NDims = 3\nDimSize = 14 10 4\nKinds = domain domain list",
        ((14, 10, 4), 1, 1),
    ),
    "one slice, without an axis of time": (
        "NDims = 2\nDimSize = 26 40\nKinds = domain domain\nSeq_Frame0000_Timestamp = 5",
        ((26, 40, 1), 1, 1),
    ),
    "one slice, with an axis of time in NDims only": (
        "NDims = 3\nDimSize = 26 40\nKinds = domain domain\nTransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 0 0 0\n"
        "ElementSpacing = 1 1 1\nSeq_Frame0000_Timestamp = 5",
        ((26, 40, 1), 1, 1),
    ),
    "colours as an axis of their own": (
        "NDims = 3\nDimSize = 3 8 6 2\nKinds = vector domain domain list\nElementNumberOfChannels = 3\n"
        "Seq_Frame0000_Timestamp = 5",
        ((8, 6, 1), 3, 2),
    ),
    "slices with a third dimension of 1": (
        "NDims = 4\nDimSize = 8 6 1 3\nKinds = domain domain domain list\nSeq_Frame0000_Timestamp = 5",
        ((8, 6, 1), 1, 3),
    ),
    "no Kinds: the last axis is time": ("NDims = 3\nDimSize = 8 6 3\nSeq_Frame0000_Timestamp = 5", ((8, 6, 1), 1, 3)),
    "a plain volume": ("NDims = 3\nDimSize = 8 6 3", ((8, 6, 3), 1, 1)),
    "a plain volume over time": ("NDims = 4\nDimSize = 8 6 3 2\nElementSpacing = 1 1 1 0.5", ((8, 6, 3), 1, 2)),
}


@table("shape", SHAPES)
def test_headers_of_plus_are_what_they_are(tmp_path: Path, shape: str) -> None:
    header, (size, components, count) = SHAPES[shape]
    total = size[0] * size[1] * size[2] * components * count
    pixels = (bytes(range(251)) * (total // 251 + 1))[:total]
    path = tmp_path / "some.mha"
    lines = ["ObjectType = Image", *header.splitlines(), "ElementType = MET_UCHAR", "ElementDataFile = LOCAL", ""]
    path.write_bytes("\n".join(lines).encode() + pixels)
    images = [image for _, image in read(path).images()]
    assert [(image.dimensions, image.num_components) for image in images] == [(size, components)] * count
    assert b"".join(bytes(image.pixels) for image in images) == pixels


def test_a_volume_over_time_has_its_times(tmp_path: Path) -> None:
    path = tmp_path / "some.mha"
    header = (
        "NDims = 4\nDimSize = 1 1 2 3\nElementSpacing = 1 1 1 0.25\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n"
    )
    path.write_bytes(header.encode() + bytes(6))
    assert [at - DEFAULT_EPOCH_NS for at, _ in read(path).images()] == [0, 250_000_000, 500_000_000]


def test_frames_keep_their_numbers_where_one_has_no_fields(tmp_path: Path) -> None:
    path = mha(tmp_path / "some.mha")
    path.write_bytes(path.read_bytes().replace(b"Seq_Frame0001", b"# Frame0001"))
    told = read(path)
    assert [at for at, _, _ in told.transforms()] == [stamp(0), stamp(2)]
    assert [at for at, _ in told.images()] == [stamp(0), stamp(0), stamp(2)]
    assert "frames without a time stamp: 1;" in " ".join(told.source.notes)


def test_frames_that_were_cut_out_begin_anywhere(tmp_path: Path) -> None:
    path = mha(tmp_path / "some.mha")
    data = path.read_bytes()
    for frame in reversed(range(FRAMES)):
        data = data.replace(b"Seq_Frame%04d" % frame, b"Seq_Frame%04d" % (frame + 40))
    path.write_bytes(data)
    assert [at for at, _ in read(path).images()] == [stamp(frame) for frame in range(FRAMES)]


@pytest.mark.parametrize("key", ["Status", "ImageStatus"])
def test_images_that_are_not_ok_are_left_out(tmp_path: Path, key: str) -> None:
    path = nrrd(tmp_path / "some.igs.nrrd")
    data = path.read_bytes().replace(b"Seq_Frame0001_ImageStatus:=OK", b"Seq_Frame0001_%s:=INVALID" % key.encode())
    path.write_bytes(data.replace(b"_ImageStatus", b"_" + key.encode()))
    told = read(path)
    assert [at for at, _ in told.images()] == [stamp(0), stamp(2)]
    row = told.source.rows[-1]
    assert (row.declared, row.taken, row.left_out, row.why) == (3, 2, 1, "image status INVALID")
    assert not any("not kept" in note for note in told.source.notes)


@pytest.mark.parametrize(("orientation", "noted"), [("MF", False), ("mfa", False), ("UN", True), ("FM", True)])
def test_orientations_that_plus_turns_are_noted(tmp_path: Path, orientation: str, noted: bool) -> None:
    path = mha(tmp_path / "some.mha")
    path.write_bytes(path.read_bytes().replace(b"Orientation = MF", b"Orientation = " + orientation.encode()))
    assert any("as in the file; PLUS converts them" in note for note in read(path).source.notes) == noted


def test_a_status_in_small_letters_is_one(tmp_path: Path) -> None:
    path = mha(tmp_path / "some.mha")
    path.write_bytes(path.read_bytes().replace(b"Status = OK", b"Status = ok"))
    told = read(path)
    assert (len(told.transforms()), len(told.images())) == (2, 3)


@pytest.mark.parametrize("text", ["1e999999999", "99999999999", "-1e12", "1e15"])
def test_stamps_out_of_range_are_an_error(tmp_path: Path, text: str) -> None:
    path = mha(tmp_path / "some.mha")
    path.write_bytes(path.read_bytes().replace(b"11.123456789", text.encode()))
    with closing(Sequence(path)) as source, pytest.raises(DamagedRecording, match="frame 1: found time stamp"):
        list(source.items())


@table(
    ("write", "transforms", "left_out", "images"),
    [
        (plus_sequences.ultrasound, 63, 0, 21),
        (plus_sequences.cropped, 60, 20, 20),
        (plus_sequences.ultrasound_of_old, 63, 0, 21),
        (plus_sequences.tracked, 186, 0, 0),
        (plus_sequences.numbered, 300, 0, 0),
        (plus_sequences.water_tank_video, 0, 0, 201),
        (plus_sequences.water_tank_tracker, 1580, 0, 0),
        (plus_sequences.touches, 2000, 0, 0),
    ],
)
def test_sequences_of_every_version_of_plus_come_whole(
    tmp_path: Path, write: Callable[[Path], Path], transforms: int, left_out: int, images: int
) -> None:
    with closing(Sequence(write(tmp_path / "some.igs.mha"))) as source:
        found = [item.type for item in source.items() if item.kind is Kind.IGTL_IN]
    assert (found.count("TRANSFORM"), found.count("IMAGE")) == (transforms, images)
    *tracked, pictures = source.rows
    assert all(row.good for row in source.rows)
    assert sum(row.left_out for row in tracked) == left_out
    assert pictures.declared == pictures.taken + pictures.left_out


@table(
    "first",
    [
        "CompressedData = False",
        "NDims = 3",
        "BinaryData = True",
        "ElementType = MET_UCHAR",
        "Kinds = domain domain list",
    ],
)
def test_the_fields_of_a_metaimage_have_any_order(tmp_path: Path, first: str) -> None:
    path = mha(tmp_path / "some.igs.mha")
    path.write_bytes(first.encode() + b"\n" + path.read_bytes())
    with closing(open_source(path)) as source:
        assert source.rows


@table(
    "beside, name",
    [
        (b"NRRD0004\ntype: unsigned char\n\n", "an NRRD file"),
        (b"ObjectType = Image\n", "a MetaImage file"),
        (b"\x89PNG\r\n\x1a\n", "a PNG file"),
        (gzip.compress(bytes(10)), "a gzip file"),
    ],
)
def test_a_file_with_a_header_is_no_pixel_file(tmp_path: Path, beside: bytes, name: str) -> None:
    path = mha(tmp_path / "some.igs.mhd", local=False)
    (tmp_path / "pixels.raw").write_bytes(beside + PIXELS)
    with pytest.raises(UnsupportedRecording, match=f"found {name} as its pixel file pixels.raw, .* import pixels.raw"):
        list(open_source(path).items())


def test_pixels_that_begin_as_a_header_are_pixels(tmp_path: Path) -> None:
    path = mha(tmp_path / "some.igs.mhd", local=False)
    (tmp_path / "pixels.raw").write_bytes(b"NRRD0" + PIXELS[5:])
    with closing(open_source(path)) as source:
        list(source.items())


@table(
    "rest, noted", [(b"", False), (b"\n", False), (b"\r\n", False), (b" more", True), (b" " * 40, True), (b"x", True)]
)
def test_bytes_after_the_last_pixel_are_noted_whatever_they_are(tmp_path: Path, rest: bytes, noted: bool) -> None:
    path = mha(tmp_path / "some.igs.mha", pixels=PIXELS + rest)
    with closing(open_source(path)) as source:
        list(source.items())
        assert any("bytes after the last pixel" in note for note in source.notes) == noted


def test_the_spacing_of_the_frames_is_that_of_the_images(tmp_path: Path) -> None:
    lines = "\n".join(f"Seq_Frame{number:04d}_ElementSpacing = 0.0256 0.0256 1" for number in range(FRAMES))
    path = mha(tmp_path / "some.igs.mha", header=f"ElementSpacing = 1 1 1\n{lines}")
    images = images_of(path)
    assert np.allclose([np.linalg.norm(images[0].wire_matrix[at : at + 3]) for at in (0, 3)], 0.0256)
    with closing(open_source(path)) as source:
        assert any("the spacing is that of the frames" in note for note in source.notes)
    other = lines.replace("Seq_Frame0001_ElementSpacing = 0.0256", "Seq_Frame0001_ElementSpacing = 0.5")
    with pytest.raises(UnsupportedRecording, match=r"found 0\.0256 0.0256 1 in frame 0 and 0.5 0.0256 1 in frame 1"):
        open_source(mha(tmp_path / "other.igs.mha", header=other))
