"""What a ROS side reports: notes, causes of refusals, and counts of each topic."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from igtl_gateway.base.errors import UnknownTypeError, first_line
from igtl_gateway.base.once import Once
from igtl_gateway.gateway.log.note import Level, Note

OnNote = Callable[[Note], None]


@dataclass(slots=True)
class TopicCounts:
    """Of one topic, in messages.

    Attributes:
        received: passed to the gateway.
        published: passed to the middleware.  The counts ``published``, ``held``, ``unheard``, ``over_budget``,
            ``unwritten`` and ``failed`` add up to all messages that were to be published.
        held: waiting for subscribers now.
        lost: sent by others but never received.
        failed: refused by the middleware, or by a defect of our own.
        ``unheard``: not passed to the middleware, because there was no subscriber, and a later one would not get them.
        over_budget: dropped, because the budget of the site is exceeded.
        unwritten: passed by the guard and not written: commands to a robot (no subscriber, too late, too fast), and
            what was held until it was older than ``max_age_s``.
        forgotten: published, and no longer kept for late joiners, because latched messages exceed ``latched_mib``.
    """

    received: int = 0
    published: int = 0
    held: int = 0
    lost: int = 0
    failed: int = 0
    unheard: int = 0
    over_budget: int = 0
    unwritten: int = 0
    forgotten: int = 0

    def to_dict(self) -> dict[str, int]:
        """As JSON values."""
        return {name: getattr(self, name) for name in _COUNTS}


_COUNTS = tuple(field.name for field in fields(TopicCounts))


class Reports:
    """Notes go to ``on_note``, from any thread and under no lock of the edge."""

    def __init__(self, on_note: OnNote) -> None:
        self._on_note = on_note
        self._lock = threading.Lock()
        self._counts: dict[str, TopicCounts] = {}
        self._note_once = Once()
        self._refusals: dict[tuple[str, str, str], str] = {}  # action, topic, type → cause
        self._clashes: dict[str, str] = {}  # topic → the policy of a publisher that none of our subscriptions fits

    def counters(self) -> dict[str, dict[str, int]]:
        """Counts of each topic, as ``TopicCounts`` names them."""
        with self._lock:
            return {topic: counts.to_dict() for topic, counts in sorted(self._counts.items())}

    def counts(self, topic: str) -> TopicCounts:
        """The counts of a topic, to be continued."""
        with self._lock:
            return self._counts.setdefault(topic, TopicCounts())

    def note(self, level: Level, code: str, text: str, topic: str = "", data: dict[str, Any] | None = None) -> None:
        """Note a fact."""
        self._on_note(Note(level, code, text, topic, data or {}))

    def note_once(self, level: Level, code: str, text: str, topic: str = "") -> None:
        """Note a fact, unless there was one of this code for the topic."""
        if self._note_once.first(code, topic):
            self.note(level, code, text, topic)

    def refuse(self, action: str, topic: str, type_name: str, error: Exception) -> None:
        """Note once that an action (publish, subscribe, serve) is impossible, and keep the cause."""
        cause = f"cannot {action} {type_name}: {first_line(error)}"
        with self._lock:
            if (action, topic, type_name) in self._refusals:
                return
            self._refusals[action, topic, type_name] = cause
        code = "ros_unknown_type" if isinstance(error, UnknownTypeError) else "ros_refused"
        self.note(Level.WARN, code, f"{topic}: {cause}", topic, {"action": action, "type": type_name})

    def refusal(self, action: str, topic: str, type_name: str) -> str:
        """Why the action is impossible, or ``""``."""
        return self._refusals.get((action, topic, type_name), "")

    def failing(self) -> dict[str, str]:
        """Topic that others publish → why nothing has come from it."""
        with self._lock:
            found = {topic: f"the {policy} of its publisher does not fit" for topic, policy in self._clashes.items()}
            found |= {topic: why for (action, topic, _), why in self._refusals.items() if action == "subscribe"}
            counts = {topic: self._counts.get(topic) for topic in found}
        return {topic: why for topic, why in found.items() if not (one := counts[topic]) or not one.received}

    def publish_failed(self, topic: str, failure: str) -> None:
        """Note, once for each topic, that a message was not published; nothing for ``""``."""
        if failure:
            self.note_once(Level.ERROR, "ros_publish_failed", f"{topic}: not published: {failure}", topic)

    def callback_failed(self, what: str, error: Exception, topic: str = "") -> None:
        """Note, once for each topic, that a callback raised."""
        self.note_once(Level.ERROR, "ros_callback_failed", f"{what}: {first_line(error)}", topic)

    def incompatible_qos(self, topic: str, peer: str, policy: str, *, publishes: bool = False) -> None:
        """Note that nothing passes between us and a publisher or subscriber."""
        if publishes:
            with self._lock:
                self._clashes[topic] = policy
        text = f"{topic}: {peer} has an incompatible {policy}, nothing passes between it and us"
        self.note(Level.WARN, "ros_incompatible_qos", text, topic, {"policy": policy, "peer": peer})
