"""What an actor has to do comes in order of time, and what comes up meanwhile is not forgotten."""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.convert.rosmsg import String
from igtl_gateway_lab.simulate.actor import RosSent, Sent
from igtl_gateway_lab.simulate.agenda import Agenda, Task


def say(text: str) -> Task:
    return lambda now_ns: [RosSent(f"/{text}", String(str(now_ns)))]


def topics(said: Iterable[Sent]) -> list[str]:
    return [one.topic for one in said if isinstance(one, RosSent)]


def test_first_things_first_and_equal_times_in_the_order_noted() -> None:
    agenda = Agenda()
    for due_ns, text in ((20, "c"), (10, "a"), (20, "d"), (10, "b"), (30, "later")):
        agenda.add(due_ns, say(text))
    assert agenda.due_ns == 10
    assert topics(agenda.act(9)) == []
    assert topics(agenda.act(20)) == ["/a", "/b", "/c", "/d"]
    assert agenda.due_ns == 30


def test_a_task_is_given_the_time_at_which_it_is_done() -> None:
    agenda = Agenda()
    agenda.add(10, say("late"))
    (said,) = agenda.act(25)
    assert isinstance(said, RosSent) and said.message == String("25")


def test_a_task_that_notes_another_is_followed_by_it_if_that_is_due_too() -> None:
    agenda = Agenda()

    def again(now_ns: int) -> Iterable[Sent]:
        agenda.add(agenda_times.pop(), again)
        return say("tick")(now_ns)

    agenda_times = [30, 20, 10]
    agenda.add(0, again)
    assert topics(agenda.act(20)) == ["/tick"] * 3
    assert agenda.due_ns == 30


def test_nothing_is_due_after_everything_was_forgotten() -> None:
    agenda = Agenda()
    agenda.add(10, say("never"))
    agenda.clear()
    assert agenda.due_ns is None
    assert topics(agenda.act(100)) == []
