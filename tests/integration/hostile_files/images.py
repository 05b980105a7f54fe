"""Hostile images: NRRD, MetaImage and NIfTI, whose headers declare place and size of the data."""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from tests.integration.hostile_files.case import (
    ESCAPE,
    FORGED,
    GIB,
    MIB,
    Danger,
    Hostile,
    bz2_zeros,
    file,
    gzip_zeros,
    zlib_zeros,
)

_MATRIX = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


def mha(
    pixels: bytes = bytes(36),
    size: str = "4 3 3",
    dims: str = "3",
    kind: str = "MET_UCHAR",
    packed: str = "False",
    extra: Sequence[str] = (),
    data_file: str = "LOCAL",
    frames: int = 3,
) -> bytes:
    """A tracked sequence as MetaImage; what is given is wrong where the caller wants it to be."""
    lines = [
        "ObjectType = Image",
        f"NDims = {dims}",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        f"CompressedData = {packed}",
        "Kinds = domain domain list",
        f"DimSize = {size}",
        f"ElementType = {kind}",
        "UltrasoundImageOrientation = MF",
        *extra,
    ]
    for number in range(frames):
        name = f"Seq_Frame{number:04}_"
        lines += [
            f"{name}ProbeToTrackerTransform = {_MATRIX}",
            f"{name}ProbeToTrackerTransformStatus = OK",
            f"{name}Timestamp = {10 + number}.5",
            f"{name}ImageStatus = OK",
        ]
    return "\n".join([*lines, f"ElementDataFile = {data_file}"]).encode("utf-8", "surrogateescape") + b"\n" + pixels


def nrrd(
    pixels: bytes = bytes(36),
    sizes: str = "4 3 3",
    dimension: str = "3",
    kind: str = "uchar",
    encoding: str = "raw",
    kinds: str = "domain domain list",
    extra: Sequence[str] = (),
    frames: int = 3,
    attached: bool = True,
) -> bytes:
    """A tracked sequence as NRRD."""
    lines = [
        "NRRD0005",
        f"type: {kind}",
        f"dimension: {dimension}",
        f"sizes: {sizes}",
        f"kinds: {kinds}",
        "endian: little",
        f"encoding: {encoding}",
        "UltrasoundImageOrientation:=MF",
        *extra,
    ]
    for number in range(frames):
        name = f"Seq_Frame{number:04}_"
        lines += [
            f"{name}ProbeToTrackerTransform:={_MATRIX}",
            f"{name}ProbeToTrackerTransformStatus:=OK",
            f"{name}Timestamp:={10 + number}.5",
            f"{name}ImageStatus:=OK",
        ]
    return "\n".join(lines).encode("utf-8", "surrogateescape") + b"\n" + (b"\n" + pixels if attached else b"")


def nifti(
    dims: Sequence[int] = (3, 4, 3, 3, 1, 1, 1, 1),
    datatype: int = 2,
    bits: int = 8,
    offset: float = 352.0,
    pixels: bytes = bytes(36),
    size: int = 348,
    description: bytes = b"",
    sform: Sequence[float] = (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0),
    slope: float = 1.0,
) -> bytes:
    """A volume as NIfTI-1.  https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h"""
    head = struct.pack("<i", size) + bytes(36) + struct.pack("<8h", *dims) + bytes(14)
    head += struct.pack("<hhh8ff", datatype, bits, 0, 1, 1, 1, 1, 1, 1, 1, 1, offset)
    head += struct.pack("<ff", slope, 0.0) + bytes(28)
    head = head.ljust(148, b"\0") + description[:80].ljust(80, b"\0") + bytes(24)
    head += struct.pack("<hh6f12f", 0, 1, 0, 0, 0, 0, 0, 0, *sform) + bytes(16) + b"n+1\0"
    return head.ljust(352, b"\0") + pixels


def _case(name: str, suffix: str, danger: Danger, what: str, data: Callable[[], bytes]) -> Hostile:
    return Hostile(f"{name}{suffix}".replace(".", "-"), "sequence", danger, what, file(f"{name}{suffix}", data))


def _refers(
    name: str, what: str, target: str, prepare: Callable[[Path], None] = lambda folder: None
) -> tuple[Hostile, Hostile]:
    """MetaImage and NRRD whose data are in another file."""

    def metaimage(folder: Path) -> Path:
        prepare(folder)
        path = folder / f"{name}.mhd"
        path.write_bytes(mha(b"", data_file=target))
        return path

    def detached(folder: Path) -> Path:
        prepare(folder)
        path = folder / f"{name}.nhdr"
        path.write_bytes(nrrd(extra=(f"data file: {target}",), attached=False))
        return path

    return (
        Hostile(f"{name}-mhd", "sequence", Danger.LIE, f"MetaImage whose data are {what}", metaimage),
        Hostile(f"{name}-nhdr", "sequence", Danger.LIE, f"NRRD whose data are {what}", detached),
    )


def _link(folder: Path) -> None:
    (folder / "pixels.raw").symlink_to("/etc/passwd")


_HUGE = (
    "99999999 99999999 99999999",
    "4 3 99999999999999999999999",
    "0 0 0",
    "4 3 1000000000",
    "-4 3 3",
    "4 3",
    "a b c",
    "1e9 3 3",
    "4 3 0",
    "0 3 2000000000",
)

CASES: tuple[Hostile, ...] = (
    # Bombs
    _case(
        "bomb",
        ".mha",
        Danger.BOMB,
        "MetaImage whose pixels decompress to 2 GiB, as declared",
        lambda: mha(zlib_zeros(2 * GIB), "32768 32768 2", packed="True"),
    ),
    _case(
        "bomb-lie",
        ".mha",
        Danger.BOMB,
        "MetaImage whose pixels unpack to 2 GiB, of which it claims 36 bytes",
        lambda: mha(zlib_zeros(2 * GIB), packed="True"),
    ),
    _case(
        "bomb",
        ".nrrd",
        Danger.BOMB,
        "NRRD whose pixels decompress to 2 GiB, as declared",
        lambda: nrrd(gzip_zeros(2 * GIB), "32768 32768 2", encoding="gzip"),
    ),
    _case(
        "bomb-lie",
        ".nrrd",
        Danger.BOMB,
        "NRRD whose pixels unpack to 2 GiB, of which it claims 36 bytes",
        lambda: nrrd(gzip_zeros(2 * GIB), encoding="gzip"),
    ),
    _case("bomb-bz2", ".nrrd", Danger.BOMB, "the same with bzip2", lambda: nrrd(bz2_zeros(2 * GIB), encoding="bzip2")),
    _case(
        "bomb",
        ".nii.gz",
        Danger.BOMB,
        "NIfTI that unpacks to 2 GiB",
        lambda: gzip.compress(nifti()) + gzip_zeros(2 * GIB),
    ),
    _case(
        "bomb-head",
        ".nii.gz",
        Danger.BOMB,
        "gzip of 2 GiB of zeros under the name of NIfTI",
        lambda: gzip_zeros(2 * GIB),
    ),
    _case(
        "bomb-nifti-frames",
        ".nii.gz",
        Danger.BOMB,
        "NIfTI that claims 32767^4 voxels",
        lambda: gzip.compress(nifti((4, 32767, 32767, 32767, 32767, 1, 1, 1)) + bytes(MIB)),
    ),
    _case(
        "bomb-header",
        ".mha",
        Danger.BOMB,
        "a header of 100 MiB without a line end",
        lambda: b"ObjectType = Image\nNDims = 3\nComment = " + b"x" * (100 * MIB),
    ),
    _case(
        "bomb-header",
        ".nrrd",
        Danger.BOMB,
        "the same as NRRD",
        lambda: b"NRRD0005\ntype: uchar\n# " + b"x" * (100 * MIB),
    ),
    # Lies
    *(
        _case(f"size-{number}", ".mha", Danger.LIE, f"MetaImage with the size `{size}`", partial(mha, size=size))
        for number, size in enumerate(_HUGE)
    ),
    *(
        _case(f"size-{number}", ".nrrd", Danger.LIE, f"NRRD with the sizes `{size}`", partial(nrrd, sizes=size))
        for number, size in enumerate(_HUGE)
    ),
    *(
        _case(f"dims-{number}", ".mha", Danger.LIE, f"MetaImage with {dims} dimensions", partial(mha, dims=dims))
        for number, dims in enumerate(("0", "-1", "99999999", "x", "9" * 5000))
    ),
    *(
        _case(
            f"dims-{number}",
            ".nrrd",
            Danger.LIE,
            f"NRRD with {dims} dimensions",
            partial(nrrd, dimension=dims),
        )
        for number, dims in enumerate(("0", "-1", "99999999", "x", "9" * 5000))
    ),
    _case(
        "frames-400000",
        ".mha",
        Danger.LIE,
        "fields of 400,000 frames, of which there are 3",
        lambda: mha(frames=0, extra=[f"Seq_Frame{n:04}_Timestamp = 1" for n in range(400_000)]),
    ),
    _case(
        "frame-number",
        ".mha",
        Danger.LIE,
        "a field of frame 999999999999",
        lambda: mha(
            extra=(
                "Seq_Frame999999999999_Timestamp = 1",
                "Seq_Frame-1_Timestamp = 1",
                f"Seq_Frame{'9' * 5000}_Timestamp = 1",
            )
        ),
    ),
    _case(
        "fields-300000", ".nrrd", Danger.LIE, "300,000 fields", lambda: nrrd(extra=[f"k{n}:=v" for n in range(300_000)])
    ),
    _case(
        "names-50000",
        ".mha",
        Danger.LIE,
        "50,000 transforms in one frame",
        lambda: mha(extra=[f"Seq_Frame0000_T{n}ToTrackerTransform = {_MATRIX}" for n in range(50_000)]),
    ),
    _case("data-short", ".mha", Danger.LIE, "pixels that end too early", lambda: mha(bytes(7))),
    _case("data-short", ".nrrd", Danger.LIE, "pixels that end too early", lambda: nrrd(bytes(7))),
    _case(
        "packed-garbage", ".mha", Danger.LIE, "invalid compressed pixels", lambda: mha(b"garbage" * 9, packed="True")
    ),
    _case(
        "packed-garbage",
        ".nrrd",
        Danger.LIE,
        "invalid compressed pixels",
        lambda: nrrd(b"garbage" * 9, encoding="gzip"),
    ),
    _case(
        "packed-short",
        ".mha",
        Danger.LIE,
        "packed pixels that end too early",
        lambda: mha(zlib.compress(bytes(36))[:-6], packed="True"),
    ),
    _case(
        "packed-size",
        ".mha",
        Danger.LIE,
        "a packed size of 2^62",
        lambda: mha(zlib.compress(bytes(36)), packed="True", extra=("CompressedDataSize = 4611686018427387904",)),
    ),
    _case(
        "skip",
        ".nrrd",
        Danger.LIE,
        "an endless number of bytes and lines to skip",
        lambda: nrrd(extra=("byte skip: 99999999999999", "line skip: 99999999999")),
    ),
    _case("skip-negative", ".nrrd", Danger.LIE, "bytes to skip below 0", lambda: nrrd(extra=("byte skip: -99999",))),
    _case(
        "header-size",
        ".mha",
        Danger.LIE,
        "an endless header size",
        lambda: mha(extra=("HeaderSize = 99999999999999999",)),
    ),
    *_refers("path", "/etc/passwd", "/etc/passwd"),
    *_refers("path-up", "in a folder above", "../../../../../etc/passwd"),
    *_refers("path-device", "/dev/zero", "/dev/zero"),
    *_refers("path-fifo", "a FIFO", "pixels.raw", lambda folder: os.mkfifo(folder / "pixels.raw")),
    *_refers("path-link", "a link out of the folder", "pixels.raw", _link),
    *_refers("path-self", "the header itself", "path-self.mhd"),
    *_refers("path-folder", "a folder", "."),
    *_refers("path-missing", "a file that is not there", f"x{ESCAPE}.raw"),
    *_refers("path-list", "a list of files", "LIST"),
    *_refers("path-pattern", "files by an endless pattern", "pixels%03d.raw 0 999999999 1"),
    # Wrong shapes
    *(
        _case(
            f"stamp-{number}",
            ".mha",
            Danger.SHAPE,
            f"the time stamp `{stamp[:20]}`",
            partial(
                mha,
                frames=1,
                size="4 3 1",
                pixels=bytes(12),
                extra=(f"Seq_Frame0000_Timestamp = {stamp}",),
            ),
        )
        for number, stamp in enumerate(("nan", "inf", "-1e300", "1e300", "9" * 400, "", "x"))
    ),
    *(
        _case(
            f"matrix-{number}",
            ".mha",
            Danger.SHAPE,
            f"the matrix `{matrix[:20]}`",
            partial(mha, extra=(f"Seq_Frame0001_StylusToTrackerTransform = {matrix}",)),
        )
        for number, matrix in enumerate(("nan " * 16, "1e308 " * 16, "1 2 3", "x " * 16, "1 " * 5000, ""))
    ),
    *(
        _case(
            f"spacing-{number}",
            suffix,
            Danger.SHAPE,
            f"a spacing of `{value}`",
            partial(make, value),
        )
        for suffix, make in (
            (".mha", lambda value: mha(extra=(f"ElementSpacing = {value}",))),
            (".nrrd", lambda value: nrrd(extra=(f"spacings: {value}",))),
        )
        for number, value in enumerate(("nan nan nan", "0 0 0", "1e-320 1 1", "x y z", "1"))
    ),
    *(
        _case(
            f"geometry-{number}",
            suffix,
            Danger.SHAPE,
            f"axes that are `{value[:24]}`",
            partial(make, value),
        )
        for suffix, make, values in (
            (
                ".mha",
                lambda value: mha(extra=(f"TransformMatrix = {value}", "Offset = nan inf 1e308")),
                ("0 0 0 0 0 0 0 0 0", "nan " * 9, "1 2", "x"),
            ),
            (
                ".nrrd",
                lambda value: nrrd(
                    extra=(
                        "space: left-posterior-superior",
                        f"space directions: {value}",
                        "space origin: (nan,inf,1e308)",
                    )
                ),
                ("(0,0,0) (0,0,0) none", "(nan,1,1) (1,1,1) none", "(((((", "none none none none none"),
            ),
        )
        for number, value in enumerate(values)
    ),
    _case("type", ".mha", Danger.SHAPE, "an unknown type of elements", lambda: mha(kind=f"MET_X{ESCAPE}")),
    _case("type", ".nrrd", Danger.SHAPE, "an unknown type of elements", lambda: nrrd(kind="block")),
    _case("encoding", ".nrrd", Danger.SHAPE, "an unknown encoding", lambda: nrrd(encoding=f"zip{ESCAPE}")),
    _case(
        "channels", ".mha", Danger.SHAPE, "2^31 channels", lambda: mha(extra=("ElementNumberOfChannels = 2147483648",))
    ),
    _case("kinds", ".nrrd", Danger.SHAPE, "kinds that are more than axes", lambda: nrrd(kinds="list " * 5000)),
    _case(
        "no-utf8",
        ".mha",
        Danger.SHAPE,
        "a header that is invalid UTF-8",
        lambda: mha(extra=("Comment = \udcff\udcfe",)),
    ),
    _case(
        "no-utf8",
        ".nrrd",
        Danger.SHAPE,
        "a header that is invalid UTF-8",
        lambda: nrrd(extra=("content: \udcff\udcfe",)),
    ),
    _case(
        "empty-lines",
        ".mha",
        Danger.SHAPE,
        "lines without a key or a value",
        lambda: mha(extra=("", " = ", "=", "x", " " * 1000)),
    ),
    *(
        _case(f"nifti-{number}", ".nii", Danger.SHAPE, f"NIfTI with {what}", data)
        for number, (what, data) in enumerate(
            (
                ("dimensions of −1", lambda: nifti((3, -1, 3, 3, 1, 1, 1, 1))),
                ("99 dimensions", lambda: nifti((99, 4, 3, 3, 1, 1, 1, 1))),
                ("an unknown data type", lambda: nifti(datatype=9999)),
                ("data at 1e30", lambda: nifti(offset=1e30)),
                ("data at NaN", lambda: nifti(offset=float("nan"))),
                ("a header of 2^31 − 1 bytes", lambda: nifti(size=(1 << 31) - 1)),
                ("axes of NaN", lambda: nifti(sform=(float("nan"),) * 12)),
                ("axes of 0", lambda: nifti(sform=(0,) * 12)),
                ("a slope of infinity", lambda: nifti(slope=float("inf"))),
                ("32767 × 32767 × 32767 voxels", lambda: nifti((3, 32767, 32767, 32767, 1, 1, 1, 1))),
                ("no pixels", lambda: nifti(pixels=b"")),
                ("escape sequences in its description", lambda: nifti(description=f"{ESCAPE}\n{FORGED}".encode())),
            )
        )
    ),
    # Terminal
    _case(
        "terminal-name",
        ".mha",
        Danger.TERMINAL,
        "escape sequences in the name of a transform",
        lambda: mha(
            extra=(
                f"Seq_Frame0000_A{ESCAPE}ToBTransform = {_MATRIX}",
                f"Seq_Frame0000_A{ESCAPE}ToBTransformStatus = OK",
            )
        ),
    ),
    _case(
        "terminal-field",
        ".mha",
        Danger.TERMINAL,
        "the same in keys and values",
        lambda: mha(
            extra=(
                f"Key{ESCAPE} = Value{ESCAPE}",
                f"UltrasoundImageOrientation = {ESCAPE}",
                f"UltrasoundImageType = {ESCAPE}",
            )
        ),
    ),
    _case(
        "terminal-status",
        ".mha",
        Danger.TERMINAL,
        "the same in the status of a frame",
        lambda: mha(
            extra=(f"Seq_Frame0001_ImageStatus = {ESCAPE}", f"Seq_Frame0001_ProbeToTrackerTransformStatus = {ESCAPE}")
        ),
    ),
    _case(
        "terminal-field",
        ".nrrd",
        Danger.TERMINAL,
        "the same in NRRD",
        lambda: nrrd(extra=(f"Key{ESCAPE}:=Value{ESCAPE}", f"content: {ESCAPE}", f"measurement frame: {ESCAPE}")),
    ),
    _case(
        "terminal-space",
        ".nrrd",
        Danger.TERMINAL,
        "the same in the name of a space",
        lambda: nrrd(extra=(f"space: {ESCAPE}",)),
    ),
    Hostile(
        "terminal-file-name",
        "sequence",
        Danger.TERMINAL,
        "the same in the file name",
        file(f"a{ESCAPE}\n{FORGED}.mha".replace("/", ""), mha),
    ),
)
