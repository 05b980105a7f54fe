"""What Python 3.10, that of ROS 2 Humble, does not have: each name that newer Pythons have is imported from here.

The type checker reads the branches of Python 3.10 (``python_version`` of pyproject.toml): code for a newer one fails.
"""

from __future__ import annotations

import re
import sys
from datetime import date, datetime
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    from enum import StrEnum
    from typing import Self

    import tomllib
else:
    from enum import Enum

    import tomli as tomllib
    from typing_extensions import Self

    class StrEnum(str, Enum):
        """An enumeration whose members are their values, as text, too."""

        def __str__(self) -> str:
            return str(self.value)


__all__ = ["Self", "StrEnum", "add_note", "iso_time", "limit_values", "python_command", "read_blob", "tomllib"]

#: Date, separator, time and zone, as ``datetime.fromisoformat`` reads them from Python 3.11 on.
_ISO = re.compile(
    r"(\d{4})(?:(-?)(\d\d)\2(\d\d)|(-?)W(\d\d)(?:\5(\d))?)"
    r"(?:.(\d\d)(?:(:?)(\d\d)(?:\9(\d\d)(?:[.,](\d{1,30}))?)?)?(Z|[+-]\d\d(?::?\d\d){0,2}(?:\.\d{1,30})?)?)?",
    re.ASCII,
)


def iso_time(text: str) -> datetime:
    """Return an ISO 8601 time, as ``datetime.fromisoformat`` of Python 3.11.  Raises ValueError."""
    return datetime.fromisoformat(text) if sys.version_info >= (3, 11) else spelled_out(text)


def spelled_out(text: str) -> datetime:
    """Return an ISO 8601 time by the few forms that Python 3.10 reads.  Raises ValueError."""
    parts = _ISO.fullmatch(text)
    if parts is None:
        raise ValueError(f"found {text!r}, expected an ISO 8601 time")
    year, _, month, day, _, week, weekday, hour, _, minute, second, fraction, zone = parts.groups(default="")
    day_of_week = f"{date.fromisocalendar(int(year), int(week), int(weekday or 1))}" if week else ""
    on = day_of_week or f"{year}-{month}-{day}"
    time = ":".join(part or "00" for part in (hour, minute, second))
    return datetime.fromisoformat(f"{on}T{time}{_micros(fraction)}{_zone(zone)}")


def _zone(text: str) -> str:
    """Return a zone as Python 3.10 reads it: ``+HH:MM``, with seconds if it has them."""
    digits, _, fraction = text[1:].replace(":", "").partition(".")
    if not digits:
        return "+00:00" if text else ""
    pairs = [digits[at : at + 2] for at in range(0, len(digits), 2)]
    return text[0] + ":".join(pairs if len(pairs) > 1 else (*pairs, "00")) + _micros(fraction)


def _micros(fraction: str) -> str:
    return f".{fraction[:6]:0<6}" if fraction else ""


def add_note(error: BaseException, text: str) -> None:
    """Add a note to an exception, which is printed below it from Python 3.11 on."""
    if sys.version_info >= (3, 11):
        error.add_note(text)
    else:
        vars(error).setdefault("__notes__", []).append(text)


def python_command(program: str | Path) -> list[str]:
    """Return the command for a module or an own file that does not import from the folder that it is started in."""
    what = [str(program)] if isinstance(program, Path) else ["-m", program]
    if sys.version_info >= (3, 11):
        return [sys.executable, "-P", *what]
    start = "run_path" if isinstance(program, Path) else "run_module"
    run = f"runpy.{start}({str(program)!r}, run_name='__main__'{', alter_sys=True' * (len(what) - 1)})"
    return [sys.executable, "-c", f"import runpy, sys; del sys.path[0]; {run}"]


def read_blob(base: Any, table: str, column: str, row: int) -> bytes:
    """Return a BLOB of an SQLite file.  Raises sqlite3.Error."""
    if sys.version_info >= (3, 11):
        with base.blobopen(table, column, row, readonly=True) as blob:
            return bytes(blob.read())
    found: bytes = base.execute(f"SELECT {column} FROM {table} WHERE rowid = ?", (row,)).fetchone()[0]
    return found


def limit_values(base: Any, most_bytes: int) -> None:
    """Limit the values of an SQLite file; without, on Python 3.10, the size of the file does."""
    if sys.version_info >= (3, 11):
        base.setlimit(0, most_bytes)  # SQLITE_LIMIT_LENGTH
