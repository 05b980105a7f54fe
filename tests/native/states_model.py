"""A model of the native passage: the states of a message's memory and of a subscription, moved by all its threads.

``tables`` reads the transitions of ``native/passage/STATES.md``.  Each model is one hashable state and its ``steps``:
what each thread may do next, atomic as the locks make it.  A step moves a state
only by ``Tables.move``, which refuses what is not in the tables.  ``search`` tries every order.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from tests.places import PACKAGE

STATES = PACKAGE / "native" / "passage" / "STATES.md"
_ROW = re.compile(r"^\| `([A-Z_]+)` \| `([A-Z_]+)` \|", re.MULTILINE)

Moves = Mapping[str, frozenset[str]]
State = TypeVar("State", bound=Hashable)


class NotInTable(AssertionError):
    """A transition that STATES.md does not have."""


def moves_of(text: str) -> Moves:
    """Return state → states after it, of the first table of transitions in a part of the document."""
    found: dict[str, set[str]] = {}
    for before, after in _ROW.findall(text):
        found.setdefault(before, set()).add(after)
    return {before: frozenset(after) for before, after in found.items()}


@dataclass
class Tables:
    """The three tables, and which rows were used."""

    kept: Moves
    taker: Moves
    holds: Moves
    used: set[tuple[str, str]] = field(default_factory=set)

    def move(self, table: Moves, before: str, after: str) -> str:
        if after not in table.get(before, ()):
            raise NotInTable(f"{before} to {after}")
        self.used.add((before, after))
        return after

    @staticmethod
    def rows(*tables: Moves) -> set[tuple[str, str]]:
        return {(before, after) for table in tables for before, others in table.items() for after in others}


def tables() -> Tables:
    """Return the tables of STATES.md."""
    text = STATES.read_text("utf-8")
    kept, _, rest = text.partition("## A subscription")
    taker, _, holds = rest.partition("Beside it, of the taker alone")
    return Tables(moves_of(kept), moves_of(taker), moves_of(holds))


def search(begin: State, steps: Callable[[State], Iterator[State]], check: Callable[[State, bool], None]) -> int:
    """Call ``check`` with each state that any order reaches, and whether it has no step; return their number."""
    seen = {begin}
    front = deque([begin])
    while front:
        state = front.popleft()
        following = list(steps(state))
        check(state, not following)
        for one in following:
            if one not in seen:
                seen.add(one)
                front.append(one)
    return len(seen)


# -- a subscription ----------------------------------------------------------------------------------------------------

#: Where a thread of the middleware is in `on_message`, and the thread of subscriptions in its loop.
OUT, LOOKS, TAKES, ENDS, NOTES, PYTHON_TAKES, NEXT = "out", "looks", "takes", "ends", "notes", "python takes", "next"
#: As the three in the middle, when Python has asked for a message.
FOR_PYTHON = " for python"


@dataclass(frozen=True)
class Sub:
    """One subscription.

    Attributes:
        coming: messages that the middleware has still to report.
        waiting: numbers of those that it has reported, and that were not taken.
        held: number of the message that is held; 0: none.
        passed: numbers of those that have passed, or that Python has.
        threads: where each thread of the middleware is.
        turn: where the thread of subscriptions is.
        taken: messages that Python has taken in this turn.
    """

    coming: int
    waiting: tuple[int, ...] = ()
    reported: int = 0
    taker: str = "IDLE"
    holds: str = "EMPTY"
    held: int = 0
    is_pending: bool = False
    is_in_line: bool = False
    has_failed: bool = False
    failures: int = 0
    passed: tuple[int, ...] = ()
    threads: tuple[str, ...] = (OUT, OUT)
    turn: str = NEXT
    taken: int = 0


#: Messages that Python takes before others have their turn (32 in receiver.py).
AT_MOST = 2


class SubscriptionModel:
    """``failures``: how often rcl may fail.  ``forgets``: the fault that a test plants."""

    def __init__(self, found: Tables, failures: int, forgets: bool = False) -> None:
        self._tables = found
        self._failures = failures
        self._forgets = forgets

    def _moved(self, one: Sub, taker: str) -> Sub:
        return replace(one, taker=self._tables.move(self._tables.taker, one.taker, taker))

    def _holding(self, one: Sub, holds: str) -> Sub:
        return replace(one, holds=self._tables.move(self._tables.holds, one.holds, holds))

    def steps(self, one: Sub) -> Iterator[Sub]:
        """Yield what each step of each thread makes of the state."""
        for number in range(len(one.threads)):
            for there, after in self._of_middleware(one, one.threads[number]):
                yield replace(after, threads=(*one.threads[:number], there, *one.threads[number + 1 :]))
        yield from self._of_subscriptions(one)

    def _of_middleware(self, one: Sub, there: str) -> Iterator[tuple[str, Sub]]:
        match there:
            case "out" if one.coming:  # the lock `state`
                news = replace(one, coming=one.coming - 1, reported=one.reported + 1, is_pending=True)
                news = replace(news, waiting=(*one.waiting, news.reported))
                if one.taker != "IDLE":
                    yield OUT, news
                else:
                    yield LOOKS, self._moved(news, "TAKING")
                    yield NOTES, self._moved(news, "WAITS")
            case "looks":  # the lock `state`
                yield TAKES, replace(one, is_pending=False)
            case "takes":  # pass_all, a message at a time
                for code, after in self._pass_one(one, of_middleware=True):
                    if code == "passed":
                        yield TAKES, after
                    elif code == "none":
                        yield ENDS, after
                    else:
                        yield NOTES, self._moved(after, "WAITS")
            case "ends":  # the lock `state`
                if one.is_pending and not self._forgets:
                    yield LOOKS, one
                else:
                    yield OUT, self._moved(one, "IDLE")
            case "notes":  # the lock of events
                yield OUT, replace(one, is_in_line=True)

    def _pass_one(self, one: Sub, *, of_middleware: bool) -> Iterator[tuple[str, Sub]]:
        """Yield the fate of the next message ("passed", "left", "large"; "none", "failed"), and the state after it."""
        if one.holds == "EMPTY":
            if one.failures < self._failures:
                yield "failed", replace(one, has_failed=True, failures=one.failures + 1)
            if not one.waiting:
                yield "none", one
                return
            one = replace(self._holding(one, "HELD"), held=one.waiting[0], waiting=one.waiting[1:])
        if one.holds == "HELD":
            yield "passed", self._handed(one)
            if not of_middleware:
                yield "large", self._handed(one)
                yield "left", self._holding(one, "REFUSED")
        yield "left", one

    def _handed(self, one: Sub) -> Sub:
        return replace(self._holding(one, "EMPTY"), passed=(*one.passed, one.held), held=0)

    def _of_subscriptions(self, one: Sub) -> Iterator[Sub]:
        what, by_python = one.turn.removesuffix(FOR_PYTHON), one.turn.endswith(FOR_PYTHON)
        suffix = FOR_PYTHON if by_python else ""
        match what:
            case "next" if one.is_in_line:  # the lock of events
                one = replace(self._moved(one, "PASSING"), is_in_line=False, taken=0)
                if one.has_failed:
                    yield replace(self._moved(one, "WITH_PYTHON"), turn=PYTHON_TAKES)
                else:
                    yield replace(one, turn=LOOKS)
            case "looks":  # the lock `state`
                yield replace(one, is_pending=False, turn=TAKES + suffix)
            case "takes":  # pass_all, a message at a time
                for code, after in self._pass_one(one, of_middleware=False):
                    if code == "passed":
                        yield after
                    elif code == "none":
                        yield replace(after, turn=ENDS + suffix)
                    elif by_python:
                        yield self._for_python(code, after)
                    elif code == "large":
                        yield replace(self._moved(after, "WAITS"), turn=NEXT, is_in_line=True)
                    else:
                        yield replace(self._moved(after, "WITH_PYTHON"), turn=PYTHON_TAKES)
            case "ends":  # the lock `state`
                if one.is_pending:
                    yield replace(one, turn=LOOKS + suffix)
                else:
                    yield replace(self._moved(one, "IDLE"), turn=NEXT)
            case "python takes":
                if one.has_failed:
                    yield self._raised(one)
                elif one.taken < AT_MOST:
                    yield replace(self._moved(one, "PASSING"), turn=LOOKS + FOR_PYTHON)
                else:
                    yield replace(self._moved(one, "WAITS"), turn=NEXT, is_in_line=True)

    def _for_python(self, code: str, one: Sub) -> Sub:
        """What `subscription_take` makes of a message that has not passed, a large one that has, or a failure."""
        one = self._moved(one, "WITH_PYTHON")
        if code == "failed":
            return self._raised(one)
        handed = one if code == "large" else self._handed(one)
        return replace(handed, turn=PYTHON_TAKES, taken=one.taken + 1)

    def _raised(self, one: Sub) -> Sub:
        """Python has the failure: the lock `state`, then that of events."""
        waits = one.is_pending and not self._forgets
        one = self._moved(one, "WAITS" if waits else "IDLE")
        return replace(one, has_failed=False, turn=NEXT, is_in_line=one.is_in_line or waits)

    def check(self, one: Sub, at_rest: bool) -> None:
        takers = sum(there in (LOOKS, TAKES, ENDS) for there in one.threads) + (one.turn != NEXT)
        assert takers <= 1, f"two threads take: {one}"
        assert one.passed == tuple(range(1, len(one.passed) + 1)), f"out of order, or twice: {one}"
        assert not (at_rest and one.is_pending), f"left behind, after a report: {one}"
        if at_rest and not one.failures:
            assert (one.waiting, one.holds, one.taker, one.held) == ((), "EMPTY", "IDLE", 0), f"left behind: {one}"


# -- the memory of a message -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kept:
    """The memory of one message.

    Attributes:
        thread, stream, unfilled: who owns it.
        owners: the count.
        step: where its thread is.
    """

    state: str = ""
    owners: int = 0
    thread: bool = False
    stream: bool = False
    unfilled: bool = False
    step: int = 0
    is_copied: bool = False


@dataclass(frozen=True)
class Memory:
    """Messages of one stream, which one thread passes one after the other; the recorder and Python take them over."""

    messages: tuple[Kept, ...]
    copies: tuple[bool, ...] = ()  # of which end_unfilled is at work


class MemoryModel:
    """``forgets``: the fault that a test plants: the list of unfilled ones is no owner."""

    def __init__(self, found: Tables, *, to_ros: bool, forgets: bool = False) -> None:
        self._tables = found
        self._to_ros = to_ros
        self._forgets = forgets

    def begin(self, messages: int) -> Memory:
        return Memory((Kept(),) * messages, (False,) * messages)

    def _moved(self, one: Kept, state: str) -> Kept:
        return replace(one, state=self._tables.move(self._tables.kept, one.state, state))

    def _left(self, one: Kept) -> Kept:
        """`leave_kept`, after who leaves is noted."""
        one = replace(one, owners=one.owners - 1)
        return self._moved(one, "GONE") if not one.owners else one

    def steps(self, one: Memory) -> Iterator[Memory]:
        """Yield what each step of each thread makes of the state."""
        current = next((number for number, each in enumerate(one.messages) if each.step < 9), None)
        if current is not None:
            yield from self._of_thread(one, current)
        for number, each in enumerate(one.messages):
            if each.state == "UNFILLED" and not one.copies[number]:  # off the list, under the lock of events
                yield replace(one, copies=self._with(one.copies, number, True))
            if one.copies[number]:
                after = replace(self._moved(each, "FILLED"), unfilled=False, is_copied=True)
                after = after if self._forgets else self._left(after)
                yield replace(self._set(one, number, after), copies=self._with(one.copies, number, False))
            if each.stream:  # Python takes over the latest one, under the sequence lock
                alone = each.owners == 1
                after = self._moved(each, "TAKEN") if alone else each
                yield self._set(one, number, self._left(replace(after, stream=False)))
            if each.state == "LENT":  # Python needs the queue of the link
                yield self._set(one, number, self._moved(each, "ADMITTED"))

    @staticmethod
    def _with(values: tuple[bool, ...], number: int, value: bool) -> tuple[bool, ...]:
        return (*values[:number], value, *values[number + 1 :])

    @staticmethod
    def _set(one: Memory, number: int, after: Kept) -> Memory:
        return replace(one, messages=(*one.messages[:number], after, *one.messages[number + 1 :]))

    def _of_thread(self, one: Memory, number: int) -> Iterator[Memory]:
        each = one.messages[number]
        match each.step:
            case 0:  # keep
                yield self._set(one, number, Kept("OWN", 1, thread=True, step=1))
            case 1:
                if self._to_ros:
                    yield self._set(one, number, replace(self._moved(each, "STAYS"), step=2))
                yield self._set(one, number, replace(each, step=2))
            case 2:  # it is refused, or admitted under the sequence lock
                back = each if each.state == "OWN" else self._moved(each, "OWN")
                yield self._set(one, number, replace(self._moved(back, "GONE"), thread=False, owners=0, step=9))
                after = one
                for other, latest in enumerate(one.messages):
                    if latest.stream:
                        after = self._set(after, other, self._left(replace(latest, stream=False)))
                each = replace(self._moved(each, "ADMITTED"), stream=True, owners=each.owners + 1, step=3)
                yield self._set(after, number, each)
                small = replace(self._moved(each, "FILLED"), is_copied=True, step=5)
                yield self._set(after, number, small)
            case 3:  # it is sent, a part of it lent
                if not self._to_ros and each.state == "ADMITTED":
                    yield self._set(one, number, self._moved(each, "LENT"))
                if each.state == "LENT":
                    yield self._set(one, number, self._moved(each, "ADMITTED"))
                if each.state == "ADMITTED":
                    yield self._set(one, number, replace(each, step=4))
            case 4:  # fill_later
                owner = replace(each, owners=each.owners + (0 if self._forgets else 1), unfilled=True, step=5)
                yield self._set(one, number, self._moved(owner, "UNFILLED"))
                nothing = replace(self._moved(owner, "FILLED"), unfilled=False, is_copied=True)
                yield self._set(one, number, nothing if self._forgets else self._left(nothing))
            case 5:  # the thread leaves
                yield self._set(one, number, self._left(replace(each, thread=False, step=9)))

    def check(self, one: Memory, at_rest: bool) -> None:
        for number, each in enumerate(one.messages):
            who = [each.thread, each.stream, each.unfilled]
            assert each.owners == sum(who), f"{each.owners} owners: {each}"
            assert (each.state == "GONE") == (each.owners == 0 and each.step > 0), each
            assert not one.copies[number] or each.state == "UNFILLED", "copied from memory that is gone"
            if at_rest:
                assert each.state == "GONE" and not each.unfilled, f"never freed: {each}"
