"""Identifiers that are random in each run, of goals and of the clients of services, by the order of their appearance.

Two recordings of one program differ in them only by name, so they are compared by number.  All messages count that can
have one, whether they differ or not: a message with the identifier of another goal is a difference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.exchanges import (
    ACTION_SERVICES,
    ID,
    REQUEST_RECEIVED,
    RESPONSE_SENT,
    ServiceEvent,
    action_of,
    feedback_goal,
    goal_states,
)
from igtl_gateway.gateway.log.entry import Entry

#: Identifiers that are known at most; later ones are compared as they are.
_MOST = 100_000


def numbered_ids(entries: Iterable[Entry]) -> dict[bytes, str]:
    """Return what stands for each identifier: ``goal 1``, ``client 1`` as a client states it, ``server 1`` as a server.

    Args:
        entries: those of services and actions, in their order.
    """
    found: dict[bytes, str] = {}
    counts: Counter[tuple[str, str]] = Counter()
    for entry in entries:
        for what, of, each in _ids(entry):
            if each not in found and len(found) < _MOST:
                counts[what, of] += 1
                found[each] = f"{what} {counts[what, of]}"
    return found


def _ids(entry: Entry) -> Iterator[tuple[str, str, bytes]]:
    """Yield the identifiers of a message: what has it, the topic or action within which it is counted, and itself."""
    data = bytes(entry.data())
    action, part = action_of(entry.channel) or ("", "")
    try:
        if part == "feedback":
            yield "goal", action, feedback_goal(data)
        elif part == "status":
            yield from (("goal", action, goal) for goal, _ in goal_states(data))
        else:
            event = ServiceEvent.unpack(data)
            side = "server" if event.kind in (REQUEST_RECEIVED, RESPONSE_SENT) else "client"
            yield side, entry.channel, event.client
            if part in ACTION_SERVICES and len(event.goal) == ID:
                yield "goal", action, event.goal
    except ConversionError:  # compared as it is
        return
