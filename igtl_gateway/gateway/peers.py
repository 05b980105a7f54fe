"""The peers of a session: their profiles and header versions, and the streams that they requested."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.base.globs import matches
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.choices import AUTO
from igtl_gateway.convert.igtl_msgs import LinkStatus
from igtl_gateway.convert.plus_signs import TrackedFrames, may_show_plus
from igtl_gateway.convert.profiles import (
    BY_NAME,
    DEFAULT,
    PLUS_1,
    UNRECOGNISED,
    PeerProfile,
    by_rules,
    is_nameless_status,
    profile_shown_by,
)
from igtl_gateway.convert.substitutes import SLICER_READS, Substitute, row_for
from igtl_gateway.wire import Message
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.query import split_query

#: Maximum number of streams that one peer may request, in case it invents names.
MAX_STREAM_REQUESTS = 256
#: Maximum number of types that one peer may show that it knows, likewise.
MAX_KNOWN = 256
#: How often the end of tracking data brings poses back to the fast path: each time, they are compiled for all peers.
MAX_RELEASES = 16

#: Type of tracking data → type of the single poses that it is composed of.
TRACKING = {"TDATA": "TRANSFORM", "QTDATA": "POSITION"}
_NOTHING: frozenset[str] = frozenset()


@dataclass(slots=True)
class StreamRequest:
    """A stream that a peer started (STT_) or stopped (STP_).

    Attributes:
        wanted: True after STT_, False after STP_.
        interval_ns: minimum time between two messages.
        frame: requested coordinate frame of tracking data; "": the frame of the stream.
        sent_ns: gateway time of the last message of each device.
        more_ns: gateway time at which messages of several moments follow one another.
        tool_stamps: of composed tracking data: tool → stamp of its last pose, UTC ns.
    """

    wanted: bool
    interval_ns: int = 0
    frame: str = ""
    sent_ns: dict[str, int] = field(default_factory=dict)
    more_ns: int = -1
    tool_stamps: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class Peer:
    """The peer of one open link.

    Attributes:
        link: number of the link.
        address, role: from the note of the link.
        place: what ``--peer`` and ``[[peers]]`` call it: the address of the server of its link.
        places: all addresses by which settings may name it.
        profile: profile of the peer.
        chosen: whether the configuration sets the profile, or a message has shown it without doubt.
        frames: the search for the frames of PLUS; None: they are not searched.
        knows: types that the peer has shown that it knows, beside those of its profile.
        asked: types that it has asked for, of those that its profile gets only then.
        shown: highest received header version.
        recent: whether all signs of a profile count, and messages have the metadata that a profile expects.
        fitting: the rules by which messages are fitted to it, see ``Config.fitting``.
        reading: the rules by which what deviates in its messages is read, see ``Config.reading``.
        awaited: whether it gets only what every known program reads until its first message may show what it is.
        missed: whether it did not get a message because of that.
        held_until_ns: gateway time until which latched messages are held back at most; 0: they were sent.
        last_sent_ns: gateway time of the last message to the peer.
        sent: number of messages to the peer.
        stream_requests: requests by (type, requested device name).
        releases: how often the peer has ended its tracking data.
    """

    link: int
    address: str
    role: str
    profile: PeerProfile
    chosen: bool
    place: str = "ADDRESS"
    places: tuple[str, ...] = ()
    frames: TrackedFrames | None = None
    knows: set[str] = field(default_factory=set)
    asked: set[str] = field(default_factory=set)
    shown: int = 0
    recent: bool = False
    fitting: int = 0
    reading: int = 0
    awaited: bool = False
    missed: bool = False
    held_until_ns: int = 0
    last_sent_ns: int = 0
    sent: int = 0
    stream_requests: dict[tuple[str, str], StreamRequest] = field(default_factory=dict)
    releases: int = 0

    @property
    def version(self) -> int:
        """Header version of messages to the peer: the highest version received, within the limits of its profile."""
        return min(max(self.profile.first_version, self.shown), self.profile.max_version)

    @property
    def gets(self) -> tuple[object, ...]:
        """What decides which messages the peer gets, and in which form."""
        known = self.missed and not self.may_be_slicer
        return self.profile, self.chosen, self.version, self.shown > 1, len(self.knows), len(self.asked), known

    @property
    def may_be_slicer(self) -> bool:
        """Whether its first message, which would show 3D Slicer, may be on its way."""
        return self.awaited and self.held_until_ns > 0 and not self.shown and not self.chosen

    def must_wait(self, igtl_type: str) -> bool:
        """Return whether it does not get a type yet that it may not read."""
        return self.may_be_slicer and igtl_type not in SLICER_READS and split_query(igtl_type) is None

    def may_send(self, igtl_type: str) -> bool:
        """Return whether messages of this type may be sent to the peer."""
        if self.profile.may_send(igtl_type) or igtl_type in self.asked:
            return True
        return not self.chosen and (igtl_type in self.knows or (self.profile is UNRECOGNISED and self.shown > 1))

    def greets_with(self, message: Message) -> bool:
        """Return whether the first message of the peer is its greeting: in header version 1 it has no sign."""
        return bool(self.fitting and self.profile.greeting) and is_nameless_status(message)

    def instead_of(self, igtl_type: str) -> Substitute | None:
        """Return the row of what the peer gets in place of a type that it does not read; None if it has no table."""
        return row_for(self.profile.instead, igtl_type)

    def expects(self, content: Body) -> tuple[tuple[str, str], ...]:
        """Return the metadata that the peer expects with a content; none in header version 1, which has no metadata."""
        metadata = self.profile.expects.get(type(content)) if self.recent and self.version > 1 else None
        return metadata(content) if metadata else ()

    def learn_from(self, message: Message) -> bool:
        """Learn version, profile and types from a message; return whether one of them changed."""
        before = (self.profile, self.shown, len(self.knows), len(self.asked))
        # who writes another layout than that of its header version reads that of version 1
        self.shown = max(self.shown, 1 if message.deviation else message.header_version)
        if not self.chosen:
            self._recognise(message)
        query = split_query(message.type) if self.profile.if_asked else None
        if query and query[0] in ("GET", "STT") and query[1] in self.profile.if_asked:
            self.asked.add(query[1])
        return (self.profile, self.shown, len(self.knows), len(self.asked)) != before

    def _recognise(self, message: Message) -> None:
        profile = profile_shown_by(message, all_signs=self.recent)
        if profile and (self.reading or not profile.milliseconds):
            self.profile, self.chosen, self.frames = by_rules(profile, self.fitting), profile is not PLUS_1, None
        elif self.frames:
            news = [name for name in _known_types(message) if not self.profile.may_send(name)]
            self.knows.update(news[: MAX_KNOWN - len(self.knows)])
            if self.frames.follow(message):
                self.profile, self.frames = PLUS_1, None

    def must_see(self, message: Message) -> bool:
        """Return whether each message of a stream must be seen: the next ones may show what the peer is."""
        if self.profile.milliseconds:
            return True  # compiled streams read stamps as the protocol has them
        if self.chosen or not self.recent:
            return False
        return (self.frames is not None and self.frames.must_see(message)) or may_show_plus(message)

    @property
    def paced_types(self) -> frozenset[str]:
        """The types whose streams follow requests of the peer: those that it started or stopped, and their parts."""
        if not self.stream_requests:
            return _NOTHING
        types = {igtl_type for igtl_type, _ in self.stream_requests}
        if self.tracked or self.releases > MAX_RELEASES:
            types.update(TRACKING.values())
        return frozenset(types)

    @property
    def tracked(self) -> list[tuple[str, str]]:
        """(type, requested device) of tracking data that the peer requests, composed of the poses of other streams."""
        return [key for key, request in self.stream_requests.items() if key[0] in TRACKING and request.wanted]

    def stream_request(self, igtl_type: str, device: str) -> StreamRequest | None:
        """Return the request of the peer for a stream: for this device, or for any device."""
        if not self.stream_requests:
            return None
        return self.stream_requests.get((igtl_type, device)) or self.stream_requests.get((igtl_type, ""))

    def claim_due(self, igtl_type: str, device: str, now_ns: int) -> bool:
        """Return whether a message of a stream is due, and start the next interval; always True without a request."""
        if not self.is_due(igtl_type, device, now_ns):
            return False
        if request := self.stream_request(igtl_type, device):
            request.sent_ns[device] = now_ns
        return True

    def is_due(self, igtl_type: str, device: str, now_ns: int) -> bool:
        """Return whether a message of a stream is due, without starting the next interval."""
        request = self.stream_request(igtl_type, device)
        if request is None:
            return True
        waited_ns = now_ns - request.sent_ns.get(device, -request.interval_ns)
        return request.wanted and (waited_ns >= request.interval_ns or now_ns == request.more_ns)

    def take_news(self, igtl_type: str, device: str, stamps: Mapping[str, int], now_ns: int) -> bool:
        """Return whether poses of tracking data are news, which may all be sent now: tool → stamp, UTC ns."""
        request = self.stream_request(igtl_type, device)
        if request is None or all(request.tool_stamps.get(tool) == stamp_ns for tool, stamp_ns in stamps.items()):
            return False
        request.tool_stamps.update(stamps)
        request.more_ns = now_ns
        return True

    def start_stream(self, igtl_type: str, device: str, interval_ns: int, frame: str) -> bool:
        """Start a stream (STT_); return False if the peer has too many."""
        if (igtl_type, device) not in self.stream_requests and len(self.stream_requests) >= MAX_STREAM_REQUESTS:
            return False
        self.stream_requests[igtl_type, device] = StreamRequest(True, interval_ns, frame)
        return True

    def stop_stream(self, igtl_type: str, device: str) -> None:
        """Stop a stream (STP_); without a device, all streams of the type."""
        tracked = bool(self.tracked)
        for key in [key for key in self.stream_requests if key[0] == igtl_type and device in ("", key[1])]:
            del self.stream_requests[key]
        self.releases += tracked and not self.tracked
        if len(self.stream_requests) < MAX_STREAM_REQUESTS:
            self.stream_requests[igtl_type, device] = StreamRequest(False)

    def status(self) -> LinkStatus:
        """Return the status of the link as a ROS message."""
        return LinkStatus(self.link, True, self.address, self.role, self.profile.name, self.shown)


class Peers:
    """All peers of open links, by link number.

    Attributes:
        changed: called with the link of a peer that connects, disconnects, gets other messages than before, or
            requests streams of another type: compiled streams (`igtl_gateway.gateway.fastpath`) to all peers and from
            this one are invalid then.
    """

    def __init__(self, config: Config) -> None:
        self.changed: Callable[[int], None] = lambda link: None
        self._config = config
        self._peers: dict[int, Peer] = {}

    def __len__(self) -> int:
        return len(self._peers)

    def __getitem__(self, link: int) -> Peer:
        return self._peers[link]

    def get(self, link: int) -> Peer | None:
        return self._peers.get(link)

    def up(self, link: int, facts: dict[str, Any], now_ns: int) -> Peer:
        """Add the peer of a new link.

        ``facts`` are the data of its note: ``peer``, ``local``, ``role``, and ``asked``, the address of a server as the
        configuration has it, if that is another one, such as localhost.
        """
        address, role = str(facts.get("peer", "")), str(facts.get("role", ""))
        place = str(facts.get("local", "")) if role == "server" else address
        places = [place, address, *filter(None, [str(facts.get("asked", ""))])]
        rows = (row.profile for row in self._config.peers if any(matches(row.at, one) for one in places))
        name = next(rows, self._config.peer_profile)
        # who bridges CRTK arms has peers that read their types
        unknown = UNRECOGNISED if self._config.cautious and not self._config.all_arms else DEFAULT
        profile = by_rules(BY_NAME.get(name, unknown), self._config.fitting)
        peer = Peer(link, address, role, profile, name != AUTO, place or "ADDRESS", last_sent_ns=now_ns)
        peer.recent, peer.fitting, peer.reading = self._config.knows_peers, self._config.fitting, self._config.reading
        peer.awaited = bool(self._config.cautious and self._config.fitting)
        if name == AUTO and peer.recent:
            peer.frames = TrackedFrames(streams=role == "client")
        peer.places = tuple(places)
        self._peers[link] = peer
        return peer

    def down(self, link: int) -> None:
        """Remove the peer of a closed link."""
        self._peers.pop(link, None)

    def all(self) -> Iterable[Peer]:
        """Return all peers in the order in which they connected."""
        return self._peers.values()


def _known_types(message: Message) -> tuple[str, ...]:
    """Return the types that the sender of a message knows: its own, that which it asks for, those that it lists."""
    if isinstance(message.content, Capability):
        return message.content.types
    query = split_query(message.type)
    if query is None:
        return (message.type,)
    return (query[1],) if query[0] in ("GET", "STT") else ()


def interval_ns(resolution_ms: int) -> int:
    """Return the minimum interval for the resolution of a query; a negative one means as fast as possible."""
    return max(0, resolution_ms) * NS_PER_MS
