"""Who sent the streams that are exported: those that several peers send in turn are not one movement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from igtl_gateway.addon.igtl import is_dialogue
from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addon.streams import Interleaving

#: Topics of a stream that are named.
_MOST_TOPICS = 5


class Senders:
    """The links of the received streams, and the topics that were made of them."""

    def __init__(self) -> None:
        self._links: dict[str, Interleaving] = {}
        self._selected: set[str] = set()
        self._topics: dict[str, dict[str, None]] = {}
        self._cause = ""

    def see(self, entry: Entry, *, selected: bool) -> None:
        """Take notice of an entry, in the order of the session; ``selected``: it is exported."""
        if entry.kind.is_input:
            self._cause = ""
        if entry.kind is Kind.IGTL_IN and not is_dialogue(entry.type):
            self._cause = entry.channel
            self.receive(entry.channel, entry.links, selected=selected)
        elif selected and self._cause and entry.kind is Kind.ROS_OUT:
            self.cause(self._cause, entry.channel)

    def receive(self, channel: str, links: Sequence[int], *, selected: bool) -> None:
        """Take notice of the next messages of a stream that come from the same links."""
        one = self._links.get(channel)
        if one is None:
            one = self._links[channel] = Interleaving()
        one.add(links)
        if selected:
            self._selected.add(channel)

    def cause(self, channel: str, topic: str) -> None:
        """Take notice that an exported topic is made of a received stream."""
        self._topics.setdefault(channel, {})[topic] = None

    def notes(self) -> Iterator[str]:
        """Yield a sentence for each stream that several peers send in turn."""
        for stream, one in self._links.items():
            topics = list(self._topics.get(stream, ()))
            if not one.is_mixed or not (topics or stream in self._selected):
                continue
            links = " and ".join(map(str, sorted(one.links)))
            more = f", and {len(topics) - _MOST_TOPICS} more" if len(topics) > _MOST_TOPICS else ""
            mixed = f"; so do {', '.join(topics[:_MOST_TOPICS])}{more}" if topics else ""
            yield (
                f"{stream} has the messages of links {links} in turn, which are not one movement{mixed}; "
                f"--streams 'in:{stream}@{min(one.links)}' selects one of them"
            )
