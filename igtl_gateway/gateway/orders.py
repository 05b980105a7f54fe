"""Orders: commands to robots on their way from the guard to the middleware, and why one is not written.

Strategy: the guard judges a command by the time of its arrival.  What the robot gets is what the middleware writes, at
the time at which it writes it.  So the edge is asked in between, by the thread that has the sequence lock: it writes
the order at once, or never.  ``unwritten`` is its rule.  Nothing is held for a subscriber, nothing is sent late.

What was not written enters the session as an input before the command: a note with the code ``UNWRITTEN``.  The guard
that reads it refuses the same order for the same reason, so a verification gives the same result, and the last set
point is the last one that was written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note

#: Code of the input that has the orders of the next message which were not written.
UNWRITTEN = "command_unwritten"
#: In its data: number of the order in the message, from 0, as text → code and text of the refusal.
ORDERS = "orders"
_MARK = UNWRITTEN.encode()
#: From the check of the age to the source stamp of the middleware: it takes less.
_STAMP_NS = NS_PER_MS

UNHEARD, NEWCOMER, LATE, FAILED = "command_unheard", "command_newcomer", "command_late", "command_failed"
#: Refusals after which a stream begins again where the arm is: a robot has not got what was before.
BEGIN_AGAIN = frozenset({UNHEARD, NEWCOMER})


@dataclass(frozen=True, slots=True)
class Order:
    """A command that passed the guard.

    Attributes:
        device: such as ``PSM1/servo_cp``.
        topic, type, cdr, qos: what is to be written, and how.
        stamp_ns: the stamp of the sender by the clock of the host, UTC ns; 0: none.
        max_age_ns: maximum age at the moment of the write; 0: no limit.
        needs_ns: the time that the way from the last written set point takes at the speed limits; 0: no limit.
        speed_code: code of a refusal for less time than that.
        begins: whether a subscriber that got nothing before may get it: it is where the arm is, or no set point.
    """

    device: str
    topic: str
    type: str
    cdr: bytes
    qos: Qos
    stamp_ns: int = 0
    max_age_ns: int = 0
    needs_ns: int = 0
    speed_code: str = "command_speed"
    begins: bool = True


@dataclass(frozen=True, slots=True)
class Heard:
    """What the middleware knows of the subscribers of a topic at the moment of a write.

    Attributes:
        subscribers: those that a message reaches now, without our own.
        joined: whether one has joined since the last write.
        unsettled: whether one might not receive yet, though it is matched.
    """

    subscribers: int
    joined: bool = False
    unsettled: bool = False


@dataclass(frozen=True, slots=True)
class Unwritten:
    """Why an order was not written: ``code`` is one of ``REFUSED_COMMANDS``."""

    code: str
    text: str


def unwritten(order: Order, known: Heard, now_ns: int, passed_ns: int | None) -> Unwritten | None:
    """Return why an order must not be written now; None: it may be.

    Args:
        order: the order.
        known: what is known of the subscribers of its topic.
        now_ns: time by the clock of the host, UTC ns.
        passed_ns: since the end of the last write to the topic, by a monotonic clock; None: there was none.
    """
    device = order.device
    if known.subscribers <= 0:
        return Unwritten(UNHEARD, f"{device}: found no subscriber of {order.topic}, expected a robot")
    if known.unsettled:
        text = f"{device}: found a subscriber of {order.topic} that is not ready yet, expected one that is"
        return Unwritten(UNHEARD, text)
    if known.joined and not order.begins:
        text = f"{device}: found a new subscriber of {order.topic}, expected a set point where the arm is"
        return Unwritten(NEWCOMER, text)
    age_ns = now_ns - order.stamp_ns
    # the middleware stamps it a little later
    most_ns = order.max_age_ns - min(_STAMP_NS, order.max_age_ns // 10)
    if order.max_age_ns and order.stamp_ns > 0 and age_ns > most_ns:
        most = f"at most {order.max_age_ns / NS_PER_S:g} s (max_age_s)"
        return Unwritten(LATE, f"{device}: found {age_ns / NS_PER_S:.3f} s of age at the write, expected {most}")
    if passed_ns is not None and passed_ns < order.needs_ns:
        least = f"{order.needs_ns / NS_PER_MS:.4g} ms for its way"
        text = f"{device}: found {passed_ns / NS_PER_MS:.4g} ms since the last write, expected {least}"
        return Unwritten(order.speed_code, text)
    return None


def note_of(stream: str, orders: Mapping[int, Unwritten]) -> Note:
    """Return the note about the orders of a message of ``stream`` that were not written; keys: their numbers."""
    data = {ORDERS: {str(number): [one.code, one.text] for number, one in orders.items()}}
    return Note(Level.INFO, UNWRITTEN, "the next message has commands that were not written", stream, data)


def is_unwritten(entry: Entry) -> bool:
    """Return whether an entry is the note about the commands of the next message that were not written."""
    if entry.kind is not Kind.EDGE_NOTE or _MARK not in (data := entry.data()):
        return False
    return Note.of(data).code == UNWRITTEN


def orders_of(note: Note) -> dict[int, Unwritten]:
    """Return number → why for the orders that a note has; {} if it is not one, or not as `note_of` makes it."""
    found: Any = note.data.get(ORDERS)
    if note.code != UNWRITTEN or not isinstance(found, dict):
        return {}
    orders: dict[int, Unwritten] = {}
    for text, pair in found.items():
        number = whole_number(text)
        if number is None or not isinstance(pair, list) or [type(each) for each in pair] != [str, str]:
            return {}
        orders[number] = Unwritten(*pair)
    return orders
