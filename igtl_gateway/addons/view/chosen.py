"""Numbers of any stream by name, as curves over time: ``view --plot STREAM.FIELD``.

Names of fields are those of CSV, with dots or brackets for places in lists: ``TRANSFORM/Tool.x_mm``,
``/joint_states.position.0``, ``/joint_states.position[0]``, and the name of a joint as its place.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConfigError, near_streams, one_of, streams_expected
from igtl_gateway.addon.reading import Recording, Stream, session_of
from igtl_gateway.addon.streams import FieldReader
from igtl_gateway.addons.view.rhythm import Rhythm

#: Curves of one field that is a list; fields that a message names, and messages in which they are looked for.
_MOST, _NAMED, _LOOKED_AT = 16, 12, 100
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
    with session_of(recording) as file:
        definitions = file.definitions
    found = FieldReader.of(stream, definitions, field).of_blocks(stream.blocks()) if field else None
    if found is None or not any(np.isfinite(values).any() for values in found.fields.values()):
        every = max(1, len(stream) // _LOOKED_AT)
        known = list(FieldReader.of(stream, definitions).of_blocks(stream.blocks(), every).fields)
        what = f"found no number {field!r} in {stream.key}" if field else f"found no field behind {stream.key}"
        raise ConfigError(f"--plot {word}: {what}, expected {one_of(field, known, _NAMED)}")
    times = found.times
    gaps = Rhythm().gaps(times)
    some = list(found.fields.items())[:_MOST]
    curves = {name: np.insert(values, gaps, np.nan) for name, values in some}
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
    expected = streams_expected(near or [begin], recording, recording.path)
    raise ConfigError(f"--plot {word}: found no stream of this name, {expected}")
