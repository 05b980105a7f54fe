"""Streams at their own rate, beside the frames: for each row of the recipe with ``native`` a table of all its messages.

Nothing is resampled and nothing is left out: a message outside of all episodes, or without a value, has a row that
states it.  Numbers are float64 in the units of the data set.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from igtl_gateway.addon.reading import Recording
from igtl_gateway.addon.writing import make_folder, open_new
from igtl_gateway.addons.lerobot.frames import Plan
from igtl_gateway.addons.lerobot.samples import Times, recorded_stamps, stamps_of

#: Folder of the tables, in ``meta`` and in a part.
NATIVE = "native"
#: Episode of a message that is in none.
OUTSIDE = -1


def native_rows(plan: Plan) -> list[int]:
    """Return the indices of the rows that have a table."""
    return [index for index, row in enumerate(plan.recipe.features) if row.native]


def native_name(plan: Plan, index: int) -> str:
    """Return the name of the tables of a row."""
    name = plan.recipe.features[index].name
    return f"{name}.{plan.recipe.rows(name).index(index)}"


def native_of(name: str, session: int) -> str:
    """Return the path in ``meta`` of the table of a row, which has this name, of a session."""
    return f"{NATIVE}/{name}/{session:06d}.parquet"


def native_table(recording: Recording, plan: Plan, index: int) -> pa.Table:
    """Return all messages of a row, in the order of the recording; see ``docs/how-to/lerobot.md`` for the columns."""
    samples = plan.samples[index]
    assert samples is not None and samples.recorded is not None
    row = samples.row
    stream = recording[row.stream]
    values = np.full((len(stream), len(samples.names)), np.nan)
    values[samples.recorded.rows] = samples.recorded.numbers
    usable = np.zeros(len(stream), np.bool_)
    usable[samples.rows] = True
    times = stamps_of(stream, row, plan.joined)
    if samples.correction is not None:
        times = samples.correction.corrected(times)
    columns = {
        "entry": stream.numbers,
        "time_ns": times,
        "stamp_ns": recorded_stamps(stream, row),
        "received_ns": stream.times,
        "episode_index": _episodes(plan, times),
        "usable": usable,
    }
    for number, name in enumerate(samples.names):
        columns[name if name not in columns else f"{name}_{number}"] = values[:, number]
    return pa.table({name: pa.array(np.ascontiguousarray(each)) for name, each in columns.items()})


def _episodes(plan: Plan, times: Times) -> Times:
    """The episode of each time: from its first to its last frame."""
    found = sorted((int(each.times[0]), int(each.times[-1]), each.index) for each in plan.episodes)
    starts, ends, numbers = np.array(found, np.int64).T
    last = np.searchsorted(starts, times, "right") - 1
    is_inside = (last >= 0) & (times <= ends[last])
    return np.where(is_inside, plan.place.episode + numbers[last], OUTSIDE)


def write_native(recording: Recording, plan: Plan, part: Path) -> None:
    """Write the tables of a session to its part.  Raises OSError."""
    for index in native_rows(plan):
        make_folder(part / NATIVE, exist_ok=True)
        with open_new(part / NATIVE / f"{native_name(plan, index)}.parquet") as file:
            parquet.write_table(native_table(recording, plan, index), file, compression="zstd")
