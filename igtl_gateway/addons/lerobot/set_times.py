"""When the frames of a data set of others are: true times where the set has them, a stated begin otherwise.

The times of a set begin at 0 with each episode.  Our own sets have UTC times of all frames in their provenance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, DamagedRecording, GatewayError
from igtl_gateway.addon.untrusted import parquet_columns
from igtl_gateway.addons.lerobot.columns import matrix_of
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode
from igtl_gateway.addons.lerobot.resampling import moments

Times = npt.NDArray[np.int64]

#: Between two episodes, s: more than a tolerance or a pause of a usual recipe.
GAP_S = 10
#: Times of ROS end in 2038.
LATEST_NS = NS_PER_S << 31
_COLUMNS = ["episode_index", "frame_index", "time_ns"]


@dataclass(frozen=True, slots=True)
class SetTimes:
    """Begin of each episode, UTC ns; ``own``: times of all frames of an episode, where the set has them."""

    begins: Mapping[int, int]
    own: Mapping[int, Times]
    note: str

    def of(self, episode: FoundEpisode, fps: int) -> Times:
        """Return the times of the frames of an episode (length,), UTC ns."""
        own = self.own.get(episode.index)
        return moments(self.begins[episode.index], episode.length, fps) if own is None else own


def times_of(found: FoundDataSet, epoch_ns: int | None, default_ns: int) -> SetTimes:
    """Return the times of a data set.

    Args:
        found: the set.
        epoch_ns: begin of the first episode, UTC ns; None: the times of the set itself, or else ``default_ns``.
        default_ns: see there.

    Raises DamagedRecording for times beyond those of ROS.
    """
    why = ""
    if epoch_ns is None:
        try:
            own = _own(found)
        except GatewayError as error:
            own, why = {}, str(error).removeprefix(f"{found.root}/")
        if own:
            begins = {index: int(times[0]) for index, times in own.items()}
            return SetTimes(begins, own, "times: UTC, as the provenance of the set has them")
    at_ns = begin_ns = default_ns if epoch_ns is None else epoch_ns
    fps, begins = int(found.info["fps"]), {}
    for episode in found.episodes:
        begins[episode.index] = at_ns
        at_ns += (-(-episode.length // fps) + GAP_S) * NS_PER_S
    if at_ns >= LATEST_NS:
        raise DamagedRecording(
            f"{found.root}: found episodes beyond the times of ROS, which end in 2038, expected less"
        )
    begin = np.datetime_as_string(np.datetime64(begin_ns, "ns"), unit="s")
    text = f"times: the set has none; its episodes follow each other from {begin}Z on, {GAP_S} s apart"
    return SetTimes(begins, {}, f"{text} ({why})" if why else text)


def _own(found: FoundDataSet) -> dict[int, Times]:
    """The times of all frames; nothing without provenance.  Raises GatewayError where it does not fit the set."""
    parts = []
    for path in sorted((found.root / "meta").glob("provenance*.parquet")):
        with parquet_columns(path) as file:
            if missing := [name for name in _COLUMNS if name not in file.schema.names]:
                raise DamagedRecording(f"{path}: found no column {missing[0]}, expected one")
            table = file.read(_COLUMNS)
        parts.append(np.concatenate([matrix_of(table, name) for name in _COLUMNS], axis=1))
    if not parts:
        return {}
    rows = np.concatenate(parts)
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    numbers, firsts = np.unique(rows[:, 0], return_index=True)
    times = dict(zip(numbers.tolist(), np.split(rows[:, 2], firsts[1:]), strict=True))
    for episode in found.episodes:
        own = times.get(episode.index, rows[:0, 2])
        if len(own) != episode.length or (np.diff(own) <= 0).any() or not 0 < own[0] <= own[-1] < LATEST_NS:
            raise DamagedRecording(
                f"{found.root}/meta/provenance.parquet: episode {episode.index}: found {len(own):,} times, expected "
                f"{episode.length:,} that increase"
            )
    _check_apart(found.episodes, times, found)
    return times


def _check_apart(episodes: Sequence[FoundEpisode], times: Mapping[int, Times], found: FoundDataSet) -> None:
    """Raise DamagedRecording for episodes at one time, as those of two cameras' recordings can be."""
    ordered = sorted(episodes, key=lambda each: int(times[each.index][0]))
    for one, two in pairwise(ordered):
        if times[two.index][0] <= times[one.index][-1]:
            raise DamagedRecording(
                f"{found.root}/meta/provenance.parquet: found episodes {one.index} and {two.index} at one time, "
                "expected one after the other"
            )
