"""A table of kinematics of others in HDF5: each column is a dataset, ``group/data``, or a number of its rows.

``group/data:3`` is the third number of each row; rows of more dimensions are counted row by row, as C does.
`hdf5_process` reads the file; here is what bounds it, and its reply is checked against what it has announced.

Memory: the datasets that are named.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np

from igtl_gateway.addon import ConfigError, DamagedRecording, Unavailable
from igtl_gateway.addon.processes import missing
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import check_limit, limits, open_file, printable, stored_bytes, whole_number
from igtl_gateway.addons.lerobot import hdf5_process
from igtl_gateway.addons.lerobot.kinematics_recipe import Column
from igtl_gateway.addons.lerobot.kinematics_table import Array, KinematicsTable

#: Bytes of data of the program beside those of the file: Python, numpy and h5py.
_OWN = 1 << 29
#: Its environment beside ours: libhdf5 loads no code for filters, and numpy takes no memory for threads.
_ENVIRONMENT = {"HDF5_PLUGIN_PRELOAD": "::", "OPENBLAS_NUM_THREADS": "1"}
#: Characters of one of its lines.
_MOST_LINE = 1 << 20
_DTYPES = tuple(np.dtype(f"{kind}{size}") for kind in "iuf" for size in (1, 2, 4, 8) if kind + str(size) != "f1")
_BY_NAME = {each.str: each for each in _DTYPES}


def open_hdf5(path: Path, places: Mapping[Column, str]) -> KinematicsTable:
    """Read columns of a file.

    Args:
        path: the file.
        places: each column → its place in the recipe.

    Raises ConfigError with the place of a column, DamagedRecording, LimitExceeded, and Unavailable without h5py.
    """
    if find_spec("h5py") is None:
        raise Unavailable(missing("h5py"))
    chosen = {column: _parsed(column, f"{place}: {path.name}") for column, place in places.items()}
    names = list(dict.fromkeys(name for name, _ in chosen.values()))
    shown = {column: f"{place}: {path.name}: {column}" for column, place in places.items()}
    users = {name: shown[column] for column, (name, _) in reversed(chosen.items())}
    datasets = dict(zip(names, _read(path, names, [users[name] for name in names]), strict=True))
    rows, first = len(datasets[names[0]]), names[0]
    for name, values in datasets.items():
        if len(values) != rows:
            found = count_text(len(values), "row")
            raise ConfigError(f"{users[name]}: found {found}, expected {rows:,} as {first} has")
    if not rows:
        raise DamagedRecording(f"{path}: {first}: found no row, expected one or more")
    columns = {column: _column(datasets[name], number, shown[column]) for column, (name, number) in chosen.items()}
    return KinematicsTable(path, rows, lambda column, place: columns[column])


def _parsed(column: Column, place: str) -> tuple[str, int | None]:
    """Return the name of a dataset, and the number in its rows, from 1 on; None: the only one."""
    text = str(column)
    before, _, after = text.rpartition(":")
    number = whole_number(after)
    name = text if number is None else before
    if isinstance(column, int) or not name.strip("/"):
        raise ConfigError(f'{place}: found {column!r}, expected a dataset such as "group/data" or "group/data:3"')
    return name, number


def _column(values: Array, number: int | None, place: str) -> Array:
    """Return a column (rows,) of a dataset (rows, ...)."""
    flat = values.reshape(len(values), -1)
    width = flat.shape[1]
    if number is None and width != 1:
        raise ConfigError(f"{place}: found {count_text(width, 'number')} in each row, expected one, by :1 to :{width}")
    if number is not None and not 1 <= number <= width:
        raise ConfigError(f"{place}: found number {number}, expected 1 to {width}")
    return np.ascontiguousarray(flat[:, (number or 1) - 1])


def _read(path: Path, names: Sequence[str], places: Sequence[str]) -> list[Array]:
    with open_file(path):  # an ordinary file, that gives its time
        most = limits.current_limits()
        stored = stored_bytes(path, path.stat().st_size)
    seconds = most.seconds + most.seconds_per_mb * stored // 1_000_000
    with _program(path, most.memory + _OWN, seconds) as (asked, replies):
        asked.write(json.dumps(names).encode() + b"\n")
        asked.flush()
        facts = _reply(replies, path, places)
        arrays = [_announced(each, place) for each, place in zip(facts["datasets"], places, strict=True)]
        check_limit("memory", sum(each.nbytes for each in arrays), f"{path}: bytes")
        asked.write(b"\n")
        asked.flush()
        for array in arrays:
            _reply(replies, path, places)
            _fill(array, replies)
        return arrays


def _reply(replies: IO[bytes], path: Path, places: Sequence[str]) -> Mapping[str, Any]:
    """Return the next line; raise what the program found instead.  Raises LookupError, TypeError, ValueError."""
    facts: Mapping[str, Any] = json.loads(replies.readline(_MOST_LINE))
    if "absent" in facts:
        raise Unavailable(missing("h5py", ImportError(facts["absent"])))
    if "memory" in facts:
        raise limits.exceeded("memory", "a file that needs more bytes", str(path), limits.current_limits().memory)
    if "name" in facts:
        raise ConfigError(f"{places[facts['name']]}: {printable(facts['error'])}")
    if "error" in facts:
        raise DamagedRecording(f"{path}: is not a valid HDF5 file: {printable(facts['error'])}")
    return facts


def _announced(facts: Mapping[str, Any], place: str) -> Array:
    """Return an empty array for the numbers of a dataset.  Raises LimitExceeded, LookupError, TypeError, ValueError."""
    shape, dtype = [int(size) for size in facts["shape"]], _BY_NAME[facts["dtype"]]
    if not shape or min(shape) < 0:
        raise ValueError(shape)
    size = prod(max(each, 1) for each in shape) * dtype.itemsize
    allowed = limits.current_limits()
    check_limit("memory", max(size, int(facts["chunk"])), f"{place}: bytes")
    check_limit("ratio", size, f"{place}: bytes", allowed.unpacked(int(facts["packed"])))
    return np.empty(shape, dtype)


def _fill(array: Array, replies: IO[bytes]) -> None:
    """Read the numbers of an array.  Raises EOFError."""
    view = array.reshape(-1).view(np.uint8).data
    while view:
        taken = replies.readinto(view)  # type: ignore[attr-defined]
        if not taken:
            raise EOFError
        view = view[taken:]


@contextmanager
def _program(path: Path, data: int, seconds: int) -> Iterator[tuple[IO[bytes], IO[bytes]]]:
    """Run the program in a with block: its input and its output.

    Raises DamagedRecording if it ends before it has replied, LimitExceeded if it takes too long.
    """
    command = [sys.executable, "-m", hdf5_process.__name__, str(data), str(path.absolute())]
    pipe, null = subprocess.PIPE, subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=null, env=os.environ | _ENVIRONMENT)
    assert process.stdin and process.stdout
    late = threading.Event()

    def end() -> None:
        late.set()
        process.kill()

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    try:
        yield process.stdin, process.stdout
    except (EOFError, LookupError, OSError, TypeError, ValueError):
        if late.is_set():
            raise limits.exceeded("seconds", f"more than {seconds} s of work", str(path), f"{seconds} s") from None
        raise DamagedRecording(f"{path}: found data that end the program that reads it, expected valid HDF5") from None
    finally:
        timer.cancel()
        process.kill()
        process.communicate()
