"""Files of 3D Slicer, damaged where it hurts: ``cases(seed)`` gives them without end.

Strategy: scenes are bundles whose nodes, references, indexes and files pass through a
:class:`~tools.import_mutations.Bend`; transforms are text, MATLAB level 4 and a small HDF5 that ITK's readers take;
markups are JSON and tables.  Then some files are cut or have bits flipped.  The sequence of cases depends on the seed
only.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable, Iterator
from random import Random
from typing import Any
from xml.sax.saxutils import quoteattr

from tools.import_mutations import EDGES, Bend, Case

_WORDS = ("nan", "inf", "-1e308", "1e400", "9" * 400, "x", "", "-0", "1e-320")
_NAMES = ("../../etc/passwd", "/etc/passwd", "a\\b", "C:x", "", "x.mrml", "Data/a.seq.mha", "Data", ".", "\u202e")
_MATRIX = "1 0 0 10.5 0 1 0 -2 0 0 1 3 0 0 0 1"
_KINDS = ("AffineTransform", "Euler3DTransform", "TranslationTransform", "CompositeTransform", "BSplineTransform", "X")
_SIZES = (12, 6, 3, 0, 1, 2)


def cases(seed: int) -> Iterator[Case]:
    """Damaged files without end."""
    rng = Random(seed)
    names = sorted(BUILDERS)
    while True:
        name = rng.choice(names)
        suffix, build = BUILDERS[name]
        data = build(Bend(rng, rng.choice((0.0, 0.02, 0.05, 0.2))))
        damage = rng.choice(("", "", "", "cut", "flip"))
        if damage == "cut":
            data = data[: rng.randrange(len(data) + 1)]
        elif damage and data:
            changed = bytearray(data)
            for _ in range(rng.randint(1, 6)):
                changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
            data = bytes(changed)
        yield Case(f"{name} {damage}".strip(), {f"a{suffix}": data})


def _numbers(bend: Bend, text: str) -> str:
    words = [str(bend.odd(word, _WORDS)) for word in text.split()]
    return " ".join(words[: bend.rng.randrange(len(words) + 1)] if bend.hit() else words)


# -- scenes


def _node(bend: Bend, tag: str, **attributes: str) -> str:
    if bend.hit(0.5):
        attributes.pop(bend.rng.choice(sorted(attributes)))
    words = " ".join(f"{key}={quoteattr(bend.utf8(value))}" for key, value in attributes.items())
    return f"<{bend.odd(tag, ('Volume', 'Sequence', 'Text', 'MRML', 'X'))} {words}></{tag}>"


def document(bend: Bend, nodes: list[str]) -> str:
    """A scene of these nodes, some of them twice or not at all."""
    kept = [node for node in nodes for _ in range(bend.rng.choice((0, 2, 3)) if bend.hit() else 1)]
    head = bend.odd('<?xml version="1.0"?>', ("", '<!DOCTYPE a [<!ENTITY b "c">]>', '<?xml encoding="x"?>'))
    return f'{head}\n<MRML version="Slicer5">\n' + "\n".join(kept) + "\n</MRML>\n"


def _zip(bend: Bend, files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", bend.rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as file:
        for name, data in files.items():
            info = zipfile.ZipInfo(str(bend.odd(name, (f"../{name}", f"/{name}", f"{name}x"))))
            if bend.hit():
                info.external_attr = 0o120777 << 16
            info.compress_type = file.compression
            file.writestr(info, bend.data(data))
    found = bytearray(out.getvalue())
    at = found.rfind(b"PK\x01\x02")
    for place in (8, 10, 20, 24, 28, 42):  # flags, method, sizes, length of the name, place
        if bend.hit(0.5):
            struct.pack_into("<H", found, at + place, bend.rng.choice(EDGES) & 0xFFFF)
    return bytes(found)


def _index(bend: Bend, ids: list[str]) -> str:
    pairs = (f"{bend.text(each)}:{_numbers(bend, f'{at / 10:.3f}')};" for at, each in enumerate(ids))
    return " ".join(pairs)


def _poses(bend: Bend) -> bytes:
    head = "ObjectType = Image\nNDims = 3\nDimSize = 0 0 3\nElementType = MET_UCHAR\nKinds = domain domain list\n"
    rows = "".join(
        f"Seq_Frame{at:04}_{bend.text('TToTracker')}Transform = {_numbers(bend, _MATRIX)}\n"
        f"Seq_Frame{at:04}_Timestamp = {_numbers(bend, f'{at / 10:.3f}')}\n"
        for at in range(3)
    )
    return f"{head}{rows}ElementDataFile = LOCAL\n".encode("utf-8", "replace")


def scene(bend: Bend) -> bytes:
    """A bundle with a transform, strings, points, a sequence of poses and one of points."""
    words = [_node(bend, "Text", id=f"w{at}", name="W", text=f"line {at}") for at in range(3)]
    marks = [
        node
        for at in range(2)
        for node in (
            _node(bend, "MarkupsFiducial", id=f"m{at}", name="M", references=f"storage:k{at};"),
            _node(bend, "MarkupsJsonStorage", id=f"k{at}", fileName=str(bend.odd(f"m{at}.mrk.json", _NAMES))),
        )
    ]
    times = {"indexType": "numeric", "indexUnit": "s", "indexName": "time"}
    poses = str(bend.odd("Data/q.seq.mha", _NAMES))
    nodes = [
        _node(bend, "LinearTransform", id="t1", name="RegToTracker", matrixTransformToParent=_numbers(bend, _MATRIX)),
        _node(bend, "Sequence", id="s1", name="Q", references="storage:f1;", **times),
        _node(bend, "LinearTransformSequenceStorage", id="f1", name="F", fileName=poses),
        _node(
            bend, "Sequence", id="s2", name="Strings", references="storage:f2;", **times,
            indexValues=_index(bend, ["w0", "w1", "w2"]),
        ),
        _node(bend, "SequenceStorage", id="f2", name="F", fileName=str(bend.odd("Data/w.seq.mrb", _NAMES))),
        _node(
            bend, "Sequence", id="s3", name="Marks", references="storage:f3;", **times,
            indexValues=_index(bend, ["m0", "m1"]),
        ),
        _node(bend, "SequenceStorage", id="f3", name="F", fileName=str(bend.odd("Data/m.seq.mrb", _NAMES))),
        _node(bend, "SequenceBrowser", id="b1", name="B", references="sequenceNodeRef0:s1;dataNodeRef0:t1;"),
    ]  # fmt: skip
    inner = {"m/m.mrml": document(bend, marks).encode()} | {f"m/m{at}.mrk.json": markups(bend) for at in range(2)}
    files = {
        "S/S.mrml": document(bend, nodes).encode(),
        "S/Data/q.seq.mha": _poses(bend),
        "S/Data/w.seq.mrb": _zip(bend, {"w/w.mrml": document(bend, words).encode()}),
        "S/Data/m.seq.mrb": _zip(bend, inner),
    }
    return _zip(bend, files)


def alone(bend: Bend) -> bytes:
    """A scene without a bundle."""
    node = _node(bend, "LinearTransform", id="t1", name="T", matrixTransformToParent=_numbers(bend, _MATRIX))
    return document(bend, [node, _node(bend, "Text", id="w1", name="W", text="x")]).encode()


# -- transforms


def _transform(bend: Bend) -> tuple[str, list[str], list[str]]:
    at = bend.rng.randrange(3) if not bend.hit() else bend.rng.randrange(len(_KINDS))
    name = bend.text(f"{_KINDS[at]}_double_3_3")
    parameters = (["1", "0", "0", "0", "1", "0", "0", "0", "1"] + ["5"] * 3)[-_SIZES[at] or 12 :]
    return name, _numbers(bend, " ".join(parameters)).split(), _numbers(bend, "0 0 0").split()


def text(bend: Bend) -> bytes:
    """Transforms as lines."""
    lines = ["#Insight Transform File V1.0"]
    for number in range(2 if bend.hit() else 1):
        name, parameters, fixed = _transform(bend)
        lines += [f"#Transform {number}", f"Transform: {name}", f"Parameters: {' '.join(parameters)}"]
        lines.append(f"FixedParameters: {' '.join(fixed)}")
    return "\n".join(bend.text(line) for line in lines).encode("utf-8", "replace")


def _floats(words: list[str]) -> bytes:
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            numbers.append(float("nan"))
    return struct.pack(f"<{len(numbers)}d", *numbers)


def matlab(bend: Bend) -> bytes:
    """A transform as two matrices of MATLAB level 4."""
    name, parameters, fixed = _transform(bend)
    found = b""
    for title, words in ((name, parameters), (bend.text("fixed"), fixed)):
        coded = title.encode("utf-8", "replace") + b"\0"
        head = (bend.number(0), bend.number(len(words)), bend.number(1), bend.number(0), bend.number(len(coded)))
        found += struct.pack("<5I", *head) + coded + _floats(words)
    return bend.data(found)


def _header(bend: Bend, messages: list[tuple[int, bytes]]) -> bytes:
    """An object header of version 2."""
    body = b"".join(
        struct.pack("<BHB", bend.number(kind, 8), bend.number(len(data), 16), 0) + data for kind, data in messages
    )
    return b"OHDR\x02\x02" + bend.u32(len(body)) + body + bytes(4)


def _links(bend: Bend, targets: dict[str, int]) -> list[tuple[int, bytes]]:
    return [
        (6, b"\x01\x00" + bend.byte(len(name)) + name.encode() + struct.pack("<Q", bend.number(at, 64)))
        for name, at in targets.items()
    ]


def _data(bend: Bend, count: int, kind: bytes, address: int, size: int) -> bytes:
    space = b"\x02\x01\x00\x01" + struct.pack("<Q", bend.number(count, 64))
    layout = b"\x03\x01" + struct.pack("<QQ", bend.number(address, 64), bend.number(size, 64))
    return _header(bend, [(1, space), (3, bend.data(kind)), (8, layout)])


def hdf5(bend: Bend) -> bytes:
    """A transform as ITK stores it in HDF5, with a name of fixed length."""
    name, parameters, fixed = _transform(bend)
    floating = b"\x11\x20\x3f\x00" + struct.pack("<IHHBBBBI", 8, 0, 64, 52, 11, 0, 52, 1023)
    contents = {
        "TransformType": (1, b"\x13\x00\x00\x00" + bend.u32(64), name.encode("utf-8", "replace")[:64].ljust(64, b"\0")),
        "TransformParameters": (len(parameters), floating, _floats(parameters)),
        "TransformFixedParameters": (len(fixed), floating, _floats(fixed)),
    }
    body, parts = bytearray(48), {}
    for title, (count, kind, content) in contents.items():
        at = len(body)
        body += content
        parts[title] = len(body)
        body += _data(bend, count, kind, at, len(content))
    places = []
    for messages in (_links(bend, parts), None, None):
        places.append(len(body))
        targets = {"0": places[0]} if len(places) == 2 else {"TransformGroup": places[1]} if len(places) == 3 else {}
        if bend.hit():
            targets |= {"1": bend.rng.choice(places)}
        body += _header(bend, messages if messages is not None else _links(bend, targets))
    head = b"\x89HDF\r\n\x1a\n" + bytes([bend.number(2, 8), 8, 8, 0]) + struct.pack(
        "<QQQQI", 0, 0xFFFFFFFFFFFFFFFF, len(body), bend.number(places[2], 64), 0
    )  # fmt: skip
    body[: len(head)] = head
    return bytes(body)


# -- markups


def markups(bend: Bend) -> bytes:
    """Markups as JSON."""
    odd: tuple[Any, ...] = (None, True, [], {}, "x", "", -1, 1e308, float("nan"), [[[]]], [1, 2], 10**400)

    def value(found: Any) -> Any:
        return bend.odd(found, odd)

    points = [
        {
            "id": value(str(at)),
            "label": value(bend.utf8(f"F-{at}")),
            "position": value([value(1.0), value(2.0), value(3.0)]),
            "positionStatus": value("defined"),
        }
        for at in range(3)
    ]
    one = {
        "type": value(bend.rng.choice(("Fiducial", "Line", "Plane", "ROI", "Curve"))),
        "coordinateSystem": value("LPS"),
        "coordinateUnits": value("mm"),
        "controlPoints": value(points),
        "center": value([1, 2, 3]),
        "orientation": value([1, 0, 0, 0, 1, 0, 0, 0, 1]),
        "size": value([value(4), 5, 6]),
        "planeBounds": value([-2, 2, -2, 2]),
        "display": value({"color": value([0.5, value(1), 0]), "selectedColor": value([1, 0, 0]), "opacity": value(1)}),
    }
    for key in list(one):
        if bend.hit(0.5):
            del one[key]
    schema = bend.text("https://x/markups-schema-v1.0.3.json#")
    return json.dumps({"@schema": schema, "markups": value([value(one)])}).encode("utf-8", "replace")


def table(bend: Bend) -> bytes:
    """Points as a table."""
    rows = [
        "# Markups fiducial file version = 5.3",
        f"# CoordinateSystem = {bend.odd('LPS', ('RAS', '0', '1', '2', ''))}",
        f"# columns = {bend.text('id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID')}",
    ]
    for at in range(3):
        place = ",".join(_numbers(bend, "1 2 3").split())
        rows.append(f"{at},{place},0,0,0,1,1,1,0,{bend.text(f'F-{at}')},,,{bend.odd(2, (0, 1, 3, 'x'))},0")
    return "\n".join(rows).encode("utf-8", "replace")


#: Name → suffix and what writes such a file.
BUILDERS: dict[str, tuple[str, Callable[[Bend], bytes]]] = {
    "bundle": (".mrb", scene),
    "scene": (".mrml", alone),
    "text": (".tfm", text),
    "matlab": (".mat", matlab),
    "hdf5": (".h5", hdf5),
    "markups": (".mrk.json", markups),
    "table": (".fcsv", table),
}
