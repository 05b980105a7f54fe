"""The offsets of clocks in a recording are those that the gateway had."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway import cli
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_clocks import RecordedClocks
from tests.gateway.dialogue.test_clocks import Asked
from tests.places import FIXTURES


def test_they_are_those_of_the_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = Asked(6 * NS_PER_S)
    for _ in range(70):
        asked.exchange()
    asked.offset_ns -= NS_PER_S
    asked.gateway._feed(Kind.EDGE_NOTE, (ClockStep.after(NS_PER_S, 0).note().pack(),))
    asked.gateway.advance(1)
    for _ in range(70):
        asked.exchange()
    answered_ns = asked.gateway.now_ns - 999 * NS_PER_MS
    known = asked.questions.clocks.offset(asked.link, answered_ns)
    asked.gateway.disconnect(asked.link)
    asked.gateway.save(tmp_path / "session.mcap")
    with SessionFile.open(tmp_path / "session.mcap") as file:
        found = RecordedClocks.of(file)
    assert known and found.offsets[asked.link] == known and known.answers == 70 and known.drift_ppm
    assert len(found.exchanges) == 140
    assert all(asked_ns < answered_ns for asked_ns, _, answered_ns in found.exchanges)
    assert cli.main(["info", str(tmp_path / "session.mcap")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "link 1 10.0.0.7:5: clock ahead by +5,000.501 ms ± 1.50 ms, by its answers, drift +0.0 ±" in shown


def test_an_answer_that_was_lost_costs_no_other_one() -> None:
    asked, found = Asked(), RecordedClocks()
    for _ in range(5):
        asked.exchange()
    answers = [entry for entry in asked.gateway.log if entry.kind is Kind.IGTL_IN]
    for entry in asked.gateway.log:
        if entry is not answers[2]:
            found.take(entry)
    took = [answered_ns - asked_ns for asked_ns, _, answered_ns in found.exchanges]
    assert len(took) == 4 and max(took) == NS_PER_MS


def test_a_recording_without_questions_has_none() -> None:
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        found = RecordedClocks.of(file)
    assert not found.offsets and not found.exchanges
