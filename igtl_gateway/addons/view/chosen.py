"""Numbers of any stream by name, as curves over time: ``view --plot STREAM.FIELD``.

Names of fields are those of CSV, with dots or brackets for places in lists: ``TRANSFORM/Tool.x_mm``,
``/joint_states.position.0``, ``/joint_states.position[0]``, and the name of a joint as its place.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from igtl_gateway.addon import ConfigError, did_you_mean, near_names, near_streams
from igtl_gateway.addon.reading import Recording, Stream
from igtl_gateway.addon.streams import NAME_FIELDS
from igtl_gateway.addon.untrusted import whole_number
from igtl_gateway.addons.view.rhythm import Rhythm

#: Curves of one field that is a list; fields that a message names.
_MOST, _NAMED = 16, 12
_MOST_PLACE = 99_999_999
#: Columns that are of every message, and no field.
_HEAD = frozenset({"entry", "time_ns", "source_ns"})
_PLACE = re.compile(r"\[([^\[\]]*)\]")


@dataclass(frozen=True, slots=True)
class Series:
    """A field over time.

    Attributes:
        title: of the plot.
        times: (N,) gateway times, UTC ns, ascending.
        curves: name → (N,) values; NaN for none, and in a gap.
    """

    title: str
    times: npt.NDArray[np.int64]
    curves: dict[str, npt.NDArray[np.float64]]


def series_of(recording: Recording, word: str) -> Series:
    """Return what ``--plot`` names.  Raises ConfigError, with the nearest name."""
    stream, field = _stream_of(recording, word)
    table = stream.to_arrow()
    found = _curves(table, field) if field else {}
    if not any(np.isfinite(values).any() for values in found.values()):
        known = list(dict.fromkeys(_fields(table)))
        question = did_you_mean(near_names(field, known)) if field else ""
        shown = ", ".join(known[:_NAMED]) + (" …" if len(known) > _NAMED else "")
        what = f"found no number {field!r} in {stream.key}" if field else f"found no field behind {stream.key}"
        raise ConfigError(f"--plot {word}: {what}; {question or f'expected one of {shown or None}'}")
    times = table["time_ns"].to_numpy()
    gaps = Rhythm().gaps(times)
    curves = {name: np.insert(values, gaps, np.nan) for name, values in found.items()}
    return Series(word, np.insert(times, gaps, times[gaps]), curves)


def _stream_of(recording: Recording, word: str) -> tuple[Stream, str]:
    """The stream whose name begins a word, and the field behind it: the longest name counts."""
    for name in sorted(recording, key=len, reverse=True):
        rest = word[len(name) :]
        if word.startswith(name) and (not rest or rest[0] in ".["):
            return recording[name], _PLACE.sub(r".\1", rest).removeprefix(".")
    begin = word.split("[", maxsplit=1)[0]
    wanted = [begin, *(begin[: dot.start()] for dot in reversed(list(re.finditer(r"\.", begin))))]
    near = next((found for each in wanted if (found := near_streams(each, recording))), [])
    expected = did_you_mean(near) if near else f"expected STREAM.FIELD with one of {', '.join(recording)}"
    raise ConfigError(f"--plot {word}: found no stream of this name; {expected}")


def _curves(table: pa.Table, field: str) -> dict[str, npt.NDArray[np.float64]]:
    """The values of a field, by name; nothing if there is no such field, or no numbers in it."""
    parts = field.split(".")
    for count in range(len(parts), 0, -1):
        name = ".".join(parts[:count])
        if name in table.column_names:
            column = table[name].combine_chunks()
            names = next((table[each].combine_chunks() for each in NAME_FIELDS if each in table.column_names), None)
            return _inside(column, parts[count:], field, names)
    return {}


def _inside(array: pa.Array, parts: list[str], name: str, names: pa.Array | None) -> dict[str, Any]:
    """What is at a path in an array of N values."""
    kind = array.type
    if _is_number(kind):
        return {} if parts else {name: _numbers(array)}
    if pa.types.is_struct(kind) and parts:
        place = kind.get_field_index(parts[0])
        return _inside(pc.struct_field(array, [place]), parts[1:], name, None) if place >= 0 else {}
    if not (pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)):
        return {}
    if parts and (place := whole_number(parts[0], _MOST_PLACE)) is not None:
        return _inside(_element(array, place), parts[1:], name, None)
    if parts and names is not None:
        return {name: _by_name(array, names, ".".join(parts))} if _is_number(kind.value_type) else {}
    if parts or not _is_number(kind.value_type) or not len(array):
        return {}
    longest = min(int(pc.max(pc.list_value_length(array)).as_py() or 0), _MOST)
    return {f"{name}.{place}": _numbers(_element(array, place)) for place in range(longest)}


def _element(array: pa.Array, place: int) -> pa.Array:
    """The element at a place of each list; null where a list is shorter."""
    sizes = pc.list_value_length(array).fill_null(0).to_numpy(zero_copy_only=False)
    begins = np.concatenate(([0], np.cumsum(sizes)))[:-1]
    flat = array.flatten()
    return flat.take(pa.array(np.minimum(begins + place, max(len(flat) - 1, 0)), mask=sizes <= place))


def _by_name(array: pa.Array, names: pa.Array, wanted: str) -> npt.NDArray[np.float64]:
    """The number beside a name in each message."""
    rows = zip(names.to_pylist(), array.to_pylist(), strict=True)
    return np.array(
        [dict(zip(own or (), values or (), strict=False)).get(wanted, np.nan) for own, values in rows], float
    )


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)


def _numbers(array: pa.Array) -> npt.NDArray[np.float64]:
    found: npt.NDArray[np.float64] = (
        array.cast(pa.float64(), safe=False).fill_null(np.nan).to_numpy(zero_copy_only=False)
    )
    return found


def _fields(table: pa.Table) -> Iterator[str]:
    """Names that can be plotted."""
    for field in table.schema:
        if field.name not in _HEAD:
            yield from _names(field.type, field.name)


def _names(kind: pa.DataType, name: str) -> Iterator[str]:
    if _is_number(kind):
        yield name
    elif pa.types.is_struct(kind):
        for each in kind:
            yield from _names(each.type, f"{name}.{each.name}")
    elif pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        if _is_number(kind.value_type):
            yield name
        yield from _names(kind.value_type, f"{name}.0")
