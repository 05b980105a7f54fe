"""What the page shows of a bridge, as counts: the bridge reads them, and the process of the page does the rest.

A sample has no more than the page shows, and nothing that can be computed from it: while the bridge makes one, messages
wait for the processor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import __version__

if TYPE_CHECKING:
    from igtl_gateway.addon.live import Bridge

#: Directions of the ledger that are shown.
SIDES = ("igtl_in", "ros_in", "igtl_out", "ros_out")
#: What a row of ``watched`` has, times in ns: looks of the guard, the time since the last one (None before the first),
#: and end and length of the last pause between two are what `Rhythm` takes.
WATCHED = (
    "link",
    "stream",
    "age_ns",
    "jitter_ns",
    "stamped",
    "unset",
    "stale",
    "episodes",
    "looks",
    "silent_ns",
    "pause",
)


def sample_of(bridge: Bridge) -> dict[str, Any]:
    """Return the counts of a bridge so far, as JSON values; the caller has let it ``collect``."""
    now_ns = bridge.hub.now_ns()
    totals, recorder = bridge.gateway.ledger.totals(), bridge.recorder
    return {
        "version": __version__,
        "relay": bridge.gateway.config.relay,
        "ros": bridge.ros is not None,
        "peers": _peers(bridge),
        "watched": [
            (
                link,
                stream,
                one.age_ns,
                one.timing.jitter_ns if one.timing.stamped else None,
                one.timing.stamped > 0,
                one.timing.unset > 0,
                one.stale,
                sorted(one.episodes) if one.episodes else (),
                one.timing.messages,
                max(0, now_ns - one.arrived_ns) if one.arrived_ns else None,
                one.timing.pause,
            )
            for (link, stream), one in bridge.gateway.guard.items()
        ],
        "totals": {side: totals.get(side, {}) for side in SIDES},
        "drops": bridge.gateway.ledger.drops(),
        "missing": [one.to_dict() for one in bridge.awaited.missing if one.source.kind != "link"],
        "receivers": bridge.gateway.receivers(),
        "recorder": recorder and recorder.facts() | {"path": str(bridge.options.record)},
    }


def rows_of(sample: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of ``watched`` with their names, in the process of the page."""
    return [dict(zip(WATCHED, row, strict=True)) for row in sample["watched"]]


def _peers(bridge: Bridge) -> list[dict[str, Any]]:
    counters = bridge.tcp.counters()
    found = []
    for link in bridge.tcp.links():
        counts = counters.get(link.number) if link.number else None
        found.append(
            {
                "link": link.number,
                "peer": link.peer,
                "role": link.role,
                "connected": link.connected,
                "profile": bridge.gateway.profile_of(link.number),
                "clock": _clock(bridge, link.number),
                "received": counts.received_messages if counts else 0,
                "sent": counts.sent_messages if counts else 0,
                "dropped": sum(counts.dropped.values()) if counts else 0,
                "queued": counts.queued_messages if counts else 0,
                "queued_bytes": counts.queued_bytes if counts else 0,
                "unconfirmed_bytes": counts.unconfirmed_bytes if counts else 0,
            }
        )
    return found


def _clock(bridge: Bridge, link: int) -> str:
    """Return the offset of a peer's clock in words; "" if no answer shows it."""
    known = bridge.gateway.questions and bridge.gateway.questions.clocks.offset(link, bridge.hub.now_ns())
    return str(known) if known else ""
