"""The OpenIGTLink programs that listen to a replay: what each can read, as in a bridge.

A recording has what its peers read.  Another program may lose the stream at a type, or crash at a query, as 3D Slicer
does.  So each message is adapted to the program that listens, or left out, by the profile of that program.  Without a
profile it is recognised from its messages, and until then gets what every program can skip, see
``docs/reference/messages.md``: no type beyond the factory of the C++ library, no query, no reply to one, header
version 1, and in that no message without content.  3D Slicer gets what its profile has in place of a type that it
does not read.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.errors import WireError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.choices import AUTO
from igtl_gateway.convert.profiles import DEFAULT, UNRECOGNISED, PeerProfile
from igtl_gateway.convert.substitutes import Shown
from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.gateway.dialogue.probing import is_probe
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.metadata import FULL_NAME, restore_metadata
from igtl_gateway.gateway.naming import MAX_NAMES, ShownNames
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.stamps import with_crc_of, with_right_crc
from igtl_gateway.gateway.substitution import Step, in_place_of
from igtl_gateway.wire import HEADER_SIZE, Item, Message, Raw, decode, encode
from igtl_gateway.wire.header import READING
from igtl_gateway.wire.message import sorted_items
from igtl_gateway.wire.query import split_query
from igtl_gateway.wire.registry import BODIES

#: A program that is not recognised.  A recorded query has no use, and 3D Slicer, which may be silent, crashes at it.
_SILENT = replace(UNRECOGNISED, queries=frozenset(), replies=frozenset({"RTS_TDATA", "RTS_COMMAND"}))
_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})

#: The parts of a message, and the links that get them.
Form = tuple[Sequence[Buffer], list[int]]
#: The same, and the stream of the message.
Fitted = tuple[Sequence[Buffer], list[int], str]


@dataclass(slots=True)
class Listeners:
    """The listeners of a replay by link, and what was adapted to them or left out.

    Callbacks of the edge and the player use it from different threads.

    Args:
        profile: profile of all listeners; ``AUTO``: recognised from their messages.
        exact: send the recorded bytes to all.
        relay: whether the recording is of a relay, which passes all bytes between two programs: only a listener
            that is recognised gets less.
        acceptance: which bytes the session accepted as messages; others are sent as they are.  A wrong checksum that
            it accepted is corrected.

    Attributes:
        left_out: (address, profile, type) → number of messages that a listener did not get.
        adapted: (address, profile, type) → number of messages that it got in another form.
        probes: links of `doctor`, for which no replay begins.
    """

    profile: str = AUTO
    exact: bool = False
    relay: bool = False
    acceptance: Acceptance = DEFAULT_ACCEPTANCE
    left_out: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    adapted: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    probes: set[int] = field(default_factory=set)
    _heard: set[int] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _peers: Peers = field(init=False)
    _names: ShownNames = field(init=False)
    _sent: set[str] = field(default_factory=set)
    # links, type and header version → whether all links get such messages as recorded; until a peer changes
    _unchanged: dict[tuple[tuple[int, ...], str, int], bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._peers = Peers(Config(profile=self.profile, cautious=True))
        self._names = ShownNames(self._sent.__contains__)

    def on_link(self, link: int, up: bool, note: Note) -> None:
        """A listener connected or disconnected."""
        with self._lock:
            self._unchanged.clear()
            if up:
                self._peers.up(link, note.data, 0)
            else:
                self._peers.down(link)

    def on_frame(self, link: int, data: Buffer) -> bool:
        """A listener sent a message, which may show what it is; return whether it is the probe of `doctor`."""
        with self._lock:
            self._heard.add(link)
            peer = self._peers.get(link)
            if peer is None:
                return False
            try:
                message = decode(data, check_crc=False, reading=READING)
            except WireError:
                self._unchanged.clear()
                return False
            if is_probe(message):
                self.probes.add(link)
                return True
            if not self.exact:
                self._unchanged.clear()
                peer.learn_from(message)
            return False

    def present(self) -> dict[int, tuple[str, str]]:
        """Return link → address and profile of each listener."""
        with self._lock:
            return {peer.link: (peer.address, peer.profile.name) for peer in self._peers.all()}

    @property
    def awaits_hello(self) -> bool:
        """Whether a listener that has sent nothing yet may be about to show what it is."""
        return not self.exact and self.profile == AUTO and self.has_silent

    @property
    def has_silent(self) -> bool:
        """Whether a listener has sent nothing yet."""
        with self._lock:
            return any(peer.link not in self._heard for peer in self._peers.all())

    def admit(self, entry: Entry, links: Sequence[int]) -> Entry | None:
        """Return an entry with the bytes that the links get; None if none of them can read it.

        If they get different bytes, it is the recorded entry.  Entries for ROS are always admitted.
        """
        return next(iter(self.admit_all([entry], links)), None)

    def admit_all(self, entries: Sequence[Entry], links: Sequence[int]) -> list[Entry]:
        """Return what :meth:`admit` returns for each entry, without those that no link can read."""
        if self.exact or not links:
            return list(entries)
        with self._lock:
            return [one for entry in entries if (one := self._admitted(entry, tuple(links))) is not None]

    def _admitted(self, entry: Entry, links: tuple[int, ...]) -> Entry | None:
        if entry.kind not in _IGTL or self._as_recorded(entry, links):
            return entry
        forms, refused, instead = self._forms(entry, links)
        if not forms:
            self._count(self.left_out, entry, refused)
            return None
        if instead or len(forms) > 1 or forms[0][0] is entry.payload:
            return entry
        self._count(self.adapted, entry, forms[0][1])
        return replace(entry, payload=forms[0][0])

    def fit(self, entry: Entry, links: Sequence[int]) -> list[Form]:
        """Return what each link gets for an entry that was admitted, and count what it does not get."""
        return [(payload, to) for payload, to, _ in self.fit_all([entry], links)]

    def fit_all(self, entries: Sequence[Entry], links: Sequence[int]) -> list[Fitted]:
        """Return what :meth:`fit` returns for each entry, with its stream."""
        if self.exact:
            return [(entry.payload, list(links), entry.channel) for entry in entries]
        together = tuple(links)
        everyone = list(links)
        found: list[Fitted] = []
        with self._lock:
            for entry in entries:
                if self._as_recorded(entry, together):
                    found.append((entry.payload, everyone, entry.channel))
                else:
                    found += ((payload, to, entry.channel) for payload, to in self._fitted(entry, together))
        return found

    def _fitted(self, entry: Entry, links: tuple[int, ...]) -> list[Form]:
        forms, refused, instead = self._forms(entry, links)
        self._count(self.left_out, entry, refused)
        for payload, members in forms:
            if payload is not entry.payload and not instead.intersection(members):
                self._count(self.adapted, entry, members)
        self._count(self.adapted, entry, instead)
        return forms

    def _as_recorded(self, entry: Entry, links: tuple[int, ...]) -> bool:
        """Return whether all links get the recorded bytes, whatever is in them; the caller has the lock.

        Only what follows from the type and the header version is known; anything else has its forms.
        """
        head = entry.payload[0]
        if len(head) <= HEADER_SIZE:
            return False
        key = (links, entry.type, head[1])
        unchanged = self._unchanged.get(key)
        if unchanged is None:
            if len(self._unchanged) >= MAX_NAMES:
                self._unchanged.clear()
            unchanged = self._unchanged[key] = all(self._passes(entry, link) for link in links)
        if unchanged and len(self._sent) < MAX_NAMES:
            self._sent.add(entry.channel)
        return unchanged

    def _passes(self, entry: Entry, link: int) -> bool:
        peer = self._peers.get(link)
        profile = self._profile_for(peer)
        return (
            self.acceptance.check_crc
            and (peer is None or _may_send(peer, profile, entry.type))
            and profile.adapt.get(BODIES.get(entry.type, Raw)) is None
            and _version_for(peer, profile, entry) == entry.payload[0][1]
        )

    def _forms(self, entry: Entry, links: Sequence[int]) -> tuple[list[Form], list[int], set[int]]:
        """Return the forms of a message for the links, those that cannot read it, and those that get others instead.

        The caller has the lock.
        """
        forms: dict[tuple[str, int], Form] = {}
        instead: dict[tuple[str, int], list[Form]] = {}
        refused: list[int] = []
        others: set[int] = set()
        for link in links:
            peer = self._peers.get(link)
            profile = self._profile_for(peer)
            if peer and not _may_send(peer, profile, entry.type):
                group = (profile.name, peer.version)
                if group not in instead:
                    instead[group] = self._instead(entry, peer)
                for form in instead[group]:
                    form[1].append(link)
                if instead[group]:
                    others.add(link)
                else:
                    refused.append(link)
                continue
            version = _version_for(peer, profile, entry)
            key = (profile.name if profile.adapt else "", version)
            if key not in forms:
                forms[key] = _adapted(entry, profile, version, self.acceptance), []
            waits = _lacks_content(forms[key][0]) and not profile.takes_without_content(entry.type, version)
            (refused if waits and profile is not DEFAULT else forms[key][1]).append(link)
        if len(self._sent) < MAX_NAMES:
            self._sent.add(entry.channel)
        found = [form for form in forms.values() if form[1]]
        return found + [form for made in instead.values() for form in made], refused, others

    def _instead(self, entry: Entry, peer: Peer) -> list[Form]:
        """Return what a listener gets in place of a message that it does not read; nothing if there is nothing."""
        row = peer.instead_of(entry.type)
        if row is None or row.show is None:
            return []
        try:
            message = self.acceptance.message(join(entry.payload))
            whole = Shown(entry.type, restore_metadata(message).device_name, message.content)
            steps = in_place_of(whole, entry.channel, [peer], self._names)
            return [
                (self._moved(entry, message, step.shown, step, peer), [])
                for step in steps
                if step.shown is not None and step.readers
            ]
        except WireError:
            return []

    def _moved(self, entry: Entry, message: Message, shown: Shown, step: Step, peer: Peer) -> Sequence[Buffer]:
        items = {item.key: item for item in message.metadata if item.key != FULL_NAME}
        if step.device != step.full_name:
            items[FULL_NAME] = Item.of(FULL_NAME, step.full_name)
        version = _version_for(peer, peer.profile, entry)
        metadata = sorted_items(items.values()) if version > 1 else ()
        parts = encode(Message(shown.igtl_type, step.device, shown.content, message.ticks, version, 0, metadata))
        one = replace(entry, channel=f"{shown.igtl_type}/{step.device}", type=shown.igtl_type, payload=tuple(parts))
        return _adapted(one, peer.profile, version, self.acceptance)

    def _profile_for(self, peer: Peer | None) -> PeerProfile:
        if peer is None or (self.relay and peer.profile is UNRECOGNISED):
            return DEFAULT
        return _SILENT if peer.profile is UNRECOGNISED else peer.profile

    def _count(self, counts: Counter[tuple[str, str, str]], entry: Entry, links: Iterable[int]) -> None:
        for link in links:
            if peer := self._peers.get(link):
                counts[peer.address, peer.profile.name, entry.type] += 1


def _may_send(peer: Peer, profile: PeerProfile, igtl_type: str) -> bool:
    if igtl_type == "RTS_COMMAND" and profile is not _SILENT and profile.replies is not None:
        return False  # it replies to what another program asked: 3D Slicer logs a warning
    if profile.may_send(igtl_type) or igtl_type in peer.asked:
        return True
    # a listener that is not recognised may have shown that it knows the type
    return profile is _SILENT and split_query(igtl_type) is None and peer.may_send(igtl_type)


def _lacks_content(payload: Sequence[Buffer]) -> bool:
    """Return whether these are the bytes of a version 1 message without content: the reply to a query for nothing."""
    return sum(map(len, payload)) == HEADER_SIZE


def _version_for(peer: Peer | None, profile: PeerProfile, entry: Entry) -> int:
    """Return the header version for a listener: the recorded one, unless it would lose the stream at that."""
    recorded = entry.payload[0][1] if len(entry.payload[0]) > 1 else 1
    most = 1 if profile is _SILENT and peer and peer.shown < recorded else profile.max_version
    return max(min(recorded, most), profile.least_version)


def _adapted(entry: Entry, profile: PeerProfile, version: int, acceptance: Acceptance) -> Sequence[Buffer]:
    """Return the bytes for a profile: the recorded ones, if nothing changes or they are damaged.

    A session that accepted wrong checksums has messages that listeners would drop: they get the right one.
    """
    parts = _formed(entry, profile, version, acceptance)
    return parts if acceptance.check_crc else accepted_by_all(parts, acceptance)


def accepted_by_all(parts: Sequence[Buffer], acceptance: Acceptance) -> Sequence[Buffer]:
    """Return a message that a session accepted with the right checksum; the same parts if they have it."""
    data = bytes(join(parts))
    right = with_right_crc(data)
    if right is data:
        return parts
    try:
        acceptance.message(data)
    except WireError:
        return parts  # it was not a message for the session either
    return (right,)


def _formed(entry: Entry, profile: PeerProfile, version: int, acceptance: Acceptance) -> Sequence[Buffer]:
    """Return the bytes for a profile, with a wrong checksum where the recorded one is wrong."""
    adapt = profile.adapt.get(BODIES.get(entry.type, Raw))
    if adapt is None and version == entry.payload[0][1]:
        return entry.payload
    try:
        message = acceptance.message(recorded := join(entry.payload))
        content = adapt(message.content)[0] if adapt and type(message.content) in profile.adapt else message.content
        if content is message.content and version == message.header_version:
            return entry.payload
        items = message.metadata if version > 1 else ()
        parts = encode(Message(message.type, message.device_name, content, message.ticks, version, 0, items))
    except WireError:
        return entry.payload
    adapted = join(parts)
    return entry.payload if adapted == recorded else (with_crc_of(bytes(recorded), bytes(adapted)),)
