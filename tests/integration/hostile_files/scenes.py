"""Hostile scenes of 3D Slicer (.mrb, .mrml, .seq.nrrd): zips, XML and sequences that lie.

Zips are written here, byte by byte: libraries do not write what is wrong.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

from tests.integration.hostile_files.case import ESCAPE, FORGED, MIB, Danger, Hostile, file
from tests.integration.hostile_files.images import nrrd

_MATRIX = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


# --- zips ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Part:
    """A file in a zip: what its head and the directory state of it; None: what is true.

    https://pkware.cachefly.net/webdocs/casestudies/APPNOTE.TXT
    """

    name: str | bytes
    data: bytes = b""
    method: int = 0
    size: int | None = None
    packed: int | None = None
    crc: int | None = None
    flags: int = 0
    mode: int = 0o100644
    local: str | None = None
    at: int | None = None


def zipped(parts: Iterable[Part], count: int | None = None, comment: bytes = b"") -> bytes:
    """A zip of these files, stored or already packed; ``count``: what its end states."""
    body, directory, written = bytearray(), bytearray(), 0
    for part in parts:
        name = part.name if isinstance(part.name, bytes) else part.name.encode()
        plain = zlib.decompress(part.data, -15) if part.method == 8 and part.size is None else part.data
        size = len(plain) if part.size is None else part.size
        crc = zlib.crc32(plain) if part.crc is None else part.crc
        packed = len(part.data) if part.packed is None else part.packed
        local = name if part.local is None else part.local.encode()
        at = len(body) if part.at is None else part.at
        head = struct.pack("<HHHHIII", part.flags, part.method, 0, 33, crc, packed, size)
        body += b"PK\x03\x04\x14\x00" + head + struct.pack("<HH", len(local), 0) + local + part.data
        directory += b"PK\x01\x02\x14\x03\x14\x00" + head
        directory += struct.pack("<HHHHHII", len(name), 0, 0, 0, 0, part.mode << 16, at) + name
        written += 1
    stated = min(0xFFFF, written) if count is None else count
    end = struct.pack("<HHHHIIH", 0, 0, stated, stated, len(directory), len(body), len(comment))
    return bytes(body + directory + b"PK\x05\x06" + end + comment)


@cache
def deflated_zeros(size: int) -> bytes:
    """Zeros as a raw deflate stream."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(bytes(size)) + packer.flush()


def _zeros(name: str, length: int, size: int | None = None) -> Part:
    return Part(name, deflated_zeros(length), 8, length if size is None else size, crc=0)


# --- documents -------------------------------------------------------------------------------------------------------


def mrml(*nodes: str, head: str = '<?xml version="1.0"?>', version: str = "Slicer5.8.0") -> str:
    """A document with these nodes."""
    return f'{head}\n<MRML version="{version}">\n' + "\n".join(nodes) + "\n</MRML>\n"


def pose(name: str = "T", matrix: str = _MATRIX, node: str = "t1", refers: str = "") -> str:
    """A transform that does not move."""
    links = f' references="{refers}"' if refers else ""
    return f'<LinearTransform id="{node}" name="{name}"{links} matrixTransformToParent="{matrix}"></LinearTransform>'


def moved(path: str, storage: str = "LinearTransformSequenceStorage", **values: str) -> str:
    """A sequence whose items are in a file."""
    given = {"indexUnit": "s", "indexType": "numeric", "name": "Q", **values}
    words = " ".join(f'{key}="{value}"' for key, value in given.items())
    return f'<Sequence id="s1" references="storage:k1;" {words}></Sequence><{storage} id="k1" fileName="{path}"/>'


def poses(matrix: str = _MATRIX, times: Iterable[str] = ("0.000", "0.100", "0.200"), extra: str = "") -> bytes:
    """A sequence of poses as Slicer writes it."""
    head = "ObjectType = Image\nNDims = 3\nDimSize = 0 0 3\nElementType = MET_UCHAR\nKinds = domain domain list\n"
    rows = "".join(
        f"Seq_Frame{at:04}_TTransform = {matrix}\nSeq_Frame{at:04}_Timestamp = {time}\n"
        for at, time in enumerate(times)
    )
    return f"{head}{extra}{rows}ElementDataFile = LOCAL\n".encode()


def scene(document: str | bytes, *parts: Part, count: int | None = None, comment: bytes = b"") -> bytes:
    """A bundle of a document and files beside it."""
    data = document if isinstance(document, bytes) else document.encode()
    return zipped((Part("S/S.mrml", data), *parts), count, comment)


_GOOD_POSES = Part("S/Data/q.seq.mha", poses())
_GOOD = partial(scene, mrml(pose(), moved("Data/q.seq.mha")), _GOOD_POSES)


def inner(name: str, *parts: Part, document: str) -> Part:
    """A scene in the scene, in which a sequence has its items."""
    return Part(f"S/Data/{name}.seq.mrb", zipped((Part(f"{name}/{name}.mrml", document.encode()), *parts)))


def _words(values: str, document: str = "", **more: str) -> bytes:
    nodes = document or mrml('<Text id="w1" name="W" text="x"></Text>')
    return scene(
        mrml(moved("Data/w.seq.mrb", "SequenceStorage", indexValues=values, **more)), inner("w", document=nodes)
    )


def _marks(content: str | bytes, name: str = "m.mrk.json") -> bytes:
    node = '<MarkupsFiducial id="m1" name="M" references="storage:k1;"></MarkupsFiducial>'
    data = content if isinstance(content, bytes) else content.encode()
    return scene(mrml(node + f'<MarkupsJsonStorage id="k1" fileName="{name}"/>'), Part(f"S/{name}", data))


def _volume(pixels: bytes = bytes(36), values: str = "0.000 0.100 0.200", beside: str = "") -> bytes:
    """A scene whose pictures have their pixels beside the header, if it names them."""
    more = (f"axis 2 index values:={values}", *((f"data file: {beside}",) if beside else ()))
    header = nrrd(b"" if beside else pixels, extra=more, frames=0, attached=not beside)
    kept = moved("Data/v.seq.nhdr" if beside else "Data/v.seq.nrrd", "VolumeSequenceStorage")
    name = "S/Data/v.seq.nhdr" if beside else "S/Data/v.seq.nrrd"
    return scene(mrml(kept), Part(name, header), Part("S/Data/v.raw", pixels))


def _pictures(values: str = "0.000 0.100 0.200", kinds: str = "domain domain list") -> bytes:
    """A sequence of pictures as a file of its own (``.seq.nrrd``)."""
    extra = (
        "space: left-posterior-superior",
        'labels: "" "" "" "time"',
        'units: "" "" "" "s"',
        "axis 3 index type:=numeric",
        f"axis 3 index values:={values}",
    )
    return nrrd(sizes="4 3 1 3", dimension="4", kinds=f"domain {kinds}", extra=extra, frames=0)


# --- the cases -------------------------------------------------------------------------------------------------------

_ENTITY = '<?xml version="1.0"?><!DOCTYPE MRML [{}]>'
#: Entities that would be 4^4 letters: enough to see that they are not followed.
_LAUGHS = _ENTITY.format(
    '<!ENTITY a "aaaa">' + "".join(f'<!ENTITY {n} "{4 * f"&{b};"}">' for b, n in ("ab", "bc", "cd"))
)
_OUTSIDE = _ENTITY.format('<!ENTITY x SYSTEM "file:///etc/hostname">')

Data = Callable[[], bytes]

_SCENES: tuple[tuple[str, Danger, str, Data], ...] = (
    # bombs
    (
        "zeros",
        Danger.BOMB,
        "256 MiB of zeros as poses",
        lambda: scene(mrml(moved("Data/q.seq.mha")), _zeros("S/Data/q.seq.mha", 256 * MIB)),
    ),
    (
        "zeros-document",
        Danger.BOMB,
        "256 MiB of zeros as the document",
        lambda: zipped([_zeros("S/S.mrml", 256 * MIB)]),
    ),
    (
        "zeros-unused",
        Danger.BOMB,
        "256 MiB of zeros that nothing names",
        lambda: scene(mrml(pose()), _zeros("S/x", 256 * MIB)),
    ),
    (
        "zeros-many",
        Danger.BOMB,
        "60 files of 60 MiB",
        lambda: scene(mrml(pose()), *(_zeros(f"S/{n}", 60 * MIB) for n in range(60))),
    ),
    (
        "zeros-inside",
        Danger.BOMB,
        "60 MiB of zeros in a scene in the scene",
        lambda: scene(
            mrml(moved("Data/w.seq.mrb", "SequenceStorage", indexValues="w1:0;")),
            Part(
                "S/Data/w.seq.mrb",
                zipped([Part("w/w.mrml", b"<MRML/>"), *(_zeros(f"w/{n}", 60 * MIB) for n in range(9))]),
            ),
        ),
    ),
    ("files", Danger.BOMB, "60,000 empty files", lambda: scene(mrml(pose()), *(Part(f"S/{n}") for n in range(60_000)))),
    ("nodes", Danger.BOMB, "150,000 nodes", lambda: scene(mrml(*(pose(node=f"t{n}") for n in range(150_000))))),
    ("one-attribute", Danger.BOMB, "an attribute of 40 MiB", lambda: scene(mrml(pose("T" * 40 * MIB)))),
    (
        "attributes",
        Danger.BOMB,
        "a node of 200,000 attributes",
        lambda: scene(mrml("<Text " + " ".join(f'a{n}="x"' for n in range(200_000)) + "/>")),
    ),
    ("deep", Danger.BOMB, "100,000 nodes in each other", lambda: scene(mrml("<A>" * 100_000 + "</A>" * 100_000))),
    ("indexes", Danger.BOMB, "one item at a million times", lambda: _words("w1:0;" * 1_000_000)),
    (
        "sequences",
        Danger.BOMB,
        "5,000 sequences of one file",
        lambda: scene(
            mrml(
                *(
                    moved("Data/w.seq.mrb", "SequenceStorage", indexValues="w1:0;").replace("s1", f"s{n}")
                    for n in range(5_000)
                )
            ),
            inner("w", document=mrml('<Text id="w1" name="W" text="x"/>' + "<A/>" * 5_000)),
        ),
    ),
    (
        "points",
        Danger.BOMB,
        "a million points",
        lambda: _marks(
            '{"markups":[{"type":"Fiducial","controlPoints":[' + ",".join(['{"position":[1,2,3]}'] * 1_000_000) + "]}]}"
        ),
    ),
    ("json-depth", Danger.BOMB, "points 100,000 lists deep", lambda: _marks('{"markups":' + "[" * 100_000)),
    (
        "number",
        Danger.BOMB,
        "a matrix with a number of 5,000,000 digits",
        lambda: scene(mrml(pose(matrix="9" * 5_000_000 + _MATRIX[1:]))),
    ),
    ("laughs", Danger.BOMB, "entities of entities", lambda: scene(mrml(pose("&d;"), head=_LAUGHS))),
    (
        "repeats",
        Danger.BOMB,
        "a long entity again and again",
        lambda: scene(mrml(pose("&a;" * 20), head=_ENTITY.format(f'<!ENTITY a "{"a" * 1_000}">'))),
    ),
    ("values-many", Danger.BOMB, "pictures with a million index values", lambda: _volume(values="0 " * 1_000_000)),
    # lies
    *(
        (
            f"cut-{tenth}0",
            Danger.LIE,
            f"a scene cut at {tenth}0 %",
            partial(lambda n: _GOOD()[: len(_GOOD()) * n // 10], tenth),
        )
        for tenth in range(1, 10)
    ),
    (
        "stored-larger",
        Danger.LIE,
        "a stored file that states 1 MiB",
        lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, size=MIB)),
    ),
    (
        "stored-smaller",
        Danger.LIE,
        "a stored file that states 10 bytes",
        lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, size=10)),
    ),
    (
        "stored-4g",
        Danger.LIE,
        "a stored file that states 4 GiB twice",
        lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, size=0xFFFFFFFE, packed=0xFFFFFFFE)),
    ),
    (
        "packed-smaller",
        Danger.LIE,
        "80 MiB that state 64 bytes",
        lambda: scene(mrml(moved("Data/q.seq.mha")), _zeros("S/Data/q.seq.mha", 80 * MIB, size=64)),
    ),
    (
        "packed-document",
        Danger.LIE,
        "a document of 80 MiB that states 64 bytes",
        lambda: zipped([_zeros("S/S.mrml", 80 * MIB, size=64)]),
    ),
    (
        "packed-garbage",
        Danger.LIE,
        "a packed file of noise",
        lambda: scene(mrml(moved("Data/q.seq.mha")), Part("S/Data/q.seq.mha", b"\xff" * 99, 8, size=99)),
    ),
    (
        "one-content",
        Danger.LIE,
        "fifty heads for one packed file",
        lambda: scene(mrml(pose()), *(replace(_zeros(f"S/{n}", MIB), at=0) for n in range(50))),
    ),
    ("crc", Danger.LIE, "a wrong checksum", lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, crc=1))),
    (
        "crc-document",
        Danger.LIE,
        "a document with a wrong checksum",
        lambda: zipped([Part("S/S.mrml", mrml(pose()).encode(), crc=1)]),
    ),
    (
        "local-name",
        Danger.LIE,
        "another name in the head than in the directory",
        lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, local="../../out")),
    ),
    (
        "place",
        Danger.LIE,
        "a file behind the end",
        lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, at=0xFFFFFFFE)),
    ),
    ("count-more", Danger.LIE, "an end that states 9 files", lambda: scene(mrml(pose()), count=9)),
    ("count-none", Danger.LIE, "an end that states no files", lambda: scene(mrml(pose()), count=0)),
    (
        "comment",
        Danger.LIE,
        "a comment that is a zip itself",
        lambda: scene(mrml(pose()), comment=scene(mrml(pose("Other")))[:60_000]),
    ),
    (
        "encrypted",
        Danger.LIE,
        "an encrypted file",
        lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, flags=1)),
    ),
    (
        "method",
        Danger.LIE,
        "a method that does not exist",
        lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, method=99, size=5)),
    ),
    (
        "method-lzma",
        Danger.LIE,
        "garbage as LZMA",
        lambda: scene(
            mrml(moved("Data/q.seq.mha")), Part("S/Data/q.seq.mha", b"\x09\x04\x05\x00" + b"\xff" * 90, 14, size=90)
        ),
    ),
    ("twice", Danger.LIE, "a name twice", lambda: scene(mrml(moved("Data/q.seq.mha")), _GOOD_POSES, _GOOD_POSES)),
    ("documents", Danger.LIE, "two documents", lambda: scene(mrml(pose()), Part("S/T.mrml", mrml(pose()).encode()))),
    ("no-document", Danger.LIE, "no document", lambda: zipped([_GOOD_POSES])),
    ("empty", Danger.LIE, "an empty zip", lambda: zipped([])),
    ("only-head", Danger.LIE, "the first bytes of a zip", lambda: b"PK\x03\x04" + bytes(60)),
    *(
        (
            f"member-{name}",
            Danger.LIE,
            f"a file {what}",
            partial(lambda path: scene(mrml(pose()), Part(path, b"x")), path),
        )
        for name, what, path in (
            ("above", "above the folder", "../../out.txt"),
            ("above-inside", "that leaves its folder", "S/../../out.txt"),
            ("absolute", "with an absolute name", "/tmp/out.txt"),
            ("drive", "on a drive", "C:out.txt"),
            ("backslash", "with backslashes", "S\\..\\..\\out.txt"),
            ("zero", "with a zero in its name", "S/a\0/../out.txt"),
            ("long", "with a name of 60,000 letters", "S/" + "a" * 60_000),
            ("dots", "named ..", ".."),
        )
    ),
    (
        "member-bytes",
        Danger.LIE,
        "a file whose name is no text",
        lambda: scene(mrml(pose()), Part(b"S/\xff\xfe\x80", b"x")),
    ),
    (
        "member-link",
        Danger.LIE,
        "a link out of the bundle",
        lambda: scene(mrml(moved("Data/q.seq.mha")), replace(_GOOD_POSES, data=b"/etc/hostname", mode=0o120777)),
    ),
    *(
        (
            f"reference-{name}",
            Danger.LIE,
            f"poses in {path}",
            partial(lambda path: scene(mrml(moved(path)), _GOOD_POSES), path),
        )
        for name, path in (
            ("above", "../../etc/hostname"),
            ("absolute", "/etc/hostname"),
            ("coded", "%2e%2e/%2e%2e/etc/hostname"),
            ("coded-absolute", "%2fetc%2fhostname"),
            ("url", "file:///etc/hostname"),
            ("host", "http://127.0.0.1:9/q.seq.mha"),
            ("drive", "C:\\q.seq.mha"),
            ("none", "Data/none.seq.mha"),
            ("itself", "S.mrml"),
            ("folder", "Data"),
            ("dot", "."),
            ("nothing", ""),
        )
    ),
    *(
        (f"pixels-{name}", Danger.LIE, f"pixels in {path}", partial(lambda path: _volume(beside=path), path))
        for name, path in (
            ("above", "../../../etc/hostname"),
            ("absolute", "/etc/hostname"),
            ("coded", "%2e%2e/v.raw"),
            ("list", "LIST"),
            ("pattern", "v%d.raw 1 3 1"),
            ("itself", "v.seq.nhdr"),
            ("none", "w.raw"),
        )
    ),
    ("pixels-few", Danger.LIE, "fewer pixels than the header states", lambda: _volume(bytes(5), beside="v.raw")),
    ("outside", Danger.LIE, "an entity that is a file", lambda: scene(mrml(pose("&x;"), head=_OUTSIDE))),
    (
        "outside-doctype",
        Danger.LIE,
        "a document type in another file",
        lambda: scene(mrml(pose(), head='<!DOCTYPE MRML SYSTEM "file:///etc/hostname">')),
    ),
    (
        "circle",
        Danger.LIE,
        "transforms below each other in a circle",
        lambda: scene(mrml(pose(refers="transform:t2;"), pose("U", node="t2", refers="transform:t1;"))),
    ),
    (
        "own-storage",
        Danger.LIE,
        "a sequence that is its own storage",
        lambda: scene(mrml('<Sequence id="s1" name="Q" indexUnit="s" references="storage:s1;" fileName="S.mrml"/>')),
    ),
    (
        "own-bundle",
        Danger.LIE,
        "a sequence in a bundle with a sequence in it",
        lambda: scene(
            mrml(moved("Data/w.seq.mrb", "SequenceStorage", indexValues="s1:0;")),
            inner("w", document=mrml(moved("Data/w.seq.mrb", "SequenceStorage"))),
        ),
    ),
    ("same-id", Danger.LIE, "two nodes of one identity", lambda: scene(mrml(pose("A"), pose("B")))),
    ("no-id", Danger.LIE, "nodes without identities", lambda: scene(mrml(pose(node=""), pose(node="")))),
    # shapes
    ("version-4", Danger.SHAPE, "a scene of 3D Slicer 4", lambda: scene(mrml(pose(), version="Slicer4.4.0"))),
    ("version-99", Danger.SHAPE, "a scene of 3D Slicer 99", lambda: scene(mrml(pose(), version="Slicer99.0.0"))),
    ("version-none", Danger.SHAPE, "a scene without a version", lambda: scene(f"<MRML>{pose()}</MRML>")),
    ("html", Danger.SHAPE, "another document", lambda: scene("<html></html>")),
    ("broken", Danger.SHAPE, "broken XML", lambda: scene("<MRML><A>")),
    ("no-text", Danger.SHAPE, "a document of other bytes than text", lambda: scene(b"\xff\xfe<\x00M\x00")),
    (
        "utf-16",
        Danger.SHAPE,
        "a document in UTF-16",
        lambda: scene(mrml(pose(), head='<?xml version="1.0" encoding="UTF-16"?>').encode("utf-16")),
    ),
    (
        "encoding",
        Danger.SHAPE,
        "an encoding that does not exist",
        lambda: scene(mrml(pose(), head='<?xml version="1.0" encoding="x-none"?>')),
    ),
    ("nothing", Danger.SHAPE, "a scene of nothing", lambda: scene(mrml())),
    ("unknown", Danger.SHAPE, "nodes of unknown kinds", lambda: scene(mrml('<Holo id="h1" name="H"/>' * 3))),
    *(
        (
            f"matrix-{name}",
            Danger.SHAPE,
            f"a matrix of {what}",
            partial(lambda text: scene(mrml(pose(matrix=text))), text),
        )
        for name, what, text in (
            ("words", "words", "a b c"),
            ("short", "15 numbers", _MATRIX[:-2]),
            ("long", "17 numbers", f"{_MATRIX} 1"),
            ("nan", "NaN", _MATRIX.replace("1", "nan")),
            ("infinite", "numbers beyond float64", _MATRIX.replace("1", "1e400")),
            ("huge", "numbers beyond float32", _MATRIX.replace("1", "1e300")),
            ("empty", "nothing", ""),
        )
    ),
    *(
        (
            f"poses-{name}",
            Danger.SHAPE,
            f"poses with {what}",
            partial(lambda data: scene(mrml(moved("Data/q.seq.mha")), Part("S/Data/q.seq.mha", data)), data),
        )
        for name, what, data in (
            ("nan", "NaN", poses(_MATRIX.replace("1", "nan"))),
            ("short", "15 numbers", poses(_MATRIX[:-2])),
            ("times", "times of words", poses(times=("a", "b", "c"))),
            ("back", "times that go back", poses(times=("2", "1", "0"))),
            ("far", "times in 10^300 s", poses(times=("0", "1", "1e300"))),
            ("none", "no content", b""),
            ("html", "a page", b"<html></html>"),
            ("dims", "a size of words", poses(extra="DimSize = a b c\n")),
        )
    ),
    *(
        (f"index-{name}", Danger.SHAPE, f"indexes: {what}", partial(_words, text))
        for name, what, text in (
            ("word", "a word", "w1:x;"),
            ("nan", "NaN", "w1:nan;"),
            ("negative", "before the start", "w1:-1e12;"),
            ("far", "10^300 s", "w1:1e300;"),
            ("no-colon", "without a colon", "w1;"),
            ("unknown", "of an unknown node", "w9:0;"),
            ("twice", "one node at two times", "w1:0; w1:1;"),
            ("none", "none", ""),
        )
    ),
    ("index-unit", Danger.SHAPE, "indexes in furlongs", lambda: _words("w1:0;", indexUnit="furlong")),
    ("index-text", Danger.SHAPE, "indexes that are words", lambda: _words("w1:a;", indexType="text")),
    (
        "begin",
        Danger.SHAPE,
        "a begin of 400 digits",
        lambda: scene(
            mrml(pose(), f'<SequenceBrowser id="b1" name="B" attributes="IgtlGateway.BeginNs:{"9" * 400}"/>')
        ),
    ),
    (
        "begin-word",
        Danger.SHAPE,
        "a begin that is a word",
        lambda: scene(mrml(pose(), '<SequenceBrowser id="b1" name="B" attributes="IgtlGateway.BeginNs:x;:;::"/>')),
    ),
    *(
        (f"marks-{name}", Danger.SHAPE, f"markups: {what}", partial(_marks, text))
        for name, what, text in (
            ("none", "no list", "{}"),
            ("list", "a list", "[1]"),
            ("two", "two lists of points", '{"markups":[{"type":"Fiducial"},{"type":"Fiducial"}]}'),
            ("nan", "NaN", '{"markups":[{"type":"Fiducial","controlPoints":[{"position":[1,2,NaN]}]}]}'),
            (
                "huge",
                "numbers of 400 digits",
                '{"markups":[{"type":"Fiducial","controlPoints":[{"position":[1,2,1' + "0" * 400 + "]}]}]}",
            ),
            (
                "unit",
                "in metres",
                '{"markups":[{"type":"Fiducial","coordinateUnits":"m","controlPoints":[{"position":[1,2,3]}]}]}',
            ),
            ("kind", "of an unknown kind", '{"markups":[{"type":"Star","controlPoints":[{"position":[1,2,3]}]}]}'),
            ("cut", "cut", '{"markups":[{"type":"Fid'),
        )
    ),
    (
        "marks-file",
        Danger.SHAPE,
        "markups in another format",
        lambda: _marks("# Markups fiducial file version = 4.0\n0,1,2,3\n", "m.fcsv"),
    ),
    ("plain-volume", Danger.SHAPE, "a volume without a file", lambda: scene(mrml('<Volume id="v1" name="V"/>'))),
    (
        "model",
        Danger.SHAPE,
        "a model whose file is no model",
        lambda: scene(
            mrml(pose(), '<Model id="m1" name="M" references="storage:k1;"/><ModelStorage id="k1" fileName="m.vtk"/>'),
            Part("S/m.vtk", b"\0" * 99),
        ),
    ),
    (
        "table",
        Danger.SHAPE,
        "a table of nothing",
        lambda: scene(
            mrml(pose(), '<Table id="a1" name="A" references="storage:k1;"/><TableStorage id="k1" fileName="a.tsv"/>'),
            Part("S/a.tsv", b""),
        ),
    ),
    # terminal
    (
        "name",
        Danger.TERMINAL,
        "a name with line feeds and marks of direction",
        lambda: scene(mrml(pose(f"a&#10;{FORGED}&#13;\u202e"))),
    ),
    ("names", Danger.TERMINAL, "the same in a sequence", lambda: _words("w1:0;", name=f"a&#10;{FORGED}\u202e")),
    (
        "kind-name",
        Danger.TERMINAL,
        "the same in an index and a unit",
        lambda: _words(f"a&#10;{FORGED}:0;", indexUnit=f"&#10;{FORGED}"),
    ),
    (
        "member-name",
        Danger.TERMINAL,
        "escape sequences in the name of a file",
        lambda: scene(mrml(pose()), Part(f"S/../{ESCAPE}\n{FORGED}", b"x")),
    ),
    (
        "member-name-twice",
        Danger.TERMINAL,
        "the same in a name that is there twice",
        lambda: scene(mrml(pose()), *[Part(f"S/{ESCAPE}\n{FORGED}", b"x")] * 2),
    ),
    (
        "reference",
        Danger.TERMINAL,
        "the same, coded, in a reference",
        lambda: scene(mrml(moved(f"Data/%1b]0;owned%07%0a{FORGED}".replace(" ", "%20")))),
    ),
    ("matrix", Danger.TERMINAL, "line feeds in a matrix", lambda: scene(mrml(pose(matrix=f"&#10;{FORGED}")))),
    (
        "marks-label",
        Danger.TERMINAL,
        "escape sequences in the label of a point",
        lambda: _marks(
            '{"markups":[{"type":"Fiducial","controlPoints":[{"label":"\\u001b[2J\\n'
            + FORGED
            + '","position":[1,2,3]}]}]}'
        ),
    ),
    (
        "marks-kind-name",
        Danger.TERMINAL,
        "the same in the kind",
        lambda: _marks('{"markups":[{"type":"\\u001b[2J\\n' + FORGED + '"}]}'),
    ),
    ("tag", Danger.TERMINAL, "marks of direction in a tag", lambda: scene("<MRML><A\u202e/></MRML>")),
    ("root", Danger.TERMINAL, "letters of other scripts in the root", lambda: scene(f"<{'Ж' * 900}></{'Ж' * 900}>")),
)

#: Documents without a bundle, and the links beside them.
_ALONE: tuple[tuple[str, Danger, str, Data], ...] = (
    ("good", Danger.SHAPE, "a document without a bundle", lambda: mrml(pose()).encode()),
    ("cut", Danger.LIE, "a cut document", lambda: mrml(pose(), moved("q.seq.mha")).encode()[:-40]),
    ("above", Danger.LIE, "poses above the folder", lambda: mrml(moved("../../../etc/hostname")).encode()),
    ("absolute", Danger.LIE, "poses in an absolute path", lambda: mrml(moved("/etc/hostname")).encode()),
    ("device", Danger.LIE, "poses in a device", lambda: mrml(moved("/dev/zero")).encode()),
    ("folder", Danger.LIE, "poses in a folder", lambda: mrml(moved(".")).encode()),
    ("none", Danger.LIE, "poses in a missing file", lambda: mrml(moved("Data/none.seq.mha")).encode()),
    ("laughs", Danger.BOMB, "entities of entities", lambda: mrml(pose("&d;"), head=_LAUGHS).encode()),
    ("outside", Danger.LIE, "an entity that is a file", lambda: mrml(pose("&x;"), head=_OUTSIDE).encode()),
    ("nodes", Danger.BOMB, "150,000 nodes", lambda: mrml(*(pose(node=f"t{n}") for n in range(150_000))).encode()),
)

_SEQUENCES: tuple[tuple[str, Danger, str, Data], ...] = (
    ("good", Danger.SHAPE, "pictures as 3D Slicer writes them", _pictures),
    *(
        (
            f"cut-{tenth}0",
            Danger.LIE,
            f"cut at {tenth}0 %",
            partial(lambda n: _pictures()[: len(_pictures()) * n // 10], tenth),
        )
        for tenth in (1, 4, 8, 9)
    ),
    *(
        (f"values-{name}", Danger.SHAPE, f"index values: {what}", partial(_pictures, text))
        for name, what, text in (
            ("few", "two of three", "0.000 0.100"),
            ("more", "four of three", "0 1 2 3"),
            ("words", "words", "a b c"),
            ("nan", "NaN", "nan nan nan"),
            ("back", "times that go back", "2 1 0"),
            ("far", "10^300 s", "0 1 1e300"),
            ("negative", "before the start", "-1e12 0 1"),
            ("none", "none", ""),
        )
    ),
    ("values-many", Danger.BOMB, "a million index values", lambda: _pictures("0 " * 1_000_000)),
    ("list-first", Danger.SHAPE, "a list as first axis", lambda: _pictures(kinds="list domain domain")),
    ("lists", Danger.SHAPE, "two lists", lambda: _pictures(kinds="domain list list")),
    ("line", Danger.TERMINAL, "escape sequences in the values", lambda: _pictures(f"{ESCAPE} {FORGED}\u202e")),
)


def _linked(folder: Path) -> Path:
    """A document beside a link to a file above its folder."""
    (folder / "Data").mkdir()
    (folder / "secret").write_bytes(poses())
    (folder / "scene").mkdir()
    (folder / "scene" / "q.seq.mha").symlink_to(folder / "secret")
    path = folder / "scene" / "scene.mrml"
    path.write_text(mrml(moved("q.seq.mha")))
    return path


CASES: tuple[Hostile, ...] = (
    *(
        Hostile(f"scene-{name}", "scene", danger, what, file(f"{name}.mrb", data))
        for name, danger, what, data in _SCENES
    ),
    *(
        Hostile(f"mrml-{name}", "scene", danger, what, file(f"{name}.mrml", data))
        for name, danger, what, data in _ALONE
    ),
    *(
        Hostile(f"seq-nrrd-{name}", "scene", danger, what, file(f"{name}.seq.nrrd", data))
        for name, danger, what, data in _SEQUENCES
    ),
    Hostile("mrml-link", "scene", Danger.LIE, "poses in a link out of the folder", _linked),
)
