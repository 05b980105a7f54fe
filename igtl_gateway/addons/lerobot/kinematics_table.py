"""A table of kinematics of others, as untrusted CSV: columns of numbers by name or number, and the times of its rows.

Memory: the table.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, DamagedRecording, one_of
from igtl_gateway.addon.untrusted import limits, open_file, printable
from igtl_gateway.addons.lerobot.kinematics_recipe import SEPARATORS, TIMES, Column

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

#: End of the times that ROS has, UTC ns.
LATEST_NS = NS_PER_S << 31
#: Names of columns that an error lists.
_LISTED = 8
_NUMBER = re.compile(r"[+-]?([0-9]{1,40}\.?[0-9]{0,40}|\.[0-9]{1,40})([eE][+-]?[0-9]{1,3})?|[+-]?(nan|inf|NaN)")
_BLANKS, _OUTER = re.compile(rb"[ \t]+"), re.compile(rb"(?m)^[ \t]+|[ \t\r]+$")


@dataclass(frozen=True, slots=True)
class KinematicsTable:
    """A table that is open.

    Attributes:
        path: its file.
        rows: number of rows.
        read: returns a column (rows,).  Raises ConfigError with the place of the column.
    """

    path: Path
    rows: int
    read: Callable[[Column, str], Array]

    def numbers(self, columns: Sequence[Column], place: str) -> Array:
        """Return columns as (rows, K) float64.  Raises ConfigError with ``place``."""
        return np.stack([self.read(each, place).astype(np.float64) for each in columns], axis=1)

    def times(self, column: Column, unit: str, place: str) -> Times:
        """Return a column of times (rows,), ns, that increase.

        Raises ConfigError with ``place``, DamagedRecording with the row.
        """
        values = self.read(column, place)
        factor = TIMES[unit]
        with np.errstate(invalid="ignore", over="ignore"):
            good = np.isfinite(values.astype(np.float64)) & (np.abs(values.astype(np.float64)) < LATEST_NS / factor)
        if not good.all():
            row = int(np.argmin(good))
            place = f"{self.path}: row {row + 1}: {column}"
            raise DamagedRecording(f"{place}: found {_shown(values[row])}, expected a time in {unit} before 2038")
        if values.dtype.kind in "iu":
            times = values.astype(np.int64) * factor
        else:  # whole units and the rest apart: a product has not the digits of both
            whole = np.floor(values)
            times = whole.astype(np.int64) * factor + np.round((values - whole) * factor).astype(np.int64)
        back = np.flatnonzero(np.diff(times) <= 0)
        if len(back):
            row = int(back[0]) + 1
            found, before = _shown(values[row]), _shown(values[row - 1])
            raise DamagedRecording(
                f"{self.path}: row {row + 1}: {column}: found {found}, expected more than {before} of the row before"
            )
        return times


def _shown(value: Any) -> str:
    return f"{value:.17g}" if isinstance(value, np.floating) else str(value)


def open_csv(path: Path, separator: str, header: bool) -> KinematicsTable:
    """Read a table of text.

    Args:
        path: the file.
        separator: a key of SEPARATORS.
        header: whether the first line has the names of the columns.

    Raises DamagedRecording, LimitExceeded.
    """
    import pyarrow as pa  # here: tables in HDF5 do not need it
    from pyarrow import csv

    with open_file(path) as stream:
        data = stream.read(limits.current_limits().memory + 1)
    limits.check_limit("memory", len(data), f"{path}: bytes")
    if separator == "space":
        data = _BLANKS.sub(b" ", _OUTER.sub(b"", data))
    try:
        table = csv.read_csv(
            pa.BufferReader(data),
            csv.ReadOptions(use_threads=False, autogenerate_column_names=not header),
            csv.ParseOptions(delimiter=SEPARATORS[separator]),
            csv.ConvertOptions(strings_can_be_null=True),
        )
        names = [each.strip() for each in table.schema.names]
    except (pa.ArrowException, ValueError) as error:
        raise DamagedRecording(
            f"{path}: is not a valid table: {printable(str(error).partition(chr(10))[0])[:200]}"
        ) from None
    if header and _are_values(names):
        shown = ", ".join(map(printable, names[:3]))
        raise DamagedRecording(f"{path}: row 1: found {shown} …, expected names of columns, or header = false")
    if not table.num_rows:
        raise DamagedRecording(f"{path}: found no row, expected one or more")

    def read(column: Column, place: str) -> Array:
        at = _place_of(column, names, header, path, place)
        found = table.column(at)
        if not (pa.types.is_integer(found.type) or pa.types.is_floating(found.type)):
            if not pa.types.is_null(found.type):
                raise ConfigError(f"{place}: {path.name}: {column}: found {found.type}, expected numbers")
            found = found.cast(pa.float64())
        if found.null_count:
            found = found.cast(pa.float64(), safe=False).fill_null(float("nan"))
        return np.asarray(found.to_numpy())

    return KinematicsTable(path, table.num_rows, read)


def _are_values(names: Sequence[str]) -> bool:
    """Return whether a first line has numbers that are not those of columns, which programs write as names."""
    counts = [str(number) for number in range(len(names) + 1)]
    return all(map(_NUMBER.fullmatch, names)) and list(names) not in (counts[:-1], counts[1:])


def _place_of(column: Column, names: Sequence[str], header: bool, path: Path, place: str) -> int:
    """The index of a column.  Raises ConfigError."""
    if isinstance(column, int):
        if column > len(names):
            raise ConfigError(f"{place}: {path.name}: found column {column}, expected 1 to {len(names)}")
        return column - 1
    if not header:
        raise ConfigError(f"{place}: {path.name}: found {column!r} without a header, expected the number of a column")
    if names.count(column) > 1:
        raise ConfigError(f"{place}: {path.name}: found {column!r} {names.count(column)} times, expected once")
    if column not in names:
        expected = one_of(column, map(printable, names), _LISTED)
        raise ConfigError(f"{place}: {path.name}: found no column {column!r}, expected {expected}")
    return names.index(column)
