from __future__ import annotations

from igtl_gateway.addons.page.rhythm import Rhythm
from igtl_gateway.gateway.diagnostics import SILENT_NS
from tests.tables import table

_S = 1_000_000_000


def fed(samples: list[tuple[float, int]]) -> Rhythm:
    """A rhythm of seconds and counts."""
    rhythm = Rhythm()
    for at_s, received in samples:
        rhythm.take(round(at_s * _S), received, round(at_s * _S))
    return rhythm


def test_reads_that_come_late_make_no_zigzag() -> None:
    """40 a second, read between 0.1 and 1.9 s apart."""
    times = [1.0]
    for number in range(60):
        times.append(times[-1] + (0.1, 0.9, 1.9, 0.4)[number % 4])
    rhythm = fed([(at_s, int(40 * at_s + 1e-6)) for at_s in times])
    assert len(rhythm.spark) > 40 and all(38 <= value <= 42 for value in rhythm.spark)
    assert 39.5 < rhythm.rate_hz < 40.5 and rhythm.is_regular and not rhythm.pauses


def test_a_sparkline_has_a_value_each_second() -> None:
    rhythm = fed([(1 + tenth / 10, tenth) for tenth in range(36)])
    assert list(rhythm.spark) == [10, 10, 10] and rhythm.gap_ns == _S // 10
    assert [*fed([(1, 0), (1.5, 9)]).spark] == []
    assert [*fed([(1, 0), (200.5, 1_995)]).spark] == [10.0] * 60


def test_the_worst_gap_and_when_it_ended() -> None:
    steady = [(second, 20 * second) for second in range(1, 8)]
    rhythm = fed([*steady, *((second, 140) for second in range(8, 15)), (15, 160)])
    assert (rhythm.gap_ns, rhythm.gap_utc_ns) == (8 * _S, 15 * _S)
    assert list(rhythm.pauses) == [(15 * _S, 8 * _S)]
    rhythm.take(76 * _S, 1_380)
    assert not rhythm.pauses and not fed([*steady, (15, 300)]).pauses, "a late read is no pause"


@table(
    ("hz", "silent_s", "is_pause"),
    [(50, 0.9, False), (50, 1.1, True), (2, 2.4, False), (2, 2.6, True), (1, 4.9, False), (1, SILENT_NS / _S, True)],
)
def test_a_pause_is_judged_by_the_usual_interval(hz: int, silent_s: float, is_pause: bool) -> None:
    rhythm = fed([(1 + step / 2, step * hz // 2) for step in range(41)])
    assert bool(rhythm.silent_ns(round((21 + silent_s) * _S))) is is_pause


def test_what_comes_now_and_then_has_no_pauses() -> None:
    """Bursts: ten messages in a second, then nothing for nine."""
    rhythm = fed(
        [(1 + step / 2, min(20 * (step // 20) + 10 * (step % 20), 20 * (step // 20) + 20)) for step in range(99)]
    )
    assert not rhythm.is_regular and not rhythm.pauses and not rhythm.silent_ns(200 * _S)


def test_a_rate_that_varies_is_not_slower() -> None:
    """A transform that a person moves by hand."""
    received, samples = 0, []
    for step in range(240):
        received += (1, 30, 4, 22, 9)[step // 3 % 5]
        samples.append((1 + step / 2, received))
    assert not fed(samples).slower_than_hz(round(samples[-1][0] * _S))
