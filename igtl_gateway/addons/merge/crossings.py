"""Messages that two recordings hold: sent by one recorder, received by the other, found by their bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.merge.offsets import Contradiction, measure_offset

Array = npt.NDArray[Any]

#: A pair of streams with fewer equal messages may be a coincidence, if another pair has more.
_SEVERAL = 3
#: A pair with less than this part of the messages is left out if it contradicts the others.
_FEW = 0.05


@dataclass(frozen=True, slots=True)
class Passed:
    """Messages that passed a recorder in one direction, in order.

    Attributes:
        keys: 64-bit hash of each, (N,) uint64.
        times: gateway time, (N,) int64 ns.
        streams: number of the stream of each, (N,).
        names: of the streams.
    """

    keys: Array
    times: Array
    streams: Array
    names: tuple[str, ...]

    @classmethod
    def of(cls, keys: Sequence[int], times: Sequence[int], streams: Sequence[int], names: Iterable[str]) -> Passed:
        """Of sequences."""
        return cls(np.array(keys, np.uint64), np.array(times, np.int64), np.array(streams, np.int64), tuple(names))


@dataclass(frozen=True, slots=True)
class Crossing:
    """The messages of one stream that cross from one recorder to another.

    Attributes:
        sent_as, received_as: names of the stream.
        sent, received: times by the clocks of the two recorders, (N,) int64 ns.
        once: whether each was sent only once, (N,): the others give bounds, and no latency.
    """

    sent_as: str
    received_as: str
    sent: Array
    received: Array
    once: Array


def find_crossings(sent: Passed, received: Passed, own: Passed, is_pair: Callable[[str, str], bool]) -> list[Crossing]:
    """Return the streams that cross, those with the most messages first.

    Of messages that are sent or received several times, the first of each are compared: that bound is right whichever
    of them were lost.

    Args:
        sent: outputs of one recorder.
        received: inputs of the other one.
        own: inputs of the first one.  What it receives itself may have reached the other one on another way too, so
            such a message counts only if the other one receives it once.
        is_pair: whether a stream of the one may be that of the other.
    """
    sent_keys, first_sent, sent_counts = np.unique(sent.keys, return_index=True, return_counts=True)
    keys, first_received, counts = np.unique(received.keys, return_index=True, return_counts=True)
    _, one, two = np.intersect1d(sent_keys, keys, assume_unique=True, return_indices=True)
    clear = (counts[two] == 1) | ~np.isin(sent_keys[one], own.keys)
    one, two = one[clear], two[clear]
    at, to = first_sent[one], first_received[two]
    pairs = np.stack([sent.streams[at], received.streams[to]], axis=1) if len(at) else np.zeros((0, 2), np.int64)
    found = []
    for pair in np.unique(pairs, axis=0):
        names = sent.names[pair[0]], received.names[pair[1]]
        if is_pair(*names):
            here = np.flatnonzero((pairs == pair).all(axis=1))
            here = here[np.argsort(sent.times[at[here]], kind="stable")]
            found.append(Crossing(*names, sent.times[at[here]], received.times[to[here]], sent_counts[one[here]] == 1))
    found.sort(key=lambda crossing: -len(crossing.sent))
    several = [crossing for crossing in found if len(crossing.sent) >= _SEVERAL]
    return several or found


def with_questions(
    there: Sequence[Crossing],
    back: Sequence[Crossing],
    exchanges: Sequence[tuple[int, int, int]],
    questions: str,
    answers: str,
) -> list[Crossing]:
    """Return the questions for the clock that one recorder sent to the other one, whose answers cross back.

    A question is no message that can be found by its bytes, but its answer has the time at which it was received.

    Args:
        there, back: the streams that cross, from the recorder that asks and to it.
        exchanges: of that recorder: time of a question, stamp of its answer and time of the answer; UTC ns.
        questions, answers: names of the streams; where questions cross by their bytes, too, there are none to add.
    """
    if any(crossing.sent_as == questions for crossing in there):
        return []
    known = [crossing.received for crossing in back if crossing.sent_as == answers]
    if not known or not exchanges:
        return []
    asked, stamps, answered = np.array(exchanges, np.int64).T
    here = np.isin(answered, np.concatenate(known))
    found = Crossing(questions, questions, asked[here], stamps[here], np.ones(int(here.sum()), np.bool_))
    return [found] if len(found.sent) else []


def pooled(crossings: Sequence[Crossing]) -> tuple[Array, Array]:
    """Times of the messages of several streams, as ``measure_offset`` takes them."""
    empty = np.zeros(0, np.int64)
    return (
        np.concatenate([empty, *(crossing.sent for crossing in crossings)]),
        np.concatenate([empty, *(crossing.received for crossing in crossings)]),
    )


def without_coincidences(
    there: Sequence[Crossing], back: Sequence[Crossing]
) -> tuple[list[Crossing], list[Crossing], list[Crossing]]:
    """Leave out streams with few messages that contradict the others; return those there, those back, and the rest."""
    if _is_one_line(there, back):
        return list(there), list(back), []
    kept: tuple[list[Crossing], list[Crossing]] = ([], [])
    left_out = []
    every = sorted([(each, 0) for each in there] + [(each, 1) for each in back], key=lambda pair: -len(pair[0].sent))
    total = sum(len(each.sent) for each, _ in every)
    for each, way in every:
        tried = [list(some) for some in kept]
        tried[way].append(each)
        if len(each.sent) < _FEW * total and _is_one_line(*kept) and not _is_one_line(*tried):
            left_out.append(each)
        else:
            kept[way].append(each)
    return *kept, left_out


def _is_one_line(there: Sequence[Crossing], back: Sequence[Crossing]) -> bool:
    try:
        return len(measure_offset(pooled(there), pooled(back)).pieces) == 1
    except Contradiction:
        return not (there or back)
