"""The layout of pixels: roles of axes, sizes that IMAGE has, numbers of headers, and memory before it is used."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.addon import DamagedRecording, GatewayError, UnsupportedRecording
from igtl_gateway.addons.exchange.raster import (
    BZIP2,
    COMPONENT,
    FRAME,
    RAW,
    SPACE,
    ZLIB,
    Axis,
    Raster,
    check_axes,
    check_room,
    check_steps,
    fourth_axis_as_time,
    parse_finite,
    parse_number,
    parse_whole,
)
from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from tests.tables import table

S, C, F = SPACE, COMPONENT, FRAME


def raster(*axes: tuple[str, int], dtype: str = "i2", packing: str = RAW, skip: int = 0) -> Raster:
    made = tuple(Axis(role, size) for role, size in axes)
    return Raster("a.nrrd", made, dtype, False, packing, Path("a.raw"), 0, None, skip)


@table(
    ("axes", "size", "frames", "components", "frame_bytes"),
    [
        ([(S, 4), (S, 5)], (4, 5, 1), 1, 1, 40),
        ([(S, 4), (S, 5), (S, 6)], (4, 5, 6), 1, 1, 240),
        ([(C, 3), (S, 4), (S, 5), (F, 7)], (4, 5, 1), 7, 3, 120),
        ([(F, 7), (S, 4), (C, 3), (S, 5), (S, 2)], (4, 5, 2), 7, 3, 240),
        ([(S, 4), (S, 0)], (4, 0, 1), 1, 1, 0),
    ],
)
def test_sizes_are_those_of_the_roles_in_any_order(
    axes: list[tuple[str, int]], size: tuple[int, int, int], frames: int, components: int, frame_bytes: int
) -> None:
    found = raster(*axes)
    assert (found.size, found.frames, found.components, found.frame_bytes) == (size, frames, components, frame_bytes)
    assert replace(found, dtype="").frame_bytes == 0


@table(
    ("roles", "sizes"),
    [
        ([S, S], [1, 65_535]), ([S, S, S], [0, 0, 0]), ([C, S, S, S, F], [255, 1, 1, 1, 10**9]), ([S, S, F], [1, 1, 0]),
        ([C, C, S, S], [5, 51, 1, 1]),
    ],
)  # fmt: skip
def test_axes_that_image_has(roles: list[str], sizes: list[int]) -> None:
    assert [(axis.role, axis.size) for axis in check_axes(roles, sizes, "a")] == list(zip(roles, sizes, strict=True))


@table(
    ("roles", "sizes", "error", "text"),
    [
        ([S, S], [-1, 5], DamagedRecording, "a: found sizes -1 5, expected 0 or more"),
        ([S], [5], UnsupportedRecording, "a: found axes space, expected 2 or 3 spatial axes and at most one time axis"),
        ([S] * 4, [5] * 4, UnsupportedRecording, "expected 2 or 3 spatial axes"),
        ([S, S, F, F], [1] * 4, UnsupportedRecording, "found axes space, space, frame, frame"),
        ([S, S], [65_536, 1], UnsupportedRecording, "a: found sizes 65536 1, expected at most 65535 (IMAGE)"),
        ([C, S, S], [256, 1, 1], UnsupportedRecording, "a: found 256 values per pixel, expected 1 … 255 (IMAGE)"),
        ([C, C, S, S], [2, 128, 1, 1], UnsupportedRecording, "a: found 256 values per pixel"),
        ([C, S, S], [0, 1, 1], UnsupportedRecording, "a: found 0 values per pixel"),
    ],
)
def test_axes_that_it_has_not(roles: list[str], sizes: list[int], error: type[GatewayError], text: str) -> None:
    with pytest.raises(GatewayError) as raised:
        check_axes(roles, sizes, "a")
    assert type(raised.value) is error and text in str(raised.value)


@table(
    ("roles", "found"),
    [
        ([S, S, S, S], [S, S, S, F]),
        ([C, S, S, S, S], [C, S, S, S, F]),
        ([S, S, S, S, C], [S, S, S, F, C]),
        ([S, S, S, S, F], None),
        ([S, S, S], None),
        ([S] * 5, None),
    ],
)
def test_a_fourth_spatial_axis_is_time(roles: list[str], found: list[str] | None) -> None:
    notes: list[str] = []
    assert fourth_axis_as_time(roles, notes) == (found or roles)
    assert notes == (["the fourth axis is imported as time"] if found else [])


def test_distances_of_voxels() -> None:
    notes: list[str] = []
    check_steps([0.5, 1e-300], "ElementSpacing", "a", notes)
    assert notes == []
    check_steps([0.5, -1.0], "ElementSpacing", "a", notes)
    assert notes == ["ElementSpacing has negative numbers: these axes run the other way, as in ITK"]
    for steps, shown in (([1.0, 0.0], "1 0"), ([math.nan, 1.0], "nan 1"), ([-math.inf, 1.0], "-inf 1")):
        with pytest.raises(DamagedRecording) as error:
            check_steps(steps, "ElementSpacing", "a", notes)
        assert str(error.value) == f"a: ElementSpacing: found {shown}, expected numbers other than 0"


@table(
    ("word", "value"),
    [("0", 0), ("-12", -12), ("+7", 7), ("007", 7), ("9" * 18, 10**18 - 1), ("-" + "9" * 18, 1 - 10**18)],
)
def test_integers(word: str, value: int) -> None:
    assert parse_whole(word, "DimSize", "a") == value


@table("word", ["", "-", "1.0", "1e3", "9" * 19, "--1", "+-1", "٣", "1_000", " 1", "0x10", "²"])
def test_what_is_no_integer(word: str) -> None:
    with pytest.raises(DamagedRecording) as error:
        parse_whole(word, "DimSize", "a")
    assert str(error.value) == f"a: DimSize: found {word!r}, expected an integer"


def test_numbers() -> None:
    assert parse_number("-1.5e3", "Offset", "a") == -1500.0 == parse_finite("-1.5e3", "Offset", "a")
    assert math.isinf(parse_number("inf", "Offset", "a"))
    for word in ("inf", "nan", "1e999"):
        with pytest.raises(DamagedRecording, match=f"a: Offset: found '{word}', expected a finite number"):
            parse_finite(word, "Offset", "a")
    for parse in (parse_number, parse_finite):
        with pytest.raises(DamagedRecording) as error:
            parse("x" * 100, "Offset", "a")
        assert str(error.value) == f"a: Offset: found '{'x' * 40}', expected a number"


def test_memory_is_checked_before_it_is_used() -> None:
    with limits_in_force(FileLimits(memory=1000, free=100, ratio=10)):
        check_room(raster((S, 10), (S, 50)), 5)  # 1,000 bytes; what is not packed has no ratio
        with pytest.raises(LimitExceeded, match=r"a\.nrrd: bytes of a frame: found 1020, expected at most 1000"):
            check_room(raster((S, 10), (S, 51)), 5)
        for packing in (ZLIB, BZIP2):
            check_room(raster((S, 5), (S, 10), (F, 10), packing=packing), 100)
            with pytest.raises(LimitExceeded, match=r"decompressed from 99 bytes: found 1000, expected at most 990"):
                check_room(raster((S, 5), (S, 10), (F, 10), packing=packing), 99)
            with pytest.raises(LimitExceeded, match=r"decompressed from 100 bytes: found 1001, expected at most 1000"):
                check_room(raster((S, 5), (S, 10), (F, 10), packing=packing, skip=1), 100)
            check_room(raster((S, 5), (S, 10), packing=packing), 1)  # 100 bytes are free
