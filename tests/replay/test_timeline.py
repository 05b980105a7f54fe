"""The pace of a session whose clock was set."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP, ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.playback import PlaybackClock
from igtl_gateway.replay.timeline import SessionTimeline, clock_steps_of
from tests.record import samples
from tests.tables import table

S = 1_000_000_000
#: Jumps of an hour, noticed at 3,610.05 s and 7,230.05 s: ten and twenty-ten seconds have passed.
PACE = SessionTimeline(
    [ClockStep(3600 * S, 3600 * S, 0, 3610 * S + S // 20), ClockStep(3600 * S, 3600 * S, 0, 7230 * S + S // 20)]
)


def test_without_jumps_it_is_gateway_time() -> None:
    assert [SessionTimeline().passed_ns(7), SessionTimeline().recorded_ns(7), SessionTimeline().behind_jump_ns(7)] == [
        7,
        7,
        7,
    ]
    assert SessionTimeline([ClockStep(-3600 * S, 0, 3600 * S, 5 * S)]).passed_ns(9 * S) == 9 * S


@table(
    ("recorded_s", "passed_s"),
    [(5, 5), (10, 10), (2000, 10.05), (3610, 10.05), (3610.05, 10.05), (3620, 20), (7229, 30.05), (7240, 40)],
)
def test_no_time_passes_in_a_jump(recorded_s: float, passed_s: float) -> None:
    assert PACE.passed_ns(int(recorded_s * S)) == int(passed_s * S)


@pytest.mark.parametrize("recorded_s", [5, 10, 3610.05, 3615, 7230.05, 7300])
def test_where_time_passes_it_tells_the_moment(recorded_s: float) -> None:
    recorded_ns = int(recorded_s * S)
    assert PACE.recorded_ns(PACE.passed_ns(recorded_ns)) == recorded_ns
    assert PACE.behind_jump_ns(recorded_ns) == recorded_ns
    assert PACE.behind_jump_ns(100 * S) == 3610 * S + S // 20


def test_a_playback_does_not_wait_for_a_jump_and_knows_where_it_is() -> None:
    clock = PlaybackClock(2.0, pace=PACE)
    assert clock.wait_ns(5 * S, 0) == 0
    assert clock.wait_ns(3610 * S, 0) == int(5.05 * S / 2)
    assert clock.wait_ns(3620 * S, 0) == int(7.5 * S)
    assert clock.position_ns(2 * S) == 9 * S
    assert clock.position_ns(7 * S) == 3619 * S


@pytest.mark.parametrize("ledger", [{}, {"streams": {"edges": {"": {CLOCK_STEP: 1}}}}, {"streams": {}}])
def test_the_steps_of_a_recording(tmp_path: Path, ledger: dict[str, object]) -> None:
    step = ClockStep(3600 * S, 3600 * S, 0, samples.START_NS + 2)
    writer = SessionWriter(tmp_path / "a.mcap", samples.SESSION)
    writer.write(samples.ros(1))
    writer.write(Entry(2, step.at_ns, Kind.EDGE_NOTE, payload=(step.note().pack(),)))
    writer.close(ledger)
    with SessionFile.open(tmp_path / "a.mcap") as file:
        # a ledger without a step is trusted, and no entry is read
        assert clock_steps_of(file) == ([] if ledger == {"streams": {}} else [step])
