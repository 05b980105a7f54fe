"""The layouts against the sizes of the protocol's documents and against the arrays of lists."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.wire import (
    bind,
    command,
    header,
    image,
    message,
    ndarray,
    polydata,
    query,
    sensor,
    text,
    transform,
    video,
)
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.layout import CODES, Field, Layout, compile_struct, of_dtype, offset_of
from igtl_gateway.wire.registry import ALIASES, BODIES
from tests.tables import table

PAIR = np.dtype([("a", "S3"), ("b", ">u2", 2)])
CLASSES = sorted(set(BODIES.values()), key=lambda one: one.__name__)


@table(
    ("layout", "size"),
    [
        (transform.Transform.LAYOUT, 48),
        (transform.Position.LAYOUT, 28),
        (text.String.LAYOUT, 4),
        (text.Status.LAYOUT, 30),
        (image.Image.LAYOUT, 72),
        (video.Video.LAYOUT, 76),
        (polydata.PolyData.LAYOUT, 40),
        (sensor.Sensor.LAYOUT, 10),
        (ndarray.NdArray.LAYOUT, 2),
        (command.Command.LAYOUT, 138),
        (bind.Bind.LAYOUT, 2),
        (query.StartTracking.LAYOUT, 36),
        (query.StartVideo.LAYOUT, 8),
        (query.StartPolyData.LAYOUT, 8),
        (query.GetBind.LAYOUT, 2),
        (query.StartBind.LAYOUT, 10),
        (header.Header.LAYOUT, 58),
        (message.ExtendedHeader.LAYOUT, 12),
        (message.METADATA_LAYOUT, 2),
    ],
)
def test_sizes_of_the_documents(layout: Layout, size: int) -> None:
    """In front of the first field whose size other fields give."""
    assert compile_struct(layout).size == size


@pytest.mark.parametrize(
    ("layout", "per", "size"),
    [
        (bind.Bind.LAYOUT, "child", 20),
        (query.GetBind.LAYOUT, "content", 12),
        (polydata.PolyData.LAYOUT, "attribute", 6),
        (message.METADATA_LAYOUT, "item", 8),
    ],
)
def test_sizes_of_what_is_repeated(layout: Layout, per: str, size: int) -> None:
    assert compile_struct(layout, per).size == size


def test_offsets() -> None:
    layout = text.Status.LAYOUT
    assert [offset_of(layout, row.name) for row in layout] == [0, 2, 10, 30]
    for name in ("none", "content"):  # not there; behind fields that are repeated
        with pytest.raises(KeyError, match=name):
            offset_of(bind.Bind.LAYOUT, name)


@pytest.mark.parametrize("kind", [one for one in CLASSES if issubclass(one, Elements)], ids=lambda one: one.__name__)
def test_lists(kind: type[Elements]) -> None:
    assert [row.name for row in kind.LAYOUT] == list(kind.DTYPE.names or ())
    assert sum(row.size or 0 for row in kind.LAYOUT) == kind.DTYPE.itemsize


def test_every_class_has_one() -> None:
    """Where the size is not constant, words name what it depends on; only queries may be empty."""
    without = [one.__name__ for one in CLASSES if not getattr(one, "LAYOUT", None)]
    assert without == ["EmptyQuery"]
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
