"""Scripted scenarios for the gateway on manual time: give the inputs, read the outputs as short lines."""

from __future__ import annotations

from collections.abc import Sequence

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, LINKS_TOPIC, TICK, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Header, Message, decode, encode

#: An arbitrary moment: 2026-01-01T00:00:00Z.
T0_NS = 1_767_225_600_000_000_000


class Script:
    """A session whose time is set by hand.

    What most scripts are not about (new streams, /tf, the list of links) is in the result with ``news`` only.

    Each method feeds one input and returns what it caused, one line an output: ``"igtl TRANSFORM/Tool v1 to 1"``,
    ``"ros /igtl/in/Tool/transform"``, ``"note bad_crc"``.  ``last`` holds the entries themselves.
    """

    def __init__(self, config: Config | None = None, *, news: bool = False) -> None:
        self.gateway = Gateway(config or Config())
        self.session = Session(self.gateway)
        self.now_ns = T0_NS
        self.log: list[Entry] = []
        self.last: list[Entry] = []
        self._news = news

    def feed(
        self,
        kind: Kind,
        payload: Sequence[Buffer],
        channel: str = "",
        type_name: str = "",
        link: int = 0,
        source_ns: int = 0,
    ) -> list[str]:
        self.now_ns += 1_000_000
        links = (link,) if link else ()
        entries = self.session.input(
            self.now_ns, kind, payload, channel=channel, type_name=type_name, links=links, source_ns=source_ns
        )
        self.log += entries
        self.last = [entry for entry in entries if not entry.kind.is_input]
        lines = map(_line, self.last)
        return [line for line in lines if self._news or line not in _EVERYDAY]

    def up(self, link: int, **facts: str) -> list[str]:
        return self.feed(Kind.LINK, (Note(Level.INFO, LINK_UP, "up", data=dict(facts)).pack(),), link=link)

    def down(self, link: int) -> list[str]:
        return self.feed(Kind.LINK, (Note(Level.INFO, LINK_DOWN, "down").pack(),), link=link)

    def igtl(self, message: Message | bytes, link: int = 1) -> list[str]:
        data = message if isinstance(message, bytes) else join(encode(message))
        return self.feed(Kind.IGTL_IN, (data,), link=link)

    def ros(self, topic: str, message: RosMessage, source_ns: int = 0) -> list[str]:
        return self.feed(Kind.ROS_IN, (message.pack(),), topic, message.TYPE, source_ns=source_ns)

    def tick(self, seconds: float = 0.0) -> list[str]:
        """Advance the time by ``seconds``, and run the gateway's tick if it requested one."""
        self.now_ns += round(seconds * 1e9)
        due_ns = self.gateway.due_ns
        if due_ns is None or due_ns > self.now_ns + 1_000_000:
            return []
        return self.feed(Kind.EDGE_NOTE, (Note(Level.INFO, TICK, "tick").pack(),))

    def sent(self) -> list[Message]:
        """The OpenIGTLink messages among the last outputs."""
        return [decode(entry.data()) for entry in self.last if entry.kind is Kind.IGTL_OUT]

    def published(self, topic: str) -> bytes:
        """The only message among the last outputs on a topic."""
        (data,) = [entry.data() for entry in self.last if entry.kind is Kind.ROS_OUT and entry.channel == topic]
        return data

    @property
    def notes(self) -> list[Note]:
        """The notes among the last outputs."""
        return [Note.unpack(entry.data()) for entry in self.last if entry.kind is Kind.NOTE]


_EVERYDAY = frozenset({"note stream", "ros /tf", f"ros {LINKS_TOPIC}"})


def _line(entry: Entry) -> str:
    if entry.kind is Kind.NOTE:
        return f"note {Note.unpack(entry.data()).code}"
    if entry.kind is Kind.IGTL_OUT:
        version = Header.unpack(entry.data()).version
        return f"igtl {entry.channel} v{version} to {','.join(map(str, entry.links))}"
    return f"ros {entry.channel}"
