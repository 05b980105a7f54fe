"""The rules: one table, each row with a pure function that looks at what was observed.

The order is that of the causes: where nothing arrives, the first finding in the table explains it, and what comes
further down may follow from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from igtl_gateway.convert.names import MAX_DEVICE_NAME, topic_token
from igtl_gateway.doctor.observer import MAX_STREAMS, Observer, Peer, Stream
from igtl_gateway.doctor.protocols import is_openigtlink, protocol_of
from igtl_gateway.session.note import Level
from igtl_gateway.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.message import HEADER_VERSIONS
from igtl_gateway.wire.registry import BODIES

#: A peer that goes within this time of a message went because of it.
AT_ONCE_NS = NS_PER_S
#: A link of less than this is no link, and so many of them are a pattern.
SHORT_NS, OFTEN = NS_PER_S, 3
#: Stamps further ahead than this are of another clock; networks do not send messages back in time.
FUTURE_NS = 100 * NS_PER_MS
#: Messages older than this on arrival: no network is so slow.
OLD_NS = NS_PER_S
#: Beyond this, stamps do not count from 1970.
EPOCH_NS = 24 * 3600 * NS_PER_S
#: Of so many messages the stamps tell something; one in ten that stands still is no accident.
FEW_STAMPS, STILL = 10, 10
#: Poses that stay within this many millimetres of the origin, and still move: nobody tracks so close to a tracker.
SMALL_MM, FEW_POSES = 5.0, 5
#: Lengths beyond this, in millimetres, are of no operating room.
LARGE_MM = 50_000.0
#: The finest spacing of an image in millimetres: that of a microscope.
FINE_MM = 0.001
#: A pause of more than so many mean intervals, and of more than a second, in streams of so many messages.
GAP_FACTOR, GAP_NS, RHYTHM = 10, NS_PER_S, 20


class Severity(Enum):
    """How bad it is; the letter stands in the number of the rule."""

    ERROR = "error"  #: messages do not get through, or are wrong
    WARNING = "warning"  #: they get through, and may mislead
    INFO = "info"  #: good to know


@dataclass(frozen=True, slots=True)
class Hit:
    """One case that a rule applies to: where, and what was found there."""

    where: str
    text: str
    data: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Rule:
    """A row of the table.

    Attributes:
        id: ``IGTL-E101``: letter of the severity, and a number that never changes its meaning.
        title: what it finds, in a few words.
        section: where the protocol (``Protocol/….md`` of OpenIGTLink) or our own documents say so.
        advice: what to do.
        check: gives the cases.
    """

    id: str
    title: str
    section: str
    advice: str
    check: Callable[[Observer], Iterable[Hit]]

    @property
    def severity(self) -> Severity:
        return next(one for one in Severity if one.name[0] == self.id[5])


@dataclass(frozen=True, slots=True)
class Finding:
    """A rule that applied, and where."""

    rule: Rule
    hit: Hit

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        rule, hit = self.rule, self.hit
        return {
            "id": rule.id,
            "severity": rule.severity.value,
            "title": rule.title,
            "where": hit.where,
            "text": hit.text,
            "advice": rule.advice,
            "section": rule.section,
            "data": hit.data,
        }


# ── links ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _of_role(seen: Observer, role: str) -> list[Peer]:
    return [peer for peer in seen.peers.values() if peer.role == role]


def _stranger(peer: Peer) -> str | None:
    """What the peer speaks instead of OpenIGTLink, ``""`` if that is not known; None if it does speak it."""
    if not peer.head or is_openigtlink(peer.head):
        return None
    return protocol_of(peer.head)


def _other_protocol(seen: Observer) -> Iterator[Hit]:
    for peer in seen.peers.values():
        stranger = _stranger(peer)
        if stranger is None:
            continue
        shown = _shown(peer.head)
        if peer.messages:
            text = f"after {peer.messages} messages came what is no header: {shown}; a length before it was wrong"
        else:
            text = f"{peer.name} speaks {stranger or 'something else'}: it begins with {shown}"
        yield Hit(peer.name, text, {"protocol": stranger, "head": peer.head.hex()})


def _shown(head: bytes) -> str:
    return repr(head[:24].decode("ascii", "backslashreplace"))


def _both_clients(seen: Observer) -> Iterator[Hit]:
    if seen.intent and seen.intent.role == "client" and not _of_role(seen, "client"):
        for peer in _of_role(seen, "server"):
            text = f"nobody listens at {seen.intent.place}, but {peer.name} connects to us: both sides are clients"
            yield Hit(seen.intent.place, text)


def _both_servers(seen: Observer) -> Iterator[Hit]:
    if seen.intent and seen.intent.role == "server" and not _of_role(seen, "server"):
        for peer in _of_role(seen, "client"):
            if _stranger(peer) is None:
                text = f"nobody connects to {seen.intent.place}, but {peer.name} listens: both sides are servers"
                yield Hit(seen.intent.place, text)


def _no_listener(seen: Observer) -> Iterator[Hit]:
    said = seen.said.get("connect_failed")
    if said and not seen.peers and (seen.intent is None or seen.intent.role == "client"):
        data = said.first.data
        yield Hit(str(data.get("peer", "")), f"nobody listens at {data.get('peer')}: {data.get('reason')}")


def _port_taken(seen: Observer) -> Iterator[Hit]:
    if (said := seen.said.get("listen_failed")) and not any(_both_servers(seen)):
        yield Hit(said.first.stream, said.first.text)


def _nobody_connects(seen: Observer) -> Iterator[Hit]:
    waited = seen.intent and seen.intent.role == "server" and not seen.peers
    if seen.intent and waited and seen.said.keys().isdisjoint(("listen_failed", "refused")):
        yield Hit(seen.intent.place, f"nobody connected to {seen.intent.place}")


def _refused(seen: Observer) -> Iterator[Hit]:
    if said := seen.said.get("refused"):
        yield Hit(str(said.first.data.get("peer", "")), said.first.text, {"count": said.count})


def _silent(seen: Observer) -> Iterator[Hit]:
    """A recording does not tell whether a silent peer was meant to say anything."""
    if seen.intent is None:
        return
    for peer in seen.peers.values():
        if not peer.messages and not peer.head and not peer.received_bytes and peer.up_ns:
            lasted = ((peer.down_ns or seen.ended_ns) - peer.up_ns) / NS_PER_S
            yield Hit(peer.name, f"{peer.name} is connected and sent nothing in {lasted:.1f} s")


def _leaves(seen: Observer) -> Iterator[Hit]:
    """In a recording once is an accident: people stop programs; a program that cannot read on comes again and again."""
    gone: dict[tuple[str, int], list[Hit]] = {}
    for peer in seen.peers.values():
        if not peer.down_ns or not peer.reason.startswith(("closed by the peer", "receiving failed")):
            continue
        for version, told_ns in peer.told.items():
            after_ns = peer.down_ns - told_ns
            if not peer.heard[version] and 0 <= after_ns <= AT_ONCE_NS:
                text = f"{peer.name} went {_ms(after_ns)} after its first message of header version {version}"
                if peer.heard:
                    text += f"; itself it sends version {min(peer.heard)}"
                host = peer.address.rpartition(":")[0]
                gone.setdefault((host, version), []).append(Hit(peer.name, text, {"version": version}))
    for hits in gone.values():
        if seen.intent or len(hits) >= OFTEN:
            yield hits[0]


def _cut(seen: Observer) -> Iterator[Hit]:
    for peer in seen.peers.values():
        if peer.head and is_openigtlink(peer.head) and peer.head_why != "too_large":
            said = seen.said[peer.head_why]
            yield Hit(peer.name, said.first.text, {"head": peer.head.hex()})


def _too_large(seen: Observer) -> Iterator[Hit]:
    for peer in seen.peers.values():
        if peer.head_why == "too_large" and is_openigtlink(peer.head):
            yield Hit(peer.name, seen.said["too_large"].first.text, {"head": peer.head.hex()})


def _slow(seen: Observer) -> Iterator[Hit]:
    for code in ("queue_full", "queue_drop"):
        if said := seen.said.get(code):
            yield Hit(str(said.first.data.get("peer", "")), said.first.text)
            return


def _comes_and_goes(seen: Observer) -> Iterator[Hit]:
    short: dict[str, int] = {}
    for peer in seen.peers.values():
        if peer.up_ns and peer.down_ns and peer.down_ns - peer.up_ns < SHORT_NS:
            host = peer.address.rpartition(":")[0]
            short[host] = short.get(host, 0) + 1
    for host, number in short.items():
        if number >= OFTEN:
            yield Hit(host, f"{number} links with {host} lasted less than {SHORT_NS / NS_PER_S:g} s")


# ── headers ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def _each(applies: Callable[[Stream], int], text: Callable[[Stream], str]) -> Callable[[Observer], Iterator[Hit]]:
    """A check of one stream after the other: it applies where the first gives a number, of messages mostly."""

    def check(seen: Observer) -> Iterator[Hit]:
        for stream in seen.streams.values():
            if number := applies(stream):
                yield Hit(stream.name, text(stream), {"link": stream.link, "count": int(number)})

    return check


def _wrong_versions(stream: Stream) -> list[int]:
    return sorted(set(stream.versions) - set(HEADER_VERSIONS))


def _mixed_versions(seen: Observer) -> Iterator[Hit]:
    for peer in seen.peers.values():
        if len([version for version in peer.heard if version in HEADER_VERSIONS]) > 1:
            counts = ", ".join(f"{count} of version {version}" for version, count in sorted(peer.heard.items()))
            yield Hit(peer.name, f"messages of both header versions: {counts}")


def _unknown_type(stream: Stream) -> str:
    if stream.type.upper() in BODIES:
        return f"the type {stream.type!r} is not written in capitals: peers do not know it"
    return f"the type {stream.type!r} is none of the protocol: it is passed on as it is, undecoded"


# ── stamps ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _ms(ns: int) -> str:
    return f"{ns / NS_PER_S:,.1f} s" if abs(ns) >= NS_PER_S else f"{ns / NS_PER_MS:,.1f} ms"


def _other_epoch(stream: Stream) -> bool:
    stamps = stream.stamps
    return stamps.set > 0 and max(abs(stamps.youngest_ns), abs(stamps.oldest_ns)) > EPOCH_NS


def _in_future(stream: Stream) -> bool:
    return stream.stamps.set > 0 and stream.stamps.youngest_ns < -FUTURE_NS and not _other_epoch(stream)


def _is_old(stream: Stream) -> bool:
    return stream.stamps.set > 0 and stream.stamps.youngest_ns > OLD_NS and not _other_epoch(stream)


def _is_coarse(stream: Stream) -> int:
    stamps = stream.stamps
    if stamps.set < FEW_STAMPS:
        return 0
    if stamps.repeated * STILL >= stamps.set:
        return stamps.repeated
    # whole seconds by chance, all of them?  Then the messages came at whole seconds, too
    spread_ns = stamps.oldest_ns - stamps.youngest_ns
    return stamps.whole_seconds if stamps.whole_seconds == stamps.set and spread_ns > NS_PER_S // 2 else 0


def _coarse(stream: Stream) -> str:
    stamps = stream.stamps
    if not stamps.step_ns:
        return f"all {stamps.set} stamps are the same: the sender's clock stands still"
    return f"{stamps.repeated} of {stamps.set} stamps repeat the one before; the sender's clock has steps of " + _ms(
        stamps.step_ns
    )


# ── names ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _is_full(stream: Stream) -> int:
    full = len(stream.raw_device.encode("utf-8", "surrogateescape")) >= MAX_DEVICE_NAME
    return stream.messages if full and not stream.full_names else 0


def _is_talk(stream: Stream) -> bool:
    """Whether it is about the conversation, and no stream of data."""
    return stream.type.startswith(("GET_", "STT_", "STP_", "RTS_")) or stream.type in {"COMMAND", "STATUS"}


def _same_names(seen: Observer) -> Iterator[Hit]:
    streams = seen.streams.values()
    for stream in streams:
        if len(stream.full_names) > 1:
            names = " and ".join(map(repr, sorted(stream.full_names)))
            yield Hit(stream.name, f"two streams under one name: {names} are both sent as {stream.device!r}")
    links: dict[str, set[int]] = {}
    for stream in streams:
        if stream.device and not _is_talk(stream):
            links.setdefault(stream.name, set()).add(stream.link)
    for name, numbers in links.items():
        there = [number for number in numbers if _together(seen, number, numbers)]
        if len(there) > 1:
            yield Hit(name, f"{len(there)} peers send {name} at the same time; receivers take them for one stream")


def _together(seen: Observer, number: int, others: set[int]) -> bool:
    """Whether the peer was there at the same time as another of them: one that comes back is one peer."""
    mine = seen.peer(number)
    return any(
        mine.up_ns <= (other.down_ns or seen.ended_ns) and other.up_ns <= (mine.down_ns or seen.ended_ns)
        for other in (seen.peer(one) for one in others if one != number)
    )


def _same_tokens(seen: Observer) -> Iterator[Hit]:
    devices: dict[str, set[str]] = {}
    for stream in seen.streams.values():
        devices.setdefault(topic_token(stream.device), set()).add(stream.device)
    for token, names in devices.items():
        if len(names) > 1:
            text = f"{' and '.join(map(repr, sorted(names)))} differ only in what a ROS topic cannot hold"
            yield Hit(token, f"{text}; the later one gets a hash")


def _odd_name(stream: Stream) -> int:
    raw = stream.raw_device + stream.raw_type
    odd = "\x00" in raw or not all(char.isprintable() for char in raw)
    return stream.messages if odd else 0


# ── content ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def _is_small(stream: Stream) -> int:
    lengths = stream.lengths
    few = lengths.messages < FEW_POSES if lengths.poses else lengths.positions < FEW_POSES
    return 0 if few or not lengths.moved or not 0 < lengths.largest < SMALL_MM else lengths.messages


def _is_fine(stream: Stream) -> int:
    spacing = stream.lengths.smallest_spacing
    return 0 if spacing is None or spacing >= FINE_MM else stream.messages


def _has_gap(stream: Stream) -> int:
    if stream.messages < RHYTHM:
        return 0
    mean_ns = (stream.last_ns - stream.first_ns) / (stream.messages - 1)
    return int(stream.longest_pause_ns > max(GAP_FACTOR * mean_ns, GAP_NS))


# ── ROS ───────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _qos_clash(seen: Observer) -> Iterator[Hit]:
    for clash in seen.graph.clashes() if seen.graph else ():
        text = f"nothing passes from {clash.publisher} to {clash.subscriber}: {clash.why}"
        yield Hit(clash.topic, text, {"publisher": clash.publisher, "subscriber": clash.subscriber})
    if said := seen.said.get("ros_incompatible_qos"):
        yield Hit(said.first.stream, said.first.text, {"count": said.count})


def _unconverted(seen: Observer) -> Iterator[Hit]:
    for topic, kind in sorted(seen.graph.unconverted.items()) if seen.graph else ():
        yield Hit(topic, f"{topic} is to be sent to OpenIGTLink, but nothing converts {kind}")
    said = seen.said.get("no_conversion")
    if said and said.first.stream.startswith("/"):
        yield Hit(said.first.stream, said.first.text, {"count": said.count})


def _unheard(seen: Observer) -> Iterator[Hit]:
    for topic in seen.graph.unheard() if seen.graph else ():
        yield Hit(topic, f"nobody in ROS subscribes to {topic}")


def _nothing_out(seen: Observer) -> Iterator[Hit]:
    if seen.graph is not None and not seen.graph.sent:
        yield Hit("/igtl/out", "no ROS node publishes a topic that the gateway sends to OpenIGTLink")


def _ros_refused(seen: Observer) -> Iterator[Hit]:
    for code in ("ros_unknown_type", "ros_refused"):
        if said := seen.said.get(code):
            yield Hit(said.first.stream, said.first.text, {"count": said.count})


# ── the recording ─────────────────────────────────────────────────────────────────────────────────────────────────────


def _damaged(seen: Observer) -> Iterator[Hit]:
    if seen.damage:
        yield Hit("recording", seen.damage)


def _lost(seen: Observer) -> Iterator[Hit]:
    for what, number in seen.losses.items():
        yield Hit(what, f"{number:,} messages lost: {what}", {"count": number})


def _crowded(seen: Observer) -> Iterator[Hit]:
    if seen.crowded:
        yield Hit("streams", f"more than {MAX_STREAMS:,} streams or links: the rest was not looked at")


def _no_messages(seen: Observer) -> Iterator[Hit]:
    if seen.intent is None and not seen.streams:
        yield Hit("recording", "no OpenIGTLink message came in: there is little to judge")


#: Codes of notes that a rule of their own tells of, or that say what the messages themselves show.
_TOLD = frozenset({
    "accept_failed", "bad_crc", "connect_failed", "listen_failed", "malformed", "no_conversion", "queue_drop",
    "queue_full", "refused", "ros_incompatible_qos", "ros_refused", "ros_unknown_type", "stalled", "too_large",
    "truncated",
})  # fmt: skip


def _other_notes(seen: Observer) -> Iterator[Hit]:
    streams = seen.streams.values()
    explained = {one.name for one in streams if one.not_finite or one.not_orthonormal or one.mirrored}
    for code, said in seen.said.items():
        if code not in _TOLD and said.first.level >= Level.WARN and said.first.stream not in explained:
            where = visible(said.first.stream) or code
            yield Hit(where, f"{said.first.text} ({code})", {"code": code, "count": said.count})


HEADER = "Protocol/header.md"
TIME = "docs/conversions.md: Stamps, units and metadata"
NAMES = "docs/conversions.md: Names, topics and frames"
DOCTOR = "docs/doctor.md"

RULES: tuple[Rule, ...] = (
    Rule(
        "IGTL-E701", "the recording is damaged", "docs/session-log.md",
        "`igtl-gateway recover FILE` saves what can be saved", _damaged,
    ),
    Rule(
        "IGTL-E102", "wrong role: both are clients", f"{DOCTOR}: Roles",
        "let one side listen: `--listen` for the gateway, or the server role for the peer", _both_clients,
    ),
    Rule(
        "IGTL-E103", "wrong role: both are servers", f"{DOCTOR}: Roles",
        "let one side connect: `--connect HOST:PORT` for the gateway, or the client role for the peer", _both_servers,
    ),
    Rule(
        "IGTL-E101", "no listener", f"{DOCTOR}: Roles",
        "start the peer as a server there; compare host and port; look at firewalls if it timed out", _no_listener,
    ),
    Rule(
        "IGTL-E104", "the port is taken", f"{DOCTOR}: Roles",
        "stop the program that has the port (a gateway that runs already?), or choose another port", _port_taken,
    ),
    Rule(
        "IGTL-E108", "a peer was refused", f"{DOCTOR}: Roles",
        "name the peer's network with `--allow`, or raise the limit that it met", _refused,
    ),
    Rule(
        "IGTL-E105", "nobody connects", f"{DOCTOR}: Roles",
        "start the peer as a client of this address; behind a loopback address only this machine is served",
        _nobody_connects,
    ),
    Rule(
        "IGTL-E107", "another protocol, or the place in the stream was lost", HEADER,
        "compare the port with the peer's settings; OpenIGTLink is 18944 by custom", _other_protocol,
    ),
    Rule(
        "IGTL-E201", "header version that does not exist", f"{HEADER}: Version number",
        "1 is for protocols 1 and 2, 2 for protocol 3; the sender writes something else there",
        _each(
            lambda one: len(_wrong_versions(one)),
            lambda one: f"header version {', '.join(map(str, _wrong_versions(one)))}, expected 1 or 2",
        ),
    ),
    Rule(
        "IGTL-E202", "header version does not fit the body", f"{HEADER}: Extended header",
        "the sender names one header version and writes the body of the other",
        _each(
            lambda one: one.misfits,
            lambda one: f"{one.misfits} messages say version {min(one.versions)}, with the body of the other one",
        ),
    ),
    Rule(
        "IGTL-E203", "the peer leaves at a header version", f"{HEADER}: Version number",
        "the peer reads the other version only: choose its `profile`, or set the version in its settings", _leaves,
    ),
    Rule(
        "IGTL-E206", "CRC not written", f"{HEADER}: CRC",
        "let the sender compute it (C++: Pack() before sending), or set `check_crc = false`",
        _each(
            lambda one: one.no_crc,
            lambda one: f"the CRC of {one.no_crc} of {one.messages} messages is 0: the sender does not compute it",
        ),
    ),
    Rule(
        "IGTL-E207", "CRC wrong", f"{HEADER}: CRC",
        "the sender changes the body after computing it, or uses another CRC-64 than ECMA-182; "
        "`check_crc = false` lets the messages through",
        _each(
            lambda one: one.bad_crc - one.no_crc,
            lambda one: f"the CRC of {one.bad_crc - one.no_crc} of {one.messages} messages is not that of the body",
        ),
    ),
    Rule(
        "IGTL-E210", "malformed body", "docs/messages.md",
        "the sender's encoding differs from the protocol; `igtl-gateway decode` shows the bytes",
        _each(lambda one: one.malformed, lambda one: f"{one.malformed} messages cannot be read: {one.error}"),
    ),
    Rule(
        "IGTL-E110", "message too large", f"{HEADER}: Body size",
        "raise the limit if that size is meant; a corrupt header looks the same", _too_large,
    ),
    Rule(
        "IGTL-E106", "connected, but silent", f"{DOCTOR}: Silence",
        "tell the peer what to send (3D Slicer: outgoing nodes of the connector; PLUS: what clients are sent)", _silent,
    ),
    Rule(
        "IGTL-E601", "ROS: nothing passes between two that share a topic", f"{DOCTOR}: ROS",
        "subscribe with the type and QoS that is published: best effort and volatile fit every publisher", _qos_clash,
    ),
    Rule(
        "IGTL-W604", "ROS: nothing converts this type", "docs/conversions.md: ROS to OpenIGTLink",
        "publish one of the types of the table, or igtl_msgs/RawMessage", _unconverted,
    ),
    Rule(
        "IGTL-W606", "ROS: topic refused", f"{DOCTOR}: ROS",
        "install the package of the type, or correct the name", _ros_refused,
    ),
    Rule(
        "IGTL-W501", "metres sent as millimetres?", "Protocol/transform.md",
        'OpenIGTLink is in millimetres: multiply by 1000 in the sender, or set `igtl_unit = "m"` for the stream',
        _each(
            _is_small,
            lambda one: f"all {one.lengths.positions} positions are within {one.lengths.largest:.3g} mm of the origin, "
            "as if they were metres",
        ),
    ),
    Rule(
        "IGTL-W502", "lengths too large for millimetres", "Protocol/transform.md",
        "a factor of 1000 was applied twice, or the sender counts in micrometres",
        _each(
            lambda one: one.lengths.messages if one.lengths.largest > LARGE_MM else 0,
            lambda one: f"positions up to {one.lengths.largest / 1000:,.0f} m from the origin",
        ),
    ),
    Rule(
        "IGTL-E503", "numbers that are none", "Protocol/transform.md",
        "stop sending a pose that is not known, or say so in the metadata (TransformStatus)",
        _each(lambda one: one.not_finite, lambda one: f"NaN or infinity in {one.not_finite} messages"),
    ),
    Rule(
        "IGTL-W504", "rotation is none", "Protocol/transform.md",
        "columns of the matrix are the axes, of length 1 and at right angles; a scale does not belong there",
        _each(
            lambda one: one.not_orthonormal,
            lambda one: f"axes not of length 1 or not at right angles in {one.not_orthonormal} messages",
        ),
    ),
    Rule(
        "IGTL-W505", "left-handed axes", "Protocol/transform.md",
        "RAS is right-handed: two axes are exchanged, or one is negated",
        _each(lambda one: one.mirrored, lambda one: f"axes of {one.mirrored} messages are a mirror image"),
    ),
    Rule(
        "IGTL-W506", "spacing of pixels", "Protocol/image.md",
        "the directions of the matrix have the spacing in millimetres as their length; 2-D images need one, too",
        _each(_is_fine, lambda one: f"spacing of {one.lengths.smallest_spacing:.3g} mm"),
    ),
    Rule(
        "IGTL-W402", "one name for two streams", NAMES,
        "give each stream a device name of its own that differs within its first 20 bytes", _same_names,
    ),
    Rule(
        "IGTL-W401", "name of 20 bytes or more, perhaps cut off", f"{HEADER}: Device name",
        "shorten the name; the gateway itself sends the whole one in the metadata of header version 2",
        _each(_is_full, lambda one: f"the device name {one.device!r} fills its 20 bytes: the rest may be cut off"),
    ),
    Rule(
        "IGTL-W403", "no device name", f"{HEADER}: Device name",
        "name the stream: all without a name become one",
        _each(
            lambda one: 0 if one.device or _is_talk(one) else one.messages,
            lambda one: f"{one.type} without a device name",
        ),
    ),
    Rule(
        "IGTL-W404", "odd bytes in a name", f"{HEADER}: Device name",
        "fill names up with zeros, and use UTF-8",
        _each(_odd_name, lambda one: f"the name {one.raw_device!r} has bytes behind a zero, or that cannot be shown"),
    ),
    Rule(
        "IGTL-W405", "name in the body that fills its field", "docs/messages.md",
        "at most 19 bytes: C++ readers drop a name without a zero at its end",
        _each(
            lambda one: len(one.element_names),
            lambda one: f"names of elements fill their field: {', '.join(map(repr, sorted(one.element_names)[:3]))}",
        ),
    ),
    Rule(
        "IGTL-W406", "two devices, one ROS topic", NAMES,
        "name devices with letters, digits and _ only", _same_tokens,
    ),
    Rule(
        "IGTL-W305", "stamps of another epoch", "Protocol/timestamp.md",
        'stamps are UTC since 1970; take the time of receipt for this stream (`stamp = "receive"`)',
        _each(
            _other_epoch,
            lambda one: f"stamps are {abs(one.stamps.oldest_ns) / EPOCH_NS:,.0f} days away from now",
        ),
    ),
    Rule(
        "IGTL-W303", "stamps in the future", "Protocol/timestamp.md",
        "the clocks of the two machines differ: synchronise them (NTP, PTP)",
        _each(_in_future, lambda one: f"stamps are up to {_ms(-one.stamps.youngest_ns)} in the future"),
    ),
    Rule(
        "IGTL-W306", "stamps are old", "Protocol/timestamp.md",
        "clocks differ, or messages wait before they are sent; the two cannot be told apart from here",
        _each(_is_old, lambda one: f"messages are {_ms(one.stamps.youngest_ns)} old on arrival, or more"),
    ),
    Rule(
        "IGTL-W304", "stamps run backwards", "Protocol/timestamp.md",
        "the sender's clock was set, or messages overtake each other",
        _each(
            lambda one: one.stamps.backwards,
            lambda one: f"{one.stamps.backwards} stamps are earlier than the one before, by up to "
            f"{_ms(one.stamps.worst_ns)}",
        ),
    ),
    Rule(
        "IGTL-W302", "stamps quantised, or standing still", "Protocol/timestamp.md",
        'stamp each message with a fine clock, or take the time of receipt (`stamp = "receive"`)',
        _each(_is_coarse, _coarse),
    ),
    Rule(
        "IGTL-W301", "stamps unset", TIME,
        "nothing, if the time of receipt is good enough: the gateway takes that; else let the sender set them",
        _each(
            lambda one: one.stamps.unset,
            lambda one: f"{one.stamps.unset} of {one.stamps.count} messages have the stamp 0, which is unset",
        ),
    ),
    Rule(
        "IGTL-W109", "a message that was not finished", HEADER,
        "the sender died or lost its connection inside a message, or announces more than it sends", _cut,
    ),
    Rule(
        "IGTL-W112", "comes and goes", f"{DOCTOR}: Roles",
        "look into the peer's log: it connects, and leaves at once", _comes_and_goes,
    ),
    Rule(
        "IGTL-W114", "the peer reads too slowly", "docs/performance.md",
        "send less often, or let it read faster; poses and pictures are replaced by newer ones meanwhile", _slow,
    ),
    Rule(
        "IGTL-W204", "both header versions", f"{HEADER}: Version number",
        "nothing, if all who read it know version 2; readers of protocol 1 and 2 lose the stream at it",
        _mixed_versions,
    ),
    Rule(
        "IGTL-W208", "type that is not known", f"{HEADER}: Type name",
        "nothing, if the reader knows it; PLUS and old readers lose the stream at unknown types",
        _each(lambda one: one.messages if one.unknown else 0, _unknown_type),
    ),
    Rule(
        "IGTL-W507", "pause in a stream", f"{DOCTOR}: Rates",
        "a tool out of sight, a stalled sender or network",
        _each(
            _has_gap,
            lambda one: f"a pause of {_ms(one.longest_pause_ns)} in a stream of {one.rate_hz:.1f} Hz",
        ),
    ),
    Rule(
        "IGTL-W703", "messages lost", "docs/session-log.md",
        "see `igtl-gateway info FILE`: losses", _lost,
    ),
    Rule(
        "IGTL-W801", "something else that was noted", f"{DOCTOR}: Notes",
        "see the text", _other_notes,
    ),
    Rule(
        "IGTL-W702", "too many to look at", f"{DOCTOR}: Limits",
        "a peer invents names: give its streams fixed ones", _crowded,
    ),
    Rule(
        "IGTL-I603", "ROS: nobody listens", f"{DOCTOR}: ROS",
        "subscribe to the topic; `ros2 topic list` shows it once messages came", _unheard,
    ),
    Rule(
        "IGTL-I605", "ROS: nothing to send", f"{DOCTOR}: ROS",
        "publish below /igtl/out/, or name topics with `--send`", _nothing_out,
    ),
    Rule(
        "IGTL-I704", "no OpenIGTLink in it", "docs/session-log.md",
        "record with peers connected", _no_messages,
    ),
)  # fmt: skip


def judge(seen: Observer) -> list[Finding]:
    """All findings, in the order of the table."""
    return [Finding(rule, hit) for rule in RULES for hit in rule.check(seen)]
