"""The checks of the rules: pure functions that look at what was observed and give the cases.

Where a check compares with a number, the number stands here with its reason.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.convert.names import MAX_DEVICE_NAME, topic_token
from igtl_gateway.doctor.observer import MAX_STREAMS, ObservedPeer, ObservedStream, Observer
from igtl_gateway.doctor.protocols import is_openigtlink, protocol_of
from igtl_gateway.session.note import Level
from igtl_gateway.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.header import HEADER_VERSIONS
from igtl_gateway.wire.registry import BODIES

#: A peer that goes within this time of a message went because of it.
AT_ONCE_NS = NS_PER_S
#: A link of less than this is no link, and so many of them are a pattern.
SHORT_NS, OFTEN = NS_PER_S, 3
#: Messages older than this on arrival: no network is so slow.
OLD_NS = NS_PER_S
#: Beyond this, stamps do not count from 1970.
EPOCH_NS = 24 * 3600 * NS_PER_S
#: Of so many messages the stamps tell something; one in ten that stands still is no accident.
FEW_STAMPS, STILL = 10, 10
#: Steps of stamps that blur what moves: a hand at 100 mm/s is 1 mm further.
COARSE_NS = 10 * NS_PER_MS
#: Poses that stay within this many millimetres of the origin, and still move: nobody tracks so close to a tracker.
SMALL_MM, FEW_POSES = 5.0, 5
#: Lengths beyond this, in millimetres, are of no operating room.
LARGE_MM = 50_000.0
#: The finest spacing of an image in millimetres: that of a microscope.
FINE_MM = 0.001
#: A pause of more than so many mean intervals, and of more than a second, in streams of so many messages.
GAP_FACTOR, GAP_NS, RHYTHM = 10, NS_PER_S, 20


@dataclass(frozen=True, slots=True)
class RuleMatch:
    """One case that a rule applies to: where, and what was found there."""

    where: str
    text: str
    data: dict[str, Any] = field(default_factory=dict)


# ── links ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _of_role(seen: Observer, role: str) -> list[ObservedPeer]:
    return [peer for peer in seen.peers.values() if peer.role == role]


def _stranger(peer: ObservedPeer) -> str | None:
    """What the peer speaks instead of OpenIGTLink, ``""`` if that is not known; None if it does speak it."""
    if not peer.head or is_openigtlink(peer.head):
        return None
    return protocol_of(peer.head)


def other_protocol(seen: Observer) -> Iterator[RuleMatch]:
    for peer in seen.peers.values():
        stranger = _stranger(peer)
        if stranger is None:
            continue
        shown = _shown(peer.head)
        if peer.messages:
            text = (
                f"after {peer.messages} messages, the next bytes are not a header: {shown}; an earlier size was wrong"
            )
        else:
            found = stranger or "an unknown protocol"
            text = f"{peer.name} does not send OpenIGTLink but {found}: its first bytes are {shown}"
        yield RuleMatch(peer.name, text, {"protocol": stranger, "head": peer.head.hex()})


def _shown(head: bytes) -> str:
    return repr(head[:24].decode("ascii", "backslashreplace"))


def both_clients(seen: Observer) -> Iterator[RuleMatch]:
    if seen.intent and seen.intent.role == "client" and not _of_role(seen, "client"):
        for peer in _of_role(seen, "server"):
            text = f"no server at {seen.intent.place}, but {peer.name} connects to this program: both sides are clients"
            yield RuleMatch(seen.intent.place, text)


def both_servers(seen: Observer) -> Iterator[RuleMatch]:
    """Whoever has our own port may be a gateway that runs already, unless it says something."""
    if seen.intent and seen.intent.role == "server" and not _of_role(seen, "server"):
        for peer in _of_role(seen, "client"):
            if _stranger(peer) is None and (peer.messages or "listen_failed" not in seen.noted):
                text = f"no client connects to {seen.intent.place}, but {peer.name} is a server: both sides are servers"
                yield RuleMatch(seen.intent.place, text)


#: What only the reasons of TLS have in them.
_OF_TLS = re.compile(r"TLS|certificate|cipher")


def no_listener(seen: Observer) -> Iterator[RuleMatch]:
    noted = seen.noted.get("connect_failed")
    if noted and not seen.peers and (seen.intent is None or seen.intent.role == "client") and not any(no_tls(seen)):
        data = noted.first.data
        yield RuleMatch(str(data.get("peer", "")), f"no server at {data.get('peer')}: {data.get('reason')}")


def no_tls(seen: Observer) -> Iterator[RuleMatch]:
    noted = seen.noted.get("connect_failed")
    if noted and not seen.peers and _OF_TLS.search(reason := str(noted.first.data.get("reason"))):
        peer = str(noted.first.data.get("peer", ""))
        yield RuleMatch(peer, f"{peer} accepts connections, but the TLS handshake fails: {reason}")


def port_taken(seen: Observer) -> Iterator[RuleMatch]:
    if (noted := seen.noted.get("listen_failed")) and not any(both_servers(seen)):
        yield RuleMatch(noted.first.stream, noted.first.text)


def nobody_connects(seen: Observer) -> Iterator[RuleMatch]:
    waited = seen.intent and seen.intent.role == "server" and not seen.peers
    if seen.intent and waited and seen.noted.keys().isdisjoint(("listen_failed", "refused")):
        yield RuleMatch(seen.intent.place, f"no client connected to {seen.intent.place}")


def refused(seen: Observer) -> Iterator[RuleMatch]:
    if noted := seen.noted.get("refused"):
        yield RuleMatch(str(noted.first.data.get("peer", "")), noted.first.text, {"count": noted.count})


def silent(seen: Observer) -> Iterator[RuleMatch]:
    """A recording does not tell whether a silent peer was meant to say anything."""
    if seen.intent is None:
        return
    for peer in _of_role(seen, seen.intent.role):
        if not peer.messages and not peer.head and not peer.received_bytes and peer.up_ns:
            lasted = ((peer.down_ns or seen.ended_ns) - peer.up_ns) / NS_PER_S
            yield RuleMatch(peer.name, f"{peer.name} is connected, but sent nothing in {lasted:.1f} s")


def leaves(seen: Observer) -> Iterator[RuleMatch]:
    """In a recording once is an accident: people stop programs; a program that cannot read on comes again and again."""
    gone: dict[tuple[str, int], list[RuleMatch]] = {}
    for peer in seen.peers.values():
        if not peer.down_ns or not peer.reason.startswith(("closed by the peer", "receiving failed")):
            continue
        for version, sent_ns in peer.first_sent_ns.items():
            after_ns = peer.down_ns - sent_ns
            if not peer.received_versions[version] and 0 <= after_ns <= AT_ONCE_NS:
                text = f"{peer.name} disconnected {ms(after_ns)} after its first message of header version {version}"
                if peer.received_versions:
                    text += f"; it sends version {min(peer.received_versions)}"
                host = peer.address.rpartition(":")[0]
                gone.setdefault((host, version), []).append(RuleMatch(peer.name, text, {"version": version}))
    for hits in gone.values():
        if seen.intent or len(hits) >= OFTEN:
            yield hits[0]


def cut(seen: Observer) -> Iterator[RuleMatch]:
    for peer in seen.peers.values():
        if peer.head and is_openigtlink(peer.head) and peer.head_why != "too_large":
            noted = seen.noted[peer.head_why]
            yield RuleMatch(peer.name, noted.first.text, {"head": peer.head.hex()})


def too_large(seen: Observer) -> Iterator[RuleMatch]:
    for peer in seen.peers.values():
        if peer.head_why == "too_large" and is_openigtlink(peer.head):
            yield RuleMatch(peer.name, seen.noted["too_large"].first.text, {"head": peer.head.hex()})


def slow(seen: Observer) -> Iterator[RuleMatch]:
    for code in ("queue_full", "queue_drop"):
        if noted := seen.noted.get(code):
            yield RuleMatch(str(noted.first.data.get("peer", "")), noted.first.text)
            return


def comes_and_goes(seen: Observer) -> Iterator[RuleMatch]:
    short: dict[str, int] = {}
    for peer in seen.peers.values():
        if peer.up_ns and peer.down_ns and peer.down_ns - peer.up_ns < SHORT_NS:
            host = peer.address.rpartition(":")[0]
            short[host] = short.get(host, 0) + 1
    for host, number in short.items():
        if number >= OFTEN:
            yield RuleMatch(host, f"{number} links with {host} lasted less than {SHORT_NS / NS_PER_S:g} s")


# ── headers ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def each_stream(
    applies: Callable[[ObservedStream], int], text: Callable[[ObservedStream], str]
) -> Callable[[Observer], Iterator[RuleMatch]]:
    """A check of one stream after the other: it applies where the first gives a number, of messages mostly."""

    def check(seen: Observer) -> Iterator[RuleMatch]:
        for stream in seen.streams.values():
            if number := applies(stream):
                yield RuleMatch(stream.name, text(stream), {"link": stream.link, "count": int(number)})

    return check


def wrong_versions(stream: ObservedStream) -> list[int]:
    return sorted(set(stream.versions) - set(HEADER_VERSIONS))


def mixed_versions(seen: Observer) -> Iterator[RuleMatch]:
    for peer in seen.peers.values():
        if len([version for version in peer.received_versions if version in HEADER_VERSIONS]) > 1:
            counts = ", ".join(
                f"{count} of version {version}" for version, count in sorted(peer.received_versions.items())
            )
            yield RuleMatch(peer.name, f"messages of both header versions: {counts}")


def unknown_type(stream: ObservedStream) -> str:
    if stream.type.upper() in BODIES:
        return f"the type {stream.type!r} is not in capital letters: peers do not recognise it"
    return f"the type {stream.type!r} is not a type of the protocol: its messages are forwarded unchanged"


# ── stamps ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def ms(ns: int) -> str:
    return f"{ns / NS_PER_S:,.1f} s" if abs(ns) >= NS_PER_S else f"{ns / NS_PER_MS:,.1f} ms"


def other_epoch(stream: ObservedStream) -> int:
    timing = stream.timing
    return timing.stamped if max(abs(timing.least_ns), abs(timing.most_ns)) > EPOCH_NS else 0


def in_future(stream: ObservedStream) -> int:
    return 0 if other_epoch(stream) else stream.timing.future


def is_old(stream: ObservedStream) -> int:
    return stream.timing.stamped if OLD_NS < stream.timing.least_ns and not other_epoch(stream) else 0


def is_coarse(stream: ObservedStream) -> int:
    """What comes at even times has even stamps; what comes at odd times, and has even stamps, was rounded."""
    timing = stream.timing
    if timing.stamped < FEW_STAMPS:
        return 0
    if timing.repeated * STILL >= timing.stamped:
        return timing.repeated
    rounded = timing.step_ns >= COARSE_NS and 2 * (timing.most_ns - timing.least_ns) >= timing.step_ns
    return timing.stamped if rounded else 0


def coarse(stream: ObservedStream) -> str:
    timing = stream.timing
    if timing.repeated == timing.stamped - 1:
        return f"all {timing.stamped} stamps are equal: the sender's clock does not advance"
    step = f"rounded to {ms(timing.step_ns)}" if timing.step_ns else "from a clock of low resolution"
    return f"stamps are {step}; {timing.repeated} of {timing.stamped} are equal to the previous one"


# ── names ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def is_full(stream: ObservedStream) -> int:
    full = len(stream.raw_device.encode("utf-8", "surrogateescape")) >= MAX_DEVICE_NAME
    return stream.messages if full and not stream.full_names else 0


def is_dialogue(stream: ObservedStream) -> bool:
    """Whether it is about the conversation, and no stream of data."""
    return stream.type.startswith(("GET_", "STT_", "STP_", "RTS_")) or stream.type in {"COMMAND", "STATUS"}


def same_names(seen: Observer) -> Iterator[RuleMatch]:
    streams = seen.streams.values()
    for stream in streams:
        if len(stream.full_names) > 1:
            names = " and ".join(map(repr, sorted(stream.full_names)))
            yield RuleMatch(stream.name, f"two streams under one name: {names} are both sent as {stream.device!r}")
    links: dict[str, set[int]] = {}
    for stream in streams:
        if stream.device and not is_dialogue(stream):
            links.setdefault(stream.name, set()).add(stream.link)
    for name, numbers in links.items():
        there = [number for number in numbers if _together(seen, number, numbers)]
        if len(there) > 1:
            yield RuleMatch(
                name, f"{len(there)} peers send {name} at the same time; receivers treat them as one stream"
            )


def _together(seen: Observer, number: int, others: set[int]) -> bool:
    """Whether the peer was there at the same time as another of them: one that comes back is one peer."""
    mine = seen.peer(number)
    return any(
        mine.up_ns <= (other.down_ns or seen.ended_ns) and other.up_ns <= (mine.down_ns or seen.ended_ns)
        for other in (seen.peer(one) for one in others if one != number)
    )


def same_tokens(seen: Observer) -> Iterator[RuleMatch]:
    devices: dict[str, set[str]] = {}
    for stream in seen.streams.values():
        devices.setdefault(topic_token(stream.device), set()).add(stream.device)
    for token, names in devices.items():
        if len(names) > 1:
            text = f"{' and '.join(map(repr, sorted(names)))} differ only in characters that are invalid in a ROS topic"
            yield RuleMatch(token, f"{text}; the second one gets a hash")


def odd_name(stream: ObservedStream) -> int:
    raw = stream.raw_device + stream.raw_type
    odd = "\x00" in raw or not all(char.isprintable() for char in raw)
    return stream.messages if odd else 0


# ── content ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def is_small(stream: ObservedStream) -> int:
    lengths = stream.lengths
    few = lengths.messages < FEW_POSES if lengths.poses else lengths.positions < FEW_POSES
    return 0 if few or not lengths.moved or not 0 < lengths.largest < SMALL_MM else lengths.messages


def is_fine(stream: ObservedStream) -> int:
    spacing = stream.lengths.smallest_spacing
    return 0 if spacing is None or spacing >= FINE_MM else stream.messages


def has_gap(stream: ObservedStream) -> int:
    if stream.messages < RHYTHM:
        return 0
    mean_ns = (stream.last_ns - stream.first_ns) / (stream.messages - 1)
    return int(stream.longest_pause_ns > max(GAP_FACTOR * mean_ns, GAP_NS))


# ── ROS ───────────────────────────────────────────────────────────────────────────────────────────────────────────────


def qos_clash(seen: Observer) -> Iterator[RuleMatch]:
    for clash in seen.graph.clashes() if seen.graph else ():
        text = f"no messages from {clash.publisher} to {clash.subscriber}: {clash.why}"
        yield RuleMatch(clash.topic, text, {"publisher": clash.publisher, "subscriber": clash.subscriber})
    if noted := seen.noted.get("ros_incompatible_qos"):
        yield RuleMatch(noted.first.stream, noted.first.text, {"count": noted.count})


def unconverted(seen: Observer) -> Iterator[RuleMatch]:
    for topic, kind in sorted(seen.graph.unconverted.items()) if seen.graph else ():
        yield RuleMatch(topic, f"{topic} is configured to be sent to OpenIGTLink, but {kind} has no conversion")
    noted = seen.noted.get("no_conversion")
    if noted and noted.first.stream.startswith("/"):
        yield RuleMatch(noted.first.stream, noted.first.text, {"count": noted.count})


def no_subscriber(seen: Observer) -> Iterator[RuleMatch]:
    for topic in seen.graph.without_subscriber() if seen.graph else ():
        yield RuleMatch(topic, f"{topic} has no subscriber in ROS")


def nothing_out(seen: Observer) -> Iterator[RuleMatch]:
    if seen.graph is not None and not seen.graph.sent:
        yield RuleMatch("/igtl/out", "no ROS node publishes a topic that the gateway sends to OpenIGTLink")


def ros_refused(seen: Observer) -> Iterator[RuleMatch]:
    for code in ("ros_unknown_type", "ros_refused"):
        if noted := seen.noted.get(code):
            yield RuleMatch(noted.first.stream, noted.first.text, {"count": noted.count})


# ── the recording ─────────────────────────────────────────────────────────────────────────────────────────────────────


def damaged(seen: Observer) -> Iterator[RuleMatch]:
    if seen.damage:
        yield RuleMatch("recording", seen.damage)


def lost(seen: Observer) -> Iterator[RuleMatch]:
    for what, number in seen.losses.items():
        yield RuleMatch(what, f"{number:,} messages lost: {what}", {"count": number})


def crowded(seen: Observer) -> Iterator[RuleMatch]:
    if seen.crowded:
        yield RuleMatch("streams", f"more than {MAX_STREAMS:,} streams or links: the others were not checked")


def no_messages(seen: Observer) -> Iterator[RuleMatch]:
    if seen.intent is None and not seen.streams:
        yield RuleMatch("recording", "the recording has no OpenIGTLink messages from peers: most rules do not apply")


#: Codes of notes that a rule of their own tells of, or that say what the messages themselves show.
_TOLD = frozenset({
    "accept_failed", "bad_crc", "connect_failed", "listen_failed", "malformed", "no_conversion", "queue_drop",
    "queue_full", "refused", "ros_incompatible_qos", "ros_refused", "ros_unknown_type", "stalled", "too_large",
    "truncated",
})  # fmt: skip


def other_notes(seen: Observer) -> Iterator[RuleMatch]:
    streams = seen.streams.values()
    explained = {one.name for one in streams if one.not_finite or one.not_orthonormal or one.mirrored}
    for code, noted in seen.noted.items():
        if code not in _TOLD and noted.first.level >= Level.WARN and noted.first.stream not in explained:
            where = visible(noted.first.stream) or code
            yield RuleMatch(where, f"{noted.first.text} ({code})", {"code": code, "count": noted.count})
