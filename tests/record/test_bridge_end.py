"""The worker's end of the pipe, on a real pipe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from multiprocessing import Pipe

import pytest

from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.bridge_end import BridgeEnd, BridgeGone
from igtl_gateway.record.reports import WorkerState

NOTE = Note(Level.INFO, "code", "text")


def test_a_question_has_its_answer_behind_signals() -> None:
    ours, theirs = Pipe()
    end = BridgeEnd(theirs, lambda: False)
    for words in ("wake", "wake", {"a": 1}):
        ours.send(words)
    assert end.ask("drops") == {"a": 1} and ours.recv() == ("drops",)


def test_a_signal_ends_the_pause() -> None:
    ours, theirs = Pipe()
    end = BridgeEnd(theirs, lambda: False)
    assert not end.wait(0.0)
    ours.send("wake")
    assert end.wait(60.0) and not end.gone


@pytest.mark.parametrize("question", [lambda end: end.ask("drops"), lambda end: end.wait(0.0)])
def test_an_orphan_has_no_bridge(question: Callable[[BridgeEnd], object]) -> None:
    ours, theirs = Pipe()  # open all the same
    end = BridgeEnd(theirs, lambda: True)
    try:
        assert question(end) is False, "the time has passed"
    except BridgeGone:
        pass
    assert end.gone and not ours.closed


def test_a_closed_pipe_ends_a_pause_and_a_question() -> None:
    ours, theirs = Pipe()
    ours.close()
    end = BridgeEnd(theirs, lambda: False)
    assert end.wait(60.0) and end.gone
    with pytest.raises(BridgeGone):
        BridgeEnd(theirs, lambda: False).ask("drops")


def test_nothing_is_sent_to_a_bridge_that_has_gone() -> None:
    ours, theirs = Pipe()
    end = BridgeEnd(theirs, lambda: False)
    end.gone = True
    end.send("answer", 1)
    assert not ours.poll()


def test_a_state_is_sent_once_and_before_its_note() -> None:
    ours, theirs = Pipe()
    end = BridgeEnd(theirs, lambda: False)
    state = WorkerState(written_entries=3)
    end.send_state(WorkerState())
    end.send_note(NOTE, state)
    end.send_note(NOTE, replace(state))
    end.send_state(replace(state, paused=True))
    sent = [ours.recv() for _ in range(4)]
    assert sent == [("state", state), ("note", NOTE), ("note", NOTE), ("state", replace(state, paused=True))]
    assert not ours.poll()
