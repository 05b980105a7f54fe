"""The layouts in words against the structs and arrays that read the bytes."""

from __future__ import annotations

import re
import struct
from itertools import takewhile

import numpy as np
import pytest

from igtl_gateway.wire import bind, command, image, message, ndarray, polydata, query, sensor, text, transform, video
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.layout import CODES, Field, Layout, of_dtype
from igtl_gateway.wire.registry import ALIASES, BODIES

PAIR = np.dtype([("a", "S3"), ("b", ">u2", 2)])
CLASSES = sorted(set(BODIES.values()), key=lambda one: one.__name__)


def codes(*formats: str | struct.Struct) -> str:
    """A format as one letter per number: ``>2H3s`` and ``>HH3s`` are HHsss."""
    parts = [one.format if isinstance(one, struct.Struct) else one for one in formats]
    return "".join(letter * int(times or 1) for times, letter in re.findall(r"(\d*)([A-Za-z])", "".join(parts)))


def told(layout: Layout, per: str = "") -> str:
    """What a layout says stands first, or of each ``per``: up to the first row whose size only other rows tell."""
    rows = layout if not per else tuple(row for row in layout if row.per == per)
    rows = tuple(takewhile(lambda row: row.size is not None and row.per == per, rows))
    return codes(*(f"{row.count}{CODES[row.type]}" for row in rows))


@pytest.mark.parametrize(
    ("layout", "formats"),
    [
        (transform.Transform.LAYOUT, (transform._MATRIX,)),
        (transform.Position.LAYOUT, (transform._POSITION["all"],)),
        (text.String.LAYOUT, (text._STRING,)),
        (text.Status.LAYOUT, (text._STATUS,)),
        (image.Image.LAYOUT, (image._HEAD, image._MATRIX, image._SUB)),
        (video.Video.LAYOUT, (video._HEAD, video._MATRIX, video._SUB)),
        (polydata.PolyData.LAYOUT, (polydata._HEAD,)),
        (sensor.Sensor.LAYOUT, (sensor._HEAD,)),
        (ndarray.NdArray.LAYOUT, (ndarray._HEAD,)),
        (command.Command.LAYOUT, (command._HEAD,)),
        (bind.Bind.LAYOUT, (bind._COUNT,)),
        (query.StartTracking.LAYOUT, (query._TRACKING,)),
        (query.StartVideo.LAYOUT, (query._VIDEO,)),
        (query.StartPolyData.LAYOUT, (query._NANOSECONDS,)),
        (query.GetBind.LAYOUT, (query._COUNT,)),
        (query.StartBind.LAYOUT, (query._NANOSECONDS, query._COUNT)),
        (message.ExtendedHeader.LAYOUT, (message._EXTENDED,)),
        (message.METADATA_LAYOUT, (message._COUNT,)),
    ],
)
def test_what_stands_first(layout: Layout, formats: tuple[struct.Struct, ...]) -> None:
    assert told(layout) == codes(*formats)


@pytest.mark.parametrize(
    ("layout", "per", "repeated"),
    [
        (bind.Bind.LAYOUT, "child", bind._CHILD),
        (query.GetBind.LAYOUT, "content", query._TYPE),
        (polydata.PolyData.LAYOUT, "attribute", polydata._ATTRIBUTE),
        (message.METADATA_LAYOUT, "item", message._ITEM),
    ],
)
def test_what_is_repeated(layout: Layout, per: str, repeated: struct.Struct) -> None:
    assert told(layout, per) == codes(repeated)


@pytest.mark.parametrize("kind", [one for one in CLASSES if issubclass(one, Elements)], ids=lambda one: one.__name__)
def test_lists(kind: type[Elements]) -> None:
    assert [row.name for row in kind.LAYOUT] == list(kind.DTYPE.names or ())
    assert sum(row.size or 0 for row in kind.LAYOUT) == kind.DTYPE.itemsize


def test_every_class_has_one() -> None:
    """Where it stops being constant, words say by what; only queries may be without anything."""
    without = [one.__name__ for one in CLASSES if not getattr(one, "LAYOUT", None)]
    assert without == ["Nothing"]
    for kind in CLASSES:
        rows: Layout = kind.LAYOUT  # type: ignore[attr-defined]
        assert all(row.type in CODES or (row.type == "bytes" and isinstance(row.count, str)) for row in rows)


def test_what_is_said_of_an_array_is_said_of_its_fields() -> None:
    rows = of_dtype(PAIR, b="here")
    assert rows == (Field("a", "char", 3), Field("b", "u16", 2, "here"))
    with pytest.raises(TypeError, match="c"):
        of_dtype(PAIR, c="there is none")


def test_aliases_mean_what_they_stand_for() -> None:
    assert {name for name in ALIASES if name not in BODIES} == set()
    assert all(BODIES[name] is BODIES[meant] for name, meant in ALIASES.items())
    assert not ALIASES.keys() & set(ALIASES.values())
