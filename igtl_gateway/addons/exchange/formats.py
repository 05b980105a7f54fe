"""The table of formats that can be imported; the first bytes determine the format, except for ``.zstd``."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.addon import ConfigError, GatewayError, NoSuchRecording, UnsupportedRecording
from igtl_gateway.addon.processes import extras, part_of
from igtl_gateway.addon.untrusted import files
from igtl_gateway.addons.exchange.capture import Capture, looks_like_igtl
from igtl_gateway.addons.exchange.export_verb_options import LEROBOT
from igtl_gateway.addons.exchange.itk_transform import looks_like_transform
from igtl_gateway.addons.exchange.markups import looks_like_markups
from igtl_gateway.addons.exchange.nifti import looks_like_nifti, read_nifti
from igtl_gateway.addons.exchange.pcap import Pcap
from igtl_gateway.addons.exchange.pcap_file import is_capture
from igtl_gateway.addons.exchange.rosbag1 import Rosbag1
from igtl_gateway.addons.exchange.rosbag2 import Rosbag2
from igtl_gateway.addons.exchange.rosbag2_metadata import METADATA
from igtl_gateway.addons.exchange.scene_in import SceneSource, looks_like_scene
from igtl_gateway.addons.exchange.sequence import DEFAULT_EPOCH_NS, Sequence
from igtl_gateway.addons.exchange.slicer_file import open_markups, open_transform
from igtl_gateway.addons.exchange.source import Source, library_errors_as_damage

#: This number of bytes at the start of a file shows its format.
START = 512
#: The number of a part in the name of a file of a bag, and what follows.
_PART = re.compile(r"_[0-9]+\.(db3|mcap).*$")
#: The file that shows a LeRobot data set.
_SET = Path("meta/info.json")
#: Suffix of a recipe for videos and tables of kinematics.
_RECIPE = ".toml"
#: The format of raw messages.
IGTL = "igtl"
_META_KEYS = (
    b"ObjectType", b"ObjectSubType", b"Comment", b"NDims", b"DimSize", b"BinaryData", b"CompressedData", b"Element",
    b"TransformMatrix", b"Offset", b"Position", b"Origin", b"CenterOfRotation", b"AnatomicalOrientation", b"Kinds",
    b"TransformType", b"ID", b"Name", b"Color", b"HeaderSize", b"Modality", b"UltrasoundImage", b"Seq_Frame",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ImportFormat:
    """A file format that can be imported.

    Attributes:
        name: stable name for the command line and for programs.
        what: such a file in words.
        suffixes: usual suffixes of such files.
        recognise: returns whether the first bytes of a file are of this format.
        open: opens a file, given the epoch in UTC ns from which times without a date count (None: the default of the
            format).
    """

    name: str
    what: str
    suffixes: tuple[str, ...]
    recognise: Callable[[bytes], bool]
    open: Callable[[Path, int | None], Source]


FORMATS = (
    ImportFormat(
        "rosbag1",
        "a bag of ROS 1",
        (".bag",),
        lambda start: start.startswith(b"#ROSBAG V"),
        lambda path, _epoch: Rosbag1(path),
    ),
    ImportFormat(
        "rosbag2",
        "a bag of rosbag2",
        (".mcap", ".db3"),
        lambda start: start.startswith((b"\x89MCAP0\r\n", b"SQLite format 3\0")),
        lambda path, _epoch: Rosbag2(path),
    ),
    ImportFormat(
        "sequence",
        "pictures of MetaImage or NRRD",
        (".igs.mha", ".mha", ".mhd", ".igs.nrrd", ".seq.nrrd", ".nrrd", ".nhdr"),
        lambda start: start.startswith(b"NRRD000") or _is_metaimage(start),
        Sequence,
    ),
    ImportFormat(
        "nifti",
        "a picture of NIfTI",
        (".nii", ".nii.gz"),
        looks_like_nifti,
        lambda path, epoch: Sequence(path, epoch, read_nifti),
    ),
    ImportFormat("scene", "a scene of 3D Slicer", (".mrb", ".mrml"), looks_like_scene, SceneSource),
    ImportFormat(
        "transform", "a transform of ITK", (".tfm", ".h5", ".mat", ".txt"), looks_like_transform, open_transform
    ),
    ImportFormat("markups", "markups of 3D Slicer", (".mrk.json", ".fcsv"), looks_like_markups, open_markups),
    ImportFormat(
        "pcap",
        "a capture of network traffic",
        (".pcap", ".cap", ".pcapng"),
        is_capture,
        lambda path, _epoch: Pcap(path),
    ),
    ImportFormat(IGTL, "a stream of OpenIGTLink messages", (".igtl",), looks_like_igtl, Capture),
)

_NOT_IMPORTED = "which has no times and is not imported"
_UNPACK = "which must be unpacked first"
_BY_RECIPE = "which `import` takes by a recipe (examples/kinematics.toml)"
_TABLE = "which no verb imports, but pandas and DuckDB read"
#: Files that often lie beside recordings: first bytes, suffix, what such a file is, and which program takes it.
_OTHERS = (
    (b"# vtk DataFile Version", ".vtk", "a model of VTK", _NOT_IMPORTED),
    (b"<VTKFile", ".vtp", "a model of VTK", _NOT_IMPORTED),
    (b"ply\n", ".ply", "a model of PLY", _NOT_IMPORTED),
    (b"ply\r\n", ".ply", "a model of PLY", _NOT_IMPORTED),
    (b"solid ", ".stl", "a model of STL", _NOT_IMPORTED),
    (b"", ".obj", "a model of OBJ", _NOT_IMPORTED),
    (b"", ".csv", "a table", _BY_RECIPE),
    (b"", ".tsv", "a table", _BY_RECIPE),
    (b"PAR1", ".parquet", "a table of Parquet", _TABLE),
    (b"ARROW1", ".arrow", "a table of Arrow", _TABLE),
    (b"RRF2", ".rrd", "a recording of rerun", "which the program rerun shows"),
    (b"\x89PNG", ".png", "a picture", _NOT_IMPORTED),
    (b"\xff\xd8\xff", ".jpg", "a picture", _NOT_IMPORTED),
    (b"", ".mp4", "a video", _BY_RECIPE),
    (b"", ".avi", "a video", "which no verb imports"),
    (b"PK\x03\x04", ".zip", "an archive", _UNPACK),
    (b"\x1f\x8b", ".gz", "an archive", _UNPACK),
    (b"\x28\xb5\x2f\xfd", ".zst", "an archive", _UNPACK),
    (b"", ".tar", "an archive", _UNPACK),
    (b"", ".toml", "a configuration", "which `bridge --config` and `resim --recipe` take"),
    (b"", ".urdf", "a robot", "which `view --urdf` takes"),
    (b"", ".xml", "XML", "which no verb reads"),
    (b"", ".json", "JSON", "which no verb reads"),
    (b"", ".log", "a log of a program", "which no verb reads"),
    (b"", ".txt", "text", "which no verb reads"),
)


def _is_metaimage(start: bytes) -> bool:
    """Return whether the first line is a field of MetaImage, whose fields have any order: ``Key = value``."""
    key, equals, _ = start.partition(b"\n")[0].partition(b"=")
    return bool(equals) and key.strip().startswith(_META_KEYS)


def format_of(start: bytes) -> ImportFormat | None:
    """Return the format of a file that begins with these bytes; None: none of the table."""
    return next((kind for kind in FORMATS if kind.recognise(start)), None)


def open_source(path: Path, epoch_ns: int | None = None, episodes: str = "") -> Source:
    """Open a file in any format of the table, the directory of a rosbag2 recording, or a LeRobot data set.

    Args:
        path: of it.
        epoch_ns: see ``ImportFormat.open``.
        episodes: of a data set, a number or a half-open range; "" for all.

    Raises UnsupportedRecording (no such file, unknown or unsupported format) or DamagedRecording; ConfigError.
    """
    if not path.exists():
        raise NoSuchRecording(f"{path}: no such file{files.near_file(path)}")
    if episodes and not is_set(path):
        raise ConfigError("--episodes: found it with another source, expected a LeRobot data set")
    opened: Source
    if path.is_dir():
        if is_set(path):
            with extras.in_use(LEROBOT):
                opened = part_of(LEROBOT, "set_source:open_set")(path, epoch_ns, DEFAULT_EPOCH_NS, episodes)
            return opened
        if is_bag(path):
            return Rosbag2(path)
        raise UnsupportedRecording(
            f"{path}: found a directory without {METADATA} and {_SET}, expected a rosbag2 recording or a LeRobot data "
            "set"
        )
    if path.suffix == _RECIPE:
        with extras.in_use(LEROBOT):
            opened = part_of(LEROBOT, "kinematics:open_kinematics")(path, epoch_ns, DEFAULT_EPOCH_NS)
        return opened
    with library_errors_as_damage(path), files.open_file(path) as stream:
        start = stream.read(START)
    if path.name.endswith(".zstd"):
        return Rosbag2(path)
    if kind := format_of(start):
        return kind.open(path, epoch_ns)
    suffixes = " ".join(suffix for kind in FORMATS for suffix in kind.suffixes)
    raise UnsupportedRecording(f"{path}: found {_found(path, start)}, expected one of these: {suffixes}")


def is_bag(folder: Path) -> bool:
    """Return whether a folder is a bag: it has the metadata of one, or its files are the parts of one, by their names.

    Recordings beside each other are not one.
    """
    if (folder / METADATA).exists():
        return True
    names = {path.name for pattern in ("*.db3*", "*.mcap*") for path in folder.glob(pattern)}
    return bool(names) and (len(names) == 1 or len({_PART.sub("", name) for name in names}) == 1)


def is_set(folder: Path) -> bool:
    """Return whether a folder is a LeRobot data set."""
    return (folder / _SET).is_file()


def what_is_foreign(path: Path) -> str:
    """Return what a file is that no import reads, and what takes it, in words; "" if neither is known."""
    try:
        with files.open_file(path) as stream:
            start = stream.read(START)
    except (GatewayError, OSError):
        return ""
    return _foreign(path, start)


def what_to_import(path: Path) -> str:
    """Return what a file or directory is that only an import reads, in words; "" for anything else.

    An MCAP file counts: whether it is a recording of this program, its caller knows.
    """
    try:
        if path.is_dir():
            return "a LeRobot data set" if is_set(path) else "a bag of rosbag2" if is_bag(path) else ""
        with files.open_file(path) as stream:
            start = stream.read(START)
    except (GatewayError, OSError):
        return ""
    if path.name.endswith((".db3.zstd", ".mcap.zstd")):
        return "a bag of rosbag2"
    kind = format_of(start)
    return kind.what if kind else ""


def _foreign(path: Path, start: bytes) -> str:
    """Return what a file in no format of the table is, by its first bytes, or else by its suffix; "" if unknown."""
    by_start = (each[2:] for each in _OTHERS if each[0] and each[0] in start[: len(each[0]) + 64])
    by_suffix = (each[2:] for each in _OTHERS if path.name.lower().endswith(each[1]))
    found = next(by_start, None) or next(by_suffix, None)
    return ", ".join(found) if found else ""


def _found(path: Path, start: bytes) -> str:
    return _foreign(path, start) or f"{start[:16]!r} at its start"
