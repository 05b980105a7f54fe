"""Whether the gateway is active: if not, it refuses all messages, and what it refuses is counted and reported."""

from __future__ import annotations

from igtl_gateway.base.quantities import by_count, count_text
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding

#: Fate of refused messages, and code of the notes about them.
INACTIVE = "inactive"


class Activity:
    """Whether messages pass.

    A gateway that is not active still knows what a late joiner has to know: it keeps the list of peers, what it learns
    about them, the tree of frames and the latest message of each ROS topic.

    Attributes:
        active: whether messages pass.
    """

    def __init__(self) -> None:
        self.active = True
        self._refused = 0
        self._times = 0  # that it was deactivated: each time, the first refused message of a stream is reported

    def change(self, active: bool) -> list[Finding]:
        """Set whether messages pass; return the findings about those that did not."""
        if active == self.active:
            return []
        self.active = active
        number, self._refused = self._refused, 0
        if not active:
            self._times += 1
        if not number:
            return []
        return [
            Finding(
                Level.INFO,
                "active",
                f"{count_text(number, 'message')} {by_count(number, 'was', 'were')} refused while the gateway was "
                "not active",
            )
        ]

    def refuse(self, entry: Entry) -> Finding:
        """Count a refused message; return the finding about its stream."""
        self._refused += 1
        link = entry.links[0] if entry.links else 0
        return Finding(
            Level.WARN,
            INACTIVE,
            f"{entry.channel} is refused: the gateway is not active",
            entry.channel,
            entry.links,
            subject=f"{self._times} {entry.channel}",
            by=link,
        )
