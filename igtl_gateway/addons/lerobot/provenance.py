"""The episodes of a data set as they were exported: which session each is of, and its rows of provenance.

Another program may have changed the set since: where each episode of today comes from follows from what its files
still state, or from the lengths of the episodes, if these leave one answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from igtl_gateway.addon import DamagedRecording, GatewayError
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import parquet_columns
from igtl_gateway.addons.lerobot.assembling import provenance_of
from igtl_gateway.addons.lerobot.checking_stats import numbers_of
from igtl_gateway.addons.lerobot.columns import is_numeric, matrix_of
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode
from igtl_gateway.addons.lerobot.session_list import SESSIONS, SessionList


@dataclass(frozen=True, slots=True)
class ExportedEpisode:
    """An episode at the time of its export.

    Attributes:
        session: number of the session.
        number: of the episode in the session.
        first: its first row in the provenance of the session.
        length: number of frames.
    """

    session: int
    number: int
    first: int
    length: int


def exported_episodes(root: Path, listed: SessionList) -> list[ExportedEpisode]:
    """Return all episodes that were exported, in their order.

    Raises GatewayError for provenance that cannot be read, or has other episodes than the list of sessions.
    """
    found: list[ExportedEpisode] = []
    for session, each in enumerate(listed.sessions):
        place = f"meta/{provenance_of(session)}"
        with parquet_columns(root / place) as columns:
            table = columns.read(["episode_index"])
        if not is_numeric(table, "episode_index"):
            raise DamagedRecording(f"{place}: episode_index: found no numbers, expected them")
        numbers = matrix_of(table, "episode_index")[:, 0]
        firsts = np.flatnonzero(np.diff(numbers, prepend=-1))
        first = listed.others + len(found)
        if len(firsts) != each.episodes or not np.array_equal(numbers[firsts], np.arange(first, first + len(firsts))):
            raise DamagedRecording(
                f"{place}: episode_index: found other episodes, expected the {count_text(each.episodes, 'episode')} "
                f"of meta/{SESSIONS}"
            )
        lengths = np.diff(np.append(firsts, len(numbers))).tolist()
        rows = zip(firsts.tolist(), lengths, strict=True)
        found += [ExportedEpisode(session, number, first, length) for number, (first, length) in enumerate(rows)]
    return found


def origins(found: FoundDataSet, exported: Sequence[ExportedEpisode], others: int = 0) -> list[int | None] | None:
    """Return for each episode of a set which exported one it was, None for one that was added; None if unknown.

    ``others`` are the first episodes, of another program, which are left out.
    """
    episodes = found.episodes[others:]
    lengths, wanted = [each.length for each in episodes], [each.length for each in exported]
    numbers = [each - others for each in map(_stated, episodes) if each is not None]
    kept = [each for each in numbers if each < len(wanted)]
    # in a shorter set, numbers without a gap prove nothing: a program may have computed them again
    if (
        len(numbers) == len(lengths)
        and numbers == sorted(set(numbers))
        and (numbers != list(range(len(lengths))) or len(lengths) >= len(wanted))
        and all(wanted[each] == length for each, length in zip(kept, lengths, strict=False))
    ):
        return [each if each < len(wanted) else None for each in numbers]
    if lengths[: len(wanted)] == wanted:
        return [*range(len(wanted)), *[None] * (len(lengths) - len(wanted))]
    first, last = _embedded(lengths, wanted), _embedded(lengths[::-1], wanted[::-1])
    if first is None or last is None or first != [len(wanted) - 1 - each for each in reversed(last)]:
        return None
    return list(first)


def _stated(episode: FoundEpisode) -> int | None:
    """The number that an episode had when its statistics were computed; LeRobot's delete and split leave them."""
    try:
        stats = episode.read_stats().get("episode_index")
    except GatewayError:
        return None
    known = [numbers_of(stats.get(each)) for each in ("min", "max")] if isinstance(stats, dict) else []
    if len(known) < 2 or any(each is None or each.shape != (1,) for each in known):
        return None
    low, high = (float(each[0]) for each in known if each is not None)
    return int(low) if low == high and low >= 0 and low.is_integer() else None


def _embedded(lengths: Sequence[int], wanted: Sequence[int]) -> list[int] | None:
    """The first places of the lengths in those that are wanted, in order; None if they do not fit."""
    found, at = list[int](), 0
    for length in lengths:
        while at < len(wanted) and wanted[at] != length:
            at += 1
        if at == len(wanted):
            return None
        found.append(at)
        at += 1
    return found
