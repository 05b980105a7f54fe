"""Tracked sequences: written here line by line, read by us."""

from __future__ import annotations

import gzip
import zlib
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from igtl_gateway.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.exchange.sequence import DEFAULT_EPOCH_NS, EPOCH_FIELD, TRANSFORM_STATUS, Sequence
from igtl_gateway.exchange.source import Item
from igtl_gateway.session.entry import Kind
from igtl_gateway.session.note import Note
from igtl_gateway.wire import decode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.transform import Transform

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
    items: list[Item]
    source: Sequence

    def images(self) -> list[tuple[int, Image]]:
        return [(item.source_ns, content) for item, content in self._contents() if isinstance(content, Image)]

    def transforms(self) -> list[tuple[int, str, list[float]]]:
        return [
            (item.source_ns, item.channel, [row[3] for row in content.rows[:3]])
            for item, content in self._contents()
            if isinstance(content, Transform)
        ]

    def _contents(self) -> list[tuple[Item, object]]:
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
    assert image.wire_matrix == (0.5, 0, 0, 0, 0.25, 0, 0, 0, 1.0, 10.75, 20.25, 0.0)  # the centre


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
    assert images[0].wire_matrix[:9] == (0.5, 0, 0, 0, 0.5, 0, 0, 0, 2.0)
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
    assert any("cut to SomeVeryLongNameOfAP" in note for note in told.source.notes)


@pytest.mark.parametrize("packed", [False, True])
def test_missing_pixels_are_said(tmp_path: Path, packed: bool) -> None:
    path = mha(tmp_path / "some.mha", packed=packed, pixels=PIXELS[:20])
    with closing(Sequence(path)) as source:
        with pytest.raises(DamagedRecording, match="frame 1: found 8 bytes of pixels, expected 12"):
            list(source.items())
        assert not source.rows[1].good


def test_what_is_no_sequence_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "some.mha"
    path.write_bytes(b"ObjectType = Image\nDimSize = 1 1 1\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n\0")
    with pytest.raises(UnsupportedRecording, match="not a tracked sequence"):
        Sequence(path)
    mha(path)
    path.write_bytes(path.read_bytes().replace(b"LOCAL", b"../../etc/passwd"))
    with closing(Sequence(path)) as source, pytest.raises(UnsupportedRecording, match="beside it"):
        list(source.items())
    path.write_bytes(b"ObjectType = Image\nDimSize = 1 x 1\nElementDataFile = LOCAL\n")
    with pytest.raises(DamagedRecording, match=r"some\.mha"):
        Sequence(path)


@pytest.mark.parametrize(
    ("name", "transforms", "left_out", "images"),
    [
        ("ultrasound/BoneUltrasound_L14.igs.mha", 63, 0, 21),
        ("ultrasound/NwirePhantomFreehandCropped.igs.mha", 60, 20, 20),
        ("ultrasound/SpinePhantomFreehand.igs.mha", 63, 0, 21),
        ("ultrasound/fCal_Test_Calibration_3NWires.igs.mha", 564, 0, 188),
        ("tracking/ReferenceToRASCalibration.igs.mha", 186, 0, 0),
        ("tracking/WaterTankBottomTranslationTrackerBuffer-trimmed.igs.mha", 2403, 0, 0),
        ("lego/EightLandmarkPointsTrackedForPhantomRegistration.igs.mha", 2000, 0, 0),
    ],
)
def test_real_sequences_come_whole(shared_dir: Path, name: str, transforms: int, left_out: int, images: int) -> None:
    with closing(Sequence(shared_dir / "data" / name)) as source:
        found = [item.type for item in source.items() if item.kind is Kind.IGTL_IN]
    assert (found.count("TRANSFORM"), found.count("IMAGE")) == (transforms, images)
    *tracked, pictures = source.rows
    assert all(row.good for row in source.rows)
    assert sum(row.left_out for row in tracked) == left_out
    assert pictures.declared == pictures.taken + pictures.left_out
