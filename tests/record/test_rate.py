"""What a recording takes in an hour is reported when the streams are there, and when that changes much."""

from __future__ import annotations

from itertools import accumulate

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.rate import RATE, RateWatch
from tests.tables import table


def notes(rates: list[int], free: int | None = None) -> list[tuple[int, Note]]:
    """Second and note, of a recording that grows by these bytes in one second after the other."""
    watch = RateWatch()
    looks = enumerate(accumulate(rates))
    found = [(second, watch.look(second * NS_PER_S, size, free)) for second, size in looks]
    return [(second, note) for second, note in found if note]


def test_it_is_reported_once_when_it_is_known() -> None:
    ((second, note),) = notes([1_000_000] * 100, free=36_000_000_000)
    assert second <= 12
    assert (note.code, note.text) == (RATE, "the recording takes 3.6 GB an hour; the disk has room for 10 h")
    assert note.data == {"bytes_per_hour": 3_600_000_000}


def test_streams_that_begin_later_are_in_it() -> None:
    ((_, note),) = notes([0] * 20 + [1_000_000] * 40)
    assert note.text == "the recording takes 3.6 GB an hour"


@table(("rate", "number"), [(1_300_000, 1), (3_000_000, 2), (300_000, 2), (0, 1)])
def test_it_is_reported_again_when_it_changes_much(rate: int, number: int) -> None:
    assert len(notes([1_000_000] * 40 + [rate] * 40)) == number


def test_a_burst_and_a_recording_of_nothing_are_no_rate() -> None:
    assert notes([0] * 30 + [50_000_000] + [0] * 8) == []
    assert notes([500] * 60) == []


@table(("free", "words"), [(10**9, "17 min"), (10**11, "28 h"), (10**13, "116 days")])
def test_the_room_of_the_disk_is_in_words(free: int, words: str) -> None:
    ((_, note),) = notes([1_000_000] * 30, free)
    assert note.text.endswith(f"room for {words}")
