"""Images and configurations, damaged where it hurts: ``cases(seed)`` gives them without end.

Strategy: headers of NRRD and MetaImage are lists of fields, of which some are bent, doubled, swapped or left out, while
the rest stays valid; the numbers of NIfTI pass through a :class:`~tools.import_mutations.Bend`; a configuration is
bent line by line and value by value.  Pixels are packed honestly, cut off or replaced.  The sequence of cases depends
on the seed only.
"""

from __future__ import annotations

import bz2
import gzip
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from random import Random

from igtl_gateway.config.configuration import Config
from tools.import_mutations import EDGES, TEXTS, Bend, Case

#: Words that stand where numbers do, and numbers that no image has.
_WORDS = ("nan", "inf", "-inf", "1e308", "1e-320", "-0", "0", "-1", "9" * 400, "1e9", "0x10", "1_0", "٣", *TEXTS)
_SIZES = ("4", "3", "1", "0", "-1", "65536", "99999999999", "4.5", "x", "")
_MATRIX = "1 0 0 10.5 0 1 0 -2 0 0 1 3 0 0 0 1"
_PIXELS = bytes(range(36))

Fields = list[tuple[str, str]]


def cases(seed: int) -> Iterator[Case]:
    """Damaged images without end."""
    rng = Random(seed)
    names = sorted(BUILDERS)
    while True:
        name = rng.choice(names)
        yield Case(name, BUILDERS[name](Bend(rng, rng.choice((0.0, 0.02, 0.05, 0.2)))))


def configurations(seed: int) -> Iterator[Case]:
    """Damaged configurations without end."""
    rng = Random(seed)
    while True:
        yield Case("toml", {"a.toml": toml(rng)})


# --- text headers ----------------------------------------------------------------------------------------------------


def _frames(bend: Bend, count: int) -> Fields:
    """The fields of the frames of a tracked sequence, as PLUS writes them."""
    fields: Fields = []
    for index in range(count):
        number = bend.number(index, 16) if bend.hit(0.3) else index
        name = f"Seq_Frame{number:04}_"
        fields += [
            (f"{name}{bend.text('ProbeToTracker')}Transform", _numbers(bend, _MATRIX)),
            (f"{name}ProbeToTrackerTransformStatus", bend.text("OK")),
            (f"{name}Timestamp", _numbers(bend, f"{10 + index}.25")),
            (f"{name}{bend.rng.choice(('ImageStatus', 'Status'))}", bend.text("OK")),
            (f"{name}{bend.text('Force')}", _numbers(bend, "1.5")),
        ]
    return fields


def _numbers(bend: Bend, text: str) -> str:
    """Numbers, of which some are bent, left out or doubled."""
    words = [str(bend.odd(word, _WORDS)) for word in text.split()]
    if bend.hit():
        words = words[: bend.rng.randrange(len(words) + 1)] * bend.rng.choice((1, 1, 2, 50))
    return " ".join(words)


def _bent(bend: Bend, fields: Fields) -> Fields:
    """Omit, duplicate, swap or change some fields."""
    kept = [(bend.text(key), bend.text(value)) for key, value in fields if not bend.hit(0.5)]
    if bend.hit() and kept:
        kept.insert(bend.rng.randrange(len(kept)), bend.rng.choice(kept))
    if bend.hit() and len(kept) > 1:
        one, other = bend.rng.sample(range(len(kept)), 2)
        kept[one], kept[other] = kept[other], kept[one]
    return kept


def _sizes(bend: Bend) -> str:
    shapes = ("4 3 3", "3 4 3", "4 3", "4 3 3 1", "3 2 2 3")
    return " ".join(str(bend.odd(size, _SIZES)) for size in bend.rng.choice(shapes).split())


def _pixels(bend: Bend, pack: Callable[[bytes], bytes] = bytes) -> bytes:
    data = pack(_PIXELS if not bend.hit() else bytes(bend.rng.choice((0, 1, 12, 35, 37, 1000))))
    return bend.data(data)


def metaimage(bend: Bend) -> dict[str, bytes]:
    """MetaImage: a sequence or a volume, with its pixels inside or beside it."""
    rng = bend.rng
    packed = rng.random() < 0.4
    local = rng.random() < 0.7
    sizes = _sizes(bend)
    fields: Fields = [
        ("ObjectType", "Image"),
        ("NDims", str(bend.odd(len(sizes.split()), _SIZES))),
        ("BinaryData", "True"),
        ("BinaryDataByteOrderMSB", str(rng.random() < 0.2)),
        ("CompressedData", str(packed)),
        ("TransformMatrix", _numbers(bend, "1 0 0 0 1 0 0 0 1")),
        ("Offset", _numbers(bend, "1 2 3")),
        ("CenterOfRotation", _numbers(bend, "0 0 0")),
        ("AnatomicalOrientation", bend.text("RAI")),
        ("ElementSpacing", _numbers(bend, "1 0.5 2")),
        ("DimSize", sizes),
        ("ElementType", str(bend.odd("MET_UCHAR", ("MET_SHORT", "MET_DOUBLE", "MET_LONG", "MET_X", "")))),
        ("ElementNumberOfChannels", str(bend.odd(rng.choice((1, 1, 3)), (0, -1, *EDGES)))),
        ("UltrasoundImageOrientation", bend.text("MF")),
        ("UltrasoundImageType", bend.text("BRIGHTNESS")),
        ("Kinds", bend.text("domain domain list")),
        ("HeaderSize", str(bend.odd(0, (-1, 5, *EDGES)))),
        ("CompressedDataSize", str(bend.odd(44, (-1, 5, *EDGES)))),
    ]
    chosen = [field for field in fields[:11] if rng.random() < 0.95] + [f for f in fields[11:] if rng.random() < 0.6]
    chosen += _frames(bend, rng.choice((0, 1, 3, 3, 3, 4)))
    pixels = _pixels(bend, zlib.compress if packed else bytes)
    name = bend.text("pixels.raw") if not local else "LOCAL"
    lines = [f"{key} = {value}" for key, value in _bent(bend, chosen)] + [f"ElementDataFile = {name}"]
    head = bend.data("\n".join(lines).encode("utf-8", "surrogatepass")) + b"\n"
    if local:
        return {"a.mha": head + pixels}
    return {"x/a.mhd": head, "x/pixels.raw": pixels}


_PACK: dict[str, Callable[[bytes], bytes]] = {
    "raw": bytes,
    "gzip": lambda data: gzip.compress(data, 1, mtime=0),
    "gz": lambda data: gzip.compress(data, 1, mtime=0),
    "bzip2": bz2.compress,
    "ascii": lambda data: b" ".join(b"%d" % each for each in data),
    "hex": lambda data: data.hex().encode(),
}


_KINDS = ("domain domain list", "list domain domain", "space space space", "vector domain domain", "domain domain time")
_DIRECTIONS = ("none", "(nan,0,0)", "(0,0,0)", "(1,2", "(((", "1,2,3")


def nrrd(bend: Bend) -> dict[str, bytes]:
    """NRRD: a sequence or a volume, with its pixels inside or beside it."""
    rng = bend.rng
    encoding = rng.choice(("raw", "raw", "gzip", "gz", "bzip2", "ascii", "hex"))
    attached = rng.random() < 0.7
    sizes = _sizes(bend)
    axes = len(sizes.split())
    kinds = " ".join(str(bend.odd(kind, TEXTS)) for kind in rng.choice(_KINDS).split())
    directions = " ".join(str(bend.odd(each, _DIRECTIONS)) for each in ("(1,0,0)", "(0,0.5,0)", "(0,0,2)"))
    fields: Fields = [
        ("type", str(bend.odd("uchar", ("short", "double", "block", "uint64", "", "x")))),
        ("dimension", str(bend.odd(axes, _SIZES))),
        ("sizes", sizes),
        ("encoding", encoding if not bend.hit() else bend.text("x")),
        ("kinds", kinds),
        ("endian", bend.text("little")),
        ("space", bend.text("left-posterior-superior")),
        ("space directions", directions),
        ("space origin", bend.text("(1,2,3)")),
        ("spacings", _numbers(bend, "1 0.5 2")),
        ("measurement frame", bend.text("(1,0,0) (0,1,0) (0,0,1)")),
        ("byte skip", str(bend.odd(0, (-1, -2, 5, *EDGES)))),
        ("line skip", str(bend.odd(0, (-1, 5, *EDGES)))),
    ]
    chosen = [field for field in fields[:5] if rng.random() < 0.97] + [f for f in fields[5:] if rng.random() < 0.4]
    if not attached:
        chosen.append(("data file", bend.text("pixels.raw")))
    chosen = _bent(bend, chosen)
    keys = _bent(bend, [("UltrasoundImageOrientation", "MF"), *_frames(bend, rng.choice((0, 1, 3, 3, 3, 4)))])
    lines = [
        bend.text("NRRD0005"),
        *(f"{key}: {value}" for key, value in chosen),
        *(f"{key}:={value}" for key, value in keys),
    ]
    head = bend.data("\n".join(lines).encode("utf-8", "surrogatepass")) + b"\n"
    pixels = _pixels(bend, _PACK[encoding])
    if attached:
        return {"a.nrrd": head + b"\n" + pixels}
    return {"x/a.nhdr": head, "x/pixels.raw": pixels}


def nifti(bend: Bend) -> dict[str, bytes]:
    """NIfTI-1, packed or not.  https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h"""
    rng = bend.rng
    order = rng.choice("<<<>")

    def short(value: int) -> int:
        return _signed(bend.number(value, 16))

    def real(value: float) -> float:
        return float(str(bend.odd(value, ("nan", "inf", "-inf", "1e30", "0", "-1", "1e-40"))))

    dims = [short(each) for each in (3, 4, 3, 3, 1, 1, 1, 1)]
    head = (
        struct.pack(f"{order}i", _signed(bend.number(348, 32), 32))
        + bytes(36)
        + struct.pack(f"{order}8h", *dims)
        + bytes(14)
    )
    datatype = int(str(bend.odd(rng.choice((2, 4, 16)), (0, 1, 8, 64, 128, 512, 1024, 9999))))
    head += struct.pack(f"{order}hhh8f", datatype, short(8), 0, *(real(each) for each in (1, 1, 0.5, 2, 1, 1, 1, 1)))
    head += struct.pack(f"{order}fff", real(352), real(1), real(0)) + bytes(28)
    head += bend.text("made here").encode("utf-8", "surrogatepass")[:80].ljust(80, b"\0") + bytes(24)
    head += struct.pack(f"{order}hh6f12f", short(1), short(rng.choice((0, 1, 2))), *(real(0.1) for _ in range(6)),
                        *(real(each) for each in (1, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7)))  # fmt: skip
    data = head + bytes(16) + bend.data(b"n+1\0")
    data = bend.data(data.ljust(352, b"\0") + _pixels(bend) * rng.choice((1, 4)))
    if rng.random() < 0.5:
        return {"a.nii": data}
    return {"a.nii.gz": bend.data(gzip.compress(data, 1, mtime=0))}


def _signed(value: int, bits: int = 16) -> int:
    return value - (1 << bits) if value >> (bits - 1) else value


#: Format → what builds its files.
BUILDERS: dict[str, Callable[[Bend], dict[str, bytes]]] = {"MetaImage": metaimage, "NRRD": nrrd, "NIfTI": nifti}


# --- configurations --------------------------------------------------------------------------------------------------

_VALUES = (
    "1",
    "-1",
    "1.5",
    "nan",
    "inf",
    "true",
    "''",
    '"a\\u001b[2J\\nb"',
    "[]",
    "[1]",
    "[[]]",
    "{}",
    "{a = 1}",
    "1979-05-27",
    "9" * 400,
    "[" * 70 + "]" * 70,
    '"' + "x" * 300 + '"',
    "'/tf'",
    "'mm'",
    "['pose']",
    "1e999",
    "0xff",
    "''''''",
)
_LINES = (
    "[gateway]",
    "[igtl]",
    "[[to_igtl]]",
    "[[to_ros]]",
    "[[tf_out]]",
    "[[peers]]",
    "[a.b.c]",
    "[[gateway]]",
    "x = 1",
    "\x1b[2J = 1",
    "topic = '/a'",
    "device = 'D'",
    "frames = ['tool']",
    "base = 'base'",
    "at = '10.0.0.1'",
    "a." * 100 + "b = 1",
    "# comment",
    "\udcff",
)


@cache
def _base() -> tuple[str, ...]:
    """The lines of a configuration that has every setting."""
    config = Config.from_dict(
        {
            "to_igtl": [{"topic": "/camera/image", "device": "Camera", "type": "IMAGE"}],
            "to_ros": [{"device": "Probe", "kinds": ["pose"]}],
            "tf_out": [{"frames": ["tool"], "base": "base", "device": "Tool", "type": "TRANSFORM"}],
            "peers": [{"at": "10.0.0.5:18944", "profile": "slicer"}],
        }
    )
    return tuple((config.to_toml() + "\n[igtl]\nlisten = ['127.0.0.1:0']\nallow = ['10.0.0.0/8']\n").split("\n"))


def toml(rng: Random) -> bytes:
    """A configuration in which some lines are changed."""
    lines = list(_base())
    for _ in range(rng.choice((1, 1, 2, 3, 8))):
        at = rng.randrange(len(lines))
        key, equals, _value = lines[at].partition(" = ")
        match rng.randrange(6):
            case 0 | 1 if equals:
                lines[at] = f"{key} = {rng.choice(_VALUES)}"
            case 2:
                lines.insert(at, rng.choice(_LINES))
            case 3:
                del lines[at]
            case 4:
                lines.insert(at, rng.choice(lines))
            case _:
                place = rng.randrange(len(lines[at]) + 1)
                lines[at] = lines[at][:place] + rng.choice(TEXTS) + lines[at][place + rng.randrange(3) :]
        if not lines:
            break
    data = "\n".join(lines).encode("utf-8", "surrogatepass")
    return data[: rng.randrange(len(data) + 1)] if rng.random() < 0.05 else data
