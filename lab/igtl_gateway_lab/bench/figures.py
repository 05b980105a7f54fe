"""Numbers made of times: latency and rate of one stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.stamp import NS_PER_S

Times = npt.NDArray[np.int64]
#: Fields of one row of the result.
Row = dict[str, Any]

_MS = 1e6


@dataclass(frozen=True, slots=True)
class Transmission:
    """What was sent and what arrived of one stream, on one monotonic clock.

    Attributes:
        sent: times of sending by sequence number, which counts from 1: ``sent[0]`` is that of number 1.
        numbers: sequence numbers in the order of arrival; 0 and below are not of the measurement.
        received: their times of arrival.
        warm: number of messages at the beginning that do not count.
    """

    sent: Times
    numbers: Times
    received: Times
    warm: int = 0

    def measured(self) -> tuple[Times, Times]:
        """Latencies in ns, by sequence number, and times of arrival of what counts; of duplicates the first."""
        counts = (self.numbers > self.warm) & (self.numbers <= len(self.sent))
        numbers, first = np.unique(self.numbers[counts], return_index=True)
        received = self.received[counts][first]
        return received - self.sent[numbers - 1], received


def in_turn(first: Transmission, second: Transmission) -> Transmission:
    """As if each message had passed one after the other: it needs the sum of both latencies.

    Only what arrived by both counts as arrived.
    """
    (early, _), (late, _) = (Transmission(one.sent, one.numbers, one.received).measured() for one in (first, second))
    first_numbers, second_numbers = (
        np.unique(one.numbers[(one.numbers > 0) & (one.numbers <= len(one.sent))]) for one in (first, second)
    )
    numbers, at_first, at_second = np.intersect1d(first_numbers, second_numbers, return_indices=True)
    return Transmission(first.sent, numbers, first.sent[numbers - 1] + early[at_first] + late[at_second], first.warm)


def latency(passages: Sequence[Transmission]) -> dict[str, Any]:
    """Of several streams of the same kind together: messages, rate of arrival, latencies in ms.

    Percentiles are those of a sorted list without interpolation: a latency that some message had.  Nothing that could
    not be measured is given as None.
    """
    sent = sum(max(0, len(passage.sent) - passage.warm) for passage in passages)
    measured = [passage.measured() for passage in passages]
    waited = np.sort(np.concatenate([one for one, _ in measured]) if measured else np.empty(0, np.int64))
    arrived = np.concatenate([one for _, one in measured]) if measured else np.empty(0, np.int64)
    figures: dict[str, Any] = {"sent": sent, "delivered": len(waited)}
    span_ns = int(arrived.max() - arrived.min()) if len(arrived) > 1 else 0
    figures["received_per_s"] = round((len(arrived) - 1) * NS_PER_S / span_ns, 2) if span_ns else None
    if not len(waited):
        return figures | dict.fromkeys(("p50_ms", "p99_ms", "p999_ms", "mean_ms", "sd_ms", "max_ms"))
    return figures | {
        "p50_ms": _ms(quantile(waited, 0.50)),
        "p99_ms": _ms(quantile(waited, 0.99)),
        "p999_ms": _ms(quantile(waited, 0.999)),
        "mean_ms": _ms(float(waited.mean())),
        "sd_ms": _ms(float(waited.std())),
        "max_ms": _ms(float(waited[-1])),
    }


def lateness(passages: Sequence[Transmission], rate_hz: float) -> dict[str, Any]:
    """How well the senders kept the pace of ``rate_hz``: how late they were, as against the one that was least so."""
    period_ns = NS_PER_S / rate_hz
    late = [passage.sent - np.arange(len(passage.sent)) * period_ns for passage in passages if len(passage.sent)]
    behind = np.sort(np.concatenate([one - one.min() for one in late])) if late else np.empty(0)
    if not len(behind):
        return {"late_p99_ms": None, "late_max_ms": None}
    return {"late_p99_ms": _ms(quantile(behind, 0.99)), "late_max_ms": _ms(float(behind[-1]))}


def quantile(ordered: npt.NDArray[Any], share: float) -> float:
    """The smallest value that ``share`` of the sorted values do not exceed (nearest rank)."""
    rank = int(np.ceil(share * len(ordered)))
    return float(ordered[max(0, rank - 1)])


def ratio(value: float | None, floor: float | None) -> float | None:
    """How many times the floor."""
    return round(value / floor, 2) if value is not None and floor else None


def _ms(ns: float) -> float:
    return round(ns / _MS, 4)
