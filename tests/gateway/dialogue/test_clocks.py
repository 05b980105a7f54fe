"""Questions to peers for their clock on manual time: who is asked, what an answer is, and what a session has of it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from examples.peers import clock
from examples.peers.clock import BODY, CRC, HEADER
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.dialogue.clocks import ClockQuestions, ask_note
from igtl_gateway.gateway.log.clock_offset import ANSWERS, DEVICE, QUESTIONS
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.fates import ASKED
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.verify import DeclaredLosses, verify
from igtl_gateway.testing.gateway import ManualGateway, Outputs
from igtl_gateway.wire import Message, decode
from igtl_gateway.wire.query import EmptyQuery
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.transform import Transform


class Asked:
    """A gateway with a peer whose clock is ahead."""

    def __init__(self, offset_ns: int = 0, **settings: Any) -> None:
        self.gateway = ManualGateway(watch=True, **settings)
        self.offset_ns = offset_ns
        self.link = self.gateway.connect(peer="10.0.0.7:5")

    @property
    def questions(self) -> ClockQuestions:
        questions = self.gateway._gateway.questions
        assert questions
        return questions

    def ask(self, *, report: bool = False) -> Outputs:
        return self.gateway._feed(Kind.EDGE_NOTE, (ask_note(report=report).pack(),), links=(self.link,))

    def answer(self) -> Outputs:
        stamp = ns_to_ticks(self.gateway.now_ns + self.offset_ns)
        return self.gateway.from_peer(Message("STATUS", DEVICE, Status(1), stamp), self.link)

    def exchange(self, *, report: bool = False) -> Outputs:
        self.ask(report=report)
        self.gateway.advance(0.001)
        outputs = self.answer()
        self.gateway.advance(0.999)
        return outputs


def test_a_question_goes_to_its_peer_and_its_answer_nowhere() -> None:
    asked = Asked(5 * NS_PER_S)
    other = asked.gateway.connect()
    (question,) = asked.ask(report=True).igtl()
    assert (question.stream, question.links) == (QUESTIONS, (asked.link,)) and other != asked.link
    asked.gateway.advance(0.001)
    outputs = asked.answer()
    assert not outputs.ros("/igtl/in/**") and not outputs.igtl()
    (note,) = outputs.notes()
    assert note.code == "peer_clock" and note.text.startswith("10.0.0.7:5: clock ahead by +5,000.5")
    assert note.data["low_ns"] <= 5 * NS_PER_S <= note.data["high_ns"] and note.data["peer"] == "10.0.0.7:5"
    assert asked.gateway._gateway.ledger.to_dict()["igtl_in"][ANSWERS] == {"received": 1, "decoded": 1, ASKED: 1}
    assert asked.exchange().notes() == []


def test_a_question_for_our_clock_is_answered_with_it_and_reaches_no_one() -> None:
    asked = Asked()
    outputs = asked.gateway.from_peer(Message("GET_STATUS", DEVICE, EmptyQuery()), asked.link)
    (answer,) = outputs.igtl()
    assert answer.stream == ANSWERS and answer.message.content == Status(1)
    assert 0 <= answer.message.ticks - ns_to_ticks(asked.gateway.now_ns) < ns_to_ticks(1_000)
    assert not outputs.ros("/igtl/in/**")


def test_the_answer_of_the_example_is_one() -> None:
    answer = decode(HEADER.pack(1, b"STATUS", DEVICE.encode(), 7, len(BODY), CRC) + BODY)
    assert (answer.type, answer.device_name, answer.content, answer.ticks) == ("STATUS", DEVICE, Status(1), 7)


def test_who_is_asked() -> None:
    asked = Asked()
    questions, link = asked.questions, asked.link
    assert not questions.may_ask(link, ()) and not questions.may_ask(link, ["10.0.0.8:*"])
    assert questions.may_ask(link, ["10.0.0.7:*"])
    assert questions.may_ask(link, ["127.0.0.1:18944"])  # the address that it has connected to
    assert not questions.may_ask(link + 1, ["**"])
    asked.ask()
    assert not questions.may_ask(link, ["**"])  # it has not answered yet
    asked.answer()
    asked.gateway.from_peer(Message("GET_STATUS", DEVICE, EmptyQuery()), link)
    assert questions.may_ask(link, ())  # who asks knows the question
    asked.gateway.disconnect(link)
    assert not questions.may_ask(link, ["**"])


def test_a_peer_that_may_be_3d_slicer_is_not_asked_before_it_shows_itself() -> None:
    asked = Asked(cautious=True)
    assert not asked.questions.may_ask(asked.link, ["**"])
    asked.gateway.advance(0.5)
    assert asked.questions.may_ask(asked.link, ["**"])


def test_a_peer_that_gets_no_question_is_not_asked_again() -> None:
    asked = Asked(deny_out=["GET_STATUS"])
    assert [note.code for note in asked.ask().notes()] == ["denied"]
    assert not asked.questions.may_ask(asked.link, ["**"])


def test_an_answer_to_nothing_and_an_unset_stamp_show_nothing() -> None:
    asked = Asked()
    assert not asked.answer().notes() and asked.questions.clocks.offset(asked.link, asked.gateway.now_ns) is None
    found = []
    for _ in range(3):
        asked.ask(report=True)
        found += asked.gateway.from_peer(Message("STATUS", DEVICE, Status(1), 0), asked.link).notes()
    assert [note.text for note in found] == ["10.0.0.7:5: its answer to the question for its clock has no stamp"]
    assert asked.questions.clocks.offset(asked.link, asked.gateway.now_ns) is None


def test_a_step_of_20_ms_has_a_note_within_three_seconds() -> None:
    asked = Asked()
    for _ in range(30):
        assert not asked.exchange().notes()
    asked.offset_ns += 20 * NS_PER_MS
    found = [note for _ in range(3) for note in asked.exchange().notes()]
    (note,) = found
    assert note.code == "peer_clock_step" and note.stream == ANSWERS and note.data["peer"] == "10.0.0.7:5"
    assert note.data["low_ns"] <= 20 * NS_PER_MS <= note.data["high_ns"]
    assert note.text == (
        "10.0.0.7:5: a clock was set, that of the peer or of this host: its offset changed by +14.999 ms to +25.001 ms"
    )


def test_stamps_that_stand_still_have_one_note() -> None:
    asked = Asked()
    found = []
    for _ in range(60):
        asked.ask()
        found += asked.gateway.from_peer(Message("STATUS", DEVICE, Status(1), 1 << 63), asked.link).notes()
        asked.gateway.advance(1)
    assert [note.code for note in found] == ["peer_no_clock"] and "do not change" in found[0].text


def test_a_step_of_our_clock_restarts_the_estimate() -> None:
    asked = Asked()
    for _ in range(5):
        asked.exchange()
    step = ClockStep.after(NS_PER_S, 0)
    asked.gateway._feed(Kind.EDGE_NOTE, (step.note().pack(),))
    assert asked.questions.clocks.offset(asked.link, asked.gateway.now_ns) is None
    asked.offset_ns -= NS_PER_S
    asked.gateway.advance(1)
    assert not [note for _ in range(5) for note in asked.exchange().notes()]


def test_the_guard_says_by_which_clock() -> None:
    asked = Asked(-3 * NS_PER_S, max_age_s=1.0)
    asked.exchange()
    matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    stamp = ns_to_ticks(asked.gateway.now_ns + asked.offset_ns)
    outputs = asked.gateway.from_peer(Message("TRANSFORM", "Probe", Transform(matrix), stamp), asked.link)
    (note,) = outputs.notes("stale")
    assert note.text.startswith("TRANSFORM/Probe is stale: messages are 3 s old by the sender's clock (offset -2,999.")


def test_a_session_verifies_and_so_does_its_middle(tmp_path: Path) -> None:
    asked = Asked()
    for number in range(20):
        asked.exchange(report=number % 5 == 0)
    asked.offset_ns += 20 * NS_PER_MS
    for _ in range(5):
        asked.exchange()
    asked.gateway.save(tmp_path / "session.mcap")
    with SessionFile.open(tmp_path / "session.mcap") as file:
        entries = list(file.entries())
        config = json.loads(file.session["config"])
    report = verify(entries, Config.from_dict(config))
    assert report.good and report.equal == report.outputs > 25
    # a part of it has no answers from before, so its notes about the clock may come at other times
    middle = next(at for at, entry in enumerate(entries) if at > 30 and b'"report"' in entry.data())
    before = [next(entry for entry in entries if entry.kind is kind) for kind in (Kind.LINK, Kind.IGTL_IN)]
    for start, late in ((middle, 0), (middle + 2, 1)):  # before a question, and between it and its answer
        part = verify(entries[start:], Config.from_dict(config), DeclaredLosses(midway=True), before=before)
        assert part.good and part.late == late and part.equal > 10


def test_the_example_connects_again_and_prints_each_cause_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    refused = OSError("refused")
    ends = iter([refused, refused, None, refused, KeyboardInterrupt()])

    def answer(_host: str, _port: int) -> None:
        if (end := next(ends)) is not None:
            raise end

    example: Any = clock
    monkeypatch.setattr(example, "answer", answer)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        example.run("or1", 18944)
    assert capsys.readouterr().out == 2 * "or1:18944: refused; trying again\n"
