"""The hub: one order for inputs of many threads, no deadlock when a sink speaks."""

from __future__ import annotations

import threading

from igtl_gateway.app.hub import Hub
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway import LINK_UP, LINKS_TOPIC, Gateway, Session
from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP, ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note

TEXT = String("hello").pack()
UP = Note(Level.INFO, LINK_UP, "up")


def hub_with(*sinks: object) -> Hub:
    return Hub(Session(Gateway(Config())), ManualClock(1_000), sinks)  # type: ignore[arg-type]


def kinds_of(seen: list[Entry]) -> list[Kind]:
    """The kinds of the observed entries, without the list of links."""
    return [entry.kind for entry in seen if entry.channel != LINKS_TOPIC]


def test_sinks_see_every_entry_in_the_order_of_the_log() -> None:
    seen: list[Entry] = []
    hub = hub_with(seen.append)
    hub.link(1, UP)
    hub.ros("/igtl/out/Text", String.TYPE, TEXT, 5)
    hub.note(Note(Level.WARN, "odd", "odd"), 1)
    assert kinds_of(seen) == [Kind.LINK, Kind.ROS_IN, Kind.IGTL_OUT, Kind.NOTE, Kind.EDGE_NOTE]
    assert [entry.seq for entry in seen] == [1, 2, 3, 4, 5, 6]


def test_threads_do_not_interleave_within_one_input() -> None:
    seen: list[Entry] = []
    hub = hub_with(seen.append)
    hub.link(1, UP)
    start = threading.Barrier(4)

    def bring() -> None:
        start.wait()
        for _ in range(200):
            hub.ros("/igtl/out/Text", String.TYPE, TEXT, 0)

    threads = [threading.Thread(target=bring) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [entry.seq for entry in seen] == list(range(1, len(seen) + 1))
    messages = [entry.kind for entry in seen if entry.kind in (Kind.ROS_IN, Kind.IGTL_OUT)]
    assert messages == [Kind.ROS_IN, Kind.IGTL_OUT] * 800


def test_a_sink_that_raises_costs_the_others_nothing() -> None:
    seen: list[Entry] = []

    def broken(_entry: Entry) -> None:
        raise ZeroDivisionError("oops")

    hub = hub_with(broken, seen.append)
    hub.link(1, UP)
    hub.ros("/igtl/out/Text", String.TYPE, TEXT, 0)
    kinds = kinds_of(seen)
    assert kinds == [Kind.LINK, Kind.EDGE_NOTE, Kind.ROS_IN, Kind.IGTL_OUT, Kind.NOTE], "reported once"
    (told,) = [entry for entry in seen if entry.kind is Kind.EDGE_NOTE]
    assert "ZeroDivisionError: oops" in Note.unpack(told.data()).text


def test_what_a_sink_says_follows_the_entries_being_handed_on() -> None:
    seen: list[Entry] = []

    def sink(entry: Entry) -> None:
        seen.append(entry)
        if entry.kind is Kind.IGTL_OUT:
            hub.note(Note(Level.WARN, "queue_drop", "dropped"), 1)

    hub = hub_with(sink)
    hub.link(1, UP)
    hub.ros("/igtl/out/Text", String.TYPE, TEXT, 0)
    assert kinds_of(seen) == [Kind.LINK, Kind.ROS_IN, Kind.IGTL_OUT, Kind.NOTE, Kind.EDGE_NOTE]
    assert [entry.seq for entry in seen] == [1, 2, 3, 4, 5, 6]


def test_deadlines_are_asked_for_while_nothing_changes_them() -> None:
    came = threading.Event()

    class Asked(Gateway):
        @property
        def due_ns(self) -> int | None:
            thread = threading.Thread(target=bring)
            thread.start()
            assert not came.wait(0.05), "a peer came up while the peers were looked at"
            threads.append(thread)
            return 1_000

    seen: list[Entry] = []
    threads: list[threading.Thread] = []
    hub = Hub(Session(Asked(Config())), ManualClock(1_000), (seen.append,))

    def bring() -> None:
        hub.link(1, UP)
        came.set()

    hub.tick()
    threads[0].join()
    assert set(kinds_of(seen)) == {Kind.LINK, Kind.EDGE_NOTE}


# ── the host's clock is set ────────────────────────────────────────────────────────────────────────────────────────


class SetClock(ManualClock):
    """A clock that the test sets."""

    def __init__(self) -> None:
        super().__init__(10_000 * NS_PER_S)
        self.set_ns = 0

    def utc_ns(self) -> int:
        return super().utc_ns() + self.set_ns


class Stepped:
    """A hub whose clock is set; what was seen, in seconds since the beginning."""

    def __init__(self) -> None:
        self.clock = SetClock()
        self.seen: list[Entry] = []
        self.hub = Hub(Session(Gateway(Config())), self.clock, (self.seen.append,))
        self.begun_ns = self.clock.utc_ns()

    def says(self, *, tick: bool = True) -> float:
        """A message a second later; its time.  Without a tick before it that would have seen the clock."""
        self.clock.advance(NS_PER_S)
        if tick:
            self.hub.tick()
        self.hub.ros("/chatter", String.TYPE, TEXT, 0)
        return round((self.seen[-1].stamp_ns - self.begun_ns) / NS_PER_S, 6)

    def steps(self) -> list[ClockStep]:
        return [step for entry in self.seen if (step := ClockStep.of(entry))]


def test_a_clock_that_is_set_back_by_an_hour_costs_no_time() -> None:
    stepped = Stepped()
    assert stepped.says() == 1.0
    stepped.clock.set_ns = -3600 * NS_PER_S
    assert [stepped.says(), stepped.says()] == [2.0, 3.0]
    stepped.clock.set_ns = -1800 * NS_PER_S
    assert stepped.says() == 4.0, "half of what it was ahead"
    stepped.clock.set_ns = 1800 * NS_PER_S
    assert stepped.says() == 1805.0
    assert [(step.step_ns, step.jump_ns, step.ahead_ns) for step in stepped.steps()] == [
        (-3600 * NS_PER_S, 0, 3600 * NS_PER_S),
        (1800 * NS_PER_S, 0, 1800 * NS_PER_S),
        (3600 * NS_PER_S, 1800 * NS_PER_S, 0),
    ]


def test_a_message_that_comes_before_the_tick_is_not_of_an_hour_ago() -> None:
    stepped = Stepped()
    stepped.says()
    stepped.clock.set_ns = -3600 * NS_PER_S
    assert stepped.says(tick=False) == 2.0
    note, message = stepped.seen[-2:]
    assert Note.unpack(note.data()).code == CLOCK_STEP
    assert (note.seq, message.seq) == (2, 3) and note.stamp_ns < message.stamp_ns
    stepped.says()
    assert len(stepped.steps()) == 1


def test_a_clock_that_is_set_forward_is_followed() -> None:
    stepped = Stepped()
    stepped.clock.set_ns = 3600 * NS_PER_S
    assert stepped.says() == 3601.0
    assert [step.jump_ns for step in stepped.steps()] == [3600 * NS_PER_S]


def test_for_a_small_step_back_time_stands_until_the_clock_has_caught_up() -> None:
    stepped = Stepped()
    assert stepped.says() == 1.0
    stepped.clock.set_ns = -NS_PER_S
    assert stepped.says() == 1.0
    assert stepped.says() == 2.0
    (step,) = stepped.steps()
    assert (step.step_ns, step.jump_ns, step.ahead_ns) == (-NS_PER_S, 0, 0)


def test_a_few_milliseconds_are_no_step() -> None:
    stepped = Stepped()
    stepped.clock.set_ns = 9_000_000
    stepped.says()
    assert stepped.steps() == []
