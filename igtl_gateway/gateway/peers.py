"""The peers of a session: what each has shown, what it may be sent, which streams it asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.config import Config
from igtl_gateway.convert.igtl_msgs import LinkStatus
from igtl_gateway.gateway.profiles import AUTO, BY_NAME, DEFAULT, PeerProfile, profile_shown_by
from igtl_gateway.globs import matches
from igtl_gateway.stamp import NS_PER_MS
from igtl_gateway.wire import Message

#: Streams that one peer may ask for: more is a peer that invents names.
MAX_WISHES = 256


@dataclass(slots=True)
class StreamRequest:
    """A stream that a peer asked for (STT_) or asked to end (STP_).

    Attributes:
        wanted: False after STP_.
        interval_ns: least time between two messages.
        frame: coordinate frame wanted for tracking data, "" for the stream's own.
        sent_ns: gateway time of the last message of each device.
    """

    wanted: bool
    interval_ns: int = 0
    frame: str = ""
    sent_ns: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class Peer:
    """One link that is up.

    Attributes:
        link: its number.
        address, role: as the link told of itself.
        profile: what it is taken for.
        chosen: whether the configuration chose that.
        shown: highest header version received.
        said_ns: gateway time of the last message to it.
        sent: messages to it so far.
        wishes: by (type, device name asked for).
    """

    link: int
    address: str
    role: str
    profile: PeerProfile
    chosen: bool
    shown: int = 0
    said_ns: int = 0
    sent: int = 0
    stream_requests: dict[tuple[str, str], StreamRequest] = field(default_factory=dict)

    @property
    def version(self) -> int:
        """Header version of what it is sent: the highest that it has shown, within its profile."""
        return min(max(self.profile.first_version, self.shown), self.profile.max_version)

    def learn_from(self, message: Message) -> bool:
        """Learn from a message; returns whether that changed what the peer is taken for."""
        before = (self.profile, self.shown)
        self.shown = max(self.shown, message.header_version)
        if not self.chosen and (profile := profile_shown_by(message)):
            self.profile, self.chosen = profile, True
        return (self.profile, self.shown) != before

    def stream_request(self, igtl_type: str, device: str) -> StreamRequest | None:
        """What the peer said of a stream: of this device, or of any."""
        if not self.stream_requests:
            return None
        return self.stream_requests.get((igtl_type, device)) or self.stream_requests.get((igtl_type, ""))

    def claim_due(self, igtl_type: str, device: str, now_ns: int) -> bool:
        """Whether a message of a stream is due; what was never asked for is always."""
        if not self.is_due(igtl_type, device, now_ns):
            return False
        if wish := self.stream_request(igtl_type, device):
            wish.sent_ns[device] = now_ns
        return True

    def is_due(self, igtl_type: str, device: str, now_ns: int) -> bool:
        """The same question, with nothing to follow."""
        wish = self.stream_request(igtl_type, device)
        if wish is None:
            return True
        return wish.wanted and now_ns - wish.sent_ns.get(device, -wish.interval_ns) >= wish.interval_ns

    def start_stream(self, igtl_type: str, device: str, interval_ns: int, frame: str) -> bool:
        """STT_; False where the peer has too many already."""
        if (igtl_type, device) not in self.stream_requests and len(self.stream_requests) >= MAX_WISHES:
            return False
        self.stream_requests[igtl_type, device] = StreamRequest(True, interval_ns, frame)
        return True

    def stop_stream(self, igtl_type: str, device: str) -> None:
        """STP_; without a device it ends all streams of the type."""
        for key in [key for key in self.stream_requests if key[0] == igtl_type and device in ("", key[1])]:
            del self.stream_requests[key]
        if len(self.stream_requests) < MAX_WISHES:
            self.stream_requests[igtl_type, device] = StreamRequest(False)

    def status(self) -> LinkStatus:
        """As ROS is told."""
        return LinkStatus(self.link, True, self.address, self.role, self.profile.name, self.shown)


class Peers:
    """All links that are up, by number.

    Attributes:
        changed: called when a peer comes, goes, shows what it is or asks for streams: what was compiled for the peers
            before (`igtl_gateway.gateway.fastpath`) is void then.
    """

    def __init__(self, config: Config) -> None:
        self.changed: Callable[[], None] = lambda: None
        self._config = config
        self._peers: dict[int, Peer] = {}

    def __len__(self) -> int:
        return len(self._peers)

    def __getitem__(self, link: int) -> Peer:
        return self._peers[link]

    def get(self, link: int) -> Peer | None:
        return self._peers.get(link)

    def up(self, link: int, facts: dict[str, Any], now_ns: int) -> Peer:
        """A link came up; ``facts`` are those of its note: ``peer``, ``local``, ``role``."""
        address, role = str(facts.get("peer", "")), str(facts.get("role", ""))
        place = str(facts.get("local", "")) if role == "server" else address
        rows = (row.profile for row in self._config.peers if matches(row.at, place) or matches(row.at, address))
        name = next(rows, self._config.profile)
        peer = Peer(link, address, role, BY_NAME.get(name, DEFAULT), name != AUTO, said_ns=now_ns)
        self._peers[link] = peer
        return peer

    def down(self, link: int) -> None:
        """A link has gone."""
        self._peers.pop(link, None)

    def all(self) -> Iterable[Peer]:
        """In the order in which they came."""
        return self._peers.values()


def interval_ns(resolution_ms: int) -> int:
    """Least interval of a query's resolution; what is negative is as fast as possible."""
    return max(0, resolution_ms) * NS_PER_MS
