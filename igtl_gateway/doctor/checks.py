"""The checks of the rules: pure functions that yield a ``RuleMatch`` for each case in the observations.

The limits of the checks are constants of this module, with their reasons.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.base.quantities import count_text, counted, duration_text
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.convert.names import MAX_DEVICE_NAME, topic_token
from igtl_gateway.doctor.observations import ObservedPeer, ObservedStream
from igtl_gateway.doctor.observer import MAX_STREAMS, ORTHONORMAL, Observer
from igtl_gateway.doctor.protocols import is_openigtlink, protocol_of
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.wire.deviations import READ
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.header import HEADER_VERSIONS
from igtl_gateway.wire.registry import BODIES

#: If a peer disconnects within this time of a message, the message is the cause.
IMMEDIATE_NS = NS_PER_S
#: A link is short below this duration; this number of short links is a pattern.
SHORT_NS, MIN_SHORT_LINKS = NS_PER_S, 3
#: Messages are old above this age on arrival: no network has this latency.
OLD_NS = NS_PER_S
#: Stamps with a larger difference from gateway time do not count from 1970.
EPOCH_NS = 24 * 3600 * NS_PER_S
#: Minimum number of stamps for a result; one repeated stamp in this number is not a coincidence.
MIN_STAMPS, REPEATED_ONE_IN = 10, 10
#: Resolution of stamps that is too coarse for motion: a hand with 100 mm/s moves by 1 mm in this time.
COARSE_NS = 10 * NS_PER_MS
#: Largest distance of implausibly small positions from the origin: trackers do not measure so close to themselves.
SMALL_MM, MIN_POSES = 5.0, 5
#: Positions that all are nearer are small in metres, too: the residue of a calibration or the noise of a still tool.
TINY_MM = 0.15
#: Poses are the noise of a still tool, and not a motion, if the mean step is this part of their extent; least number.
NOISE_STEP, MIN_STEPS = 0.2, 20
#: This number of equal poses is no coincidence.
MIN_FROZEN = 10
#: Lengths above this do not occur in an operating room.
LARGE_MM = 50_000.0
#: A pause is longer than this number of mean intervals, and than this time; minimum number of messages of the stream.
GAP_FACTOR, GAP_NS, MIN_MESSAGES = 10, NS_PER_S, 20


def many(number: int) -> str:
    """``1 message``, ``12 messages``."""
    return count_text(number, "message")


@dataclass(frozen=True, slots=True)
class RuleMatch:
    """One case of a rule: the place, what was found there, and its data."""

    where: str
    text: str
    data: dict[str, Any] = field(default_factory=dict)


# ── links ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _of_role(observed: Observer, role: str) -> list[ObservedPeer]:
    return [peer for peer in observed.peers.values() if peer.role == role]


def _foreign_protocol(peer: ObservedPeer) -> str | None:
    """Return the protocol of the peer if it is not OpenIGTLink, ``""`` if it is unknown; None for OpenIGTLink."""
    if not peer.head or is_openigtlink(peer.head):
        return None
    return protocol_of(peer.head)


def other_protocol(observed: Observer) -> Iterator[RuleMatch]:
    for peer in observed.peers.values():
        protocol = _foreign_protocol(peer)
        if protocol is None:
            continue
        shown = _shown(peer.head)
        if peer.messages:
            text = f"after {many(peer.messages)}, the next bytes are not a header: {shown}; an earlier size was wrong"
        else:
            found = protocol or "an unknown protocol"
            text = f"{peer.name} does not send OpenIGTLink but {found}: its first bytes are {shown}"
        yield RuleMatch(peer.name, text, {"protocol": protocol, "head": peer.head.hex()})


def _shown(head: bytes) -> str:
    return repr(head[:24].decode("ascii", "backslashreplace"))


def both_clients(observed: Observer) -> Iterator[RuleMatch]:
    expected = observed.expected
    if expected and expected.role == "client" and not _of_role(observed, "client"):
        for peer in _of_role(observed, "server"):
            text = f"no server at {expected.place}, but {peer.name} connects to this program: both sides are clients"
            yield RuleMatch(expected.place, text)


def both_servers(observed: Observer) -> Iterator[RuleMatch]:
    """Both sides listen.  If the own port is in use, a silent server might be another gateway: not a finding."""
    expected = observed.expected
    if expected and expected.role == "server" and not _of_role(observed, "server"):
        for peer in _of_role(observed, "client"):
            if _foreign_protocol(peer) is None and (peer.messages or "listen_failed" not in observed.notes):
                text = f"no client connects to {expected.place}, but {peer.name} is a server: both sides are servers"
                yield RuleMatch(expected.place, text)


#: Words that occur only in reasons of TLS.
_TLS_WORDS = re.compile(r"TLS|certificate|cipher")


def no_listener(observed: Observer) -> Iterator[RuleMatch]:
    noted, expected = observed.notes.get("connect_failed"), observed.expected
    if noted and not observed.peers and (expected is None or expected.role == "client") and not any(no_tls(observed)):
        for server, first in observed.subjects["connect_failed"].items():
            yield RuleMatch(server, f"no server at {server}: {first.first.data.get('reason')}")


def no_tls(observed: Observer) -> Iterator[RuleMatch]:
    noted = observed.notes.get("connect_failed")
    if noted and not observed.peers and _TLS_WORDS.search(reason := str(noted.first.data.get("reason"))):
        peer = str(noted.first.data.get("peer", ""))
        yield RuleMatch(peer, f"{peer} accepts connections, but the TLS handshake fails: {reason}")


def port_taken(observed: Observer) -> Iterator[RuleMatch]:
    if (noted := observed.notes.get("listen_failed")) and not any(both_servers(observed)):
        yield RuleMatch(noted.first.stream, noted.first.text)


def no_client(observed: Observer) -> Iterator[RuleMatch]:
    waited = observed.expected and observed.expected.role == "server" and not observed.peers
    if observed.expected and waited and observed.notes.keys().isdisjoint(("listen_failed", "refused")):
        yield RuleMatch(observed.expected.place, f"no client connected to {observed.expected.place}")


def refused(observed: Observer) -> Iterator[RuleMatch]:
    for reason, noted in observed.subjects["refused"].items():
        yield RuleMatch(
            str(noted.first.data.get("peer", "")), noted.first.text, {"count": noted.count, "reason": reason}
        )


def silent(observed: Observer) -> Iterator[RuleMatch]:
    """A peer sent nothing.  In a recording this is not a finding: the peer might only receive."""
    if observed.expected is None:
        return
    for peer in _of_role(observed, observed.expected.role):
        if _ends_at_once(peer):
            continue
        if not peer.messages and not peer.head and not peer.received_bytes and peer.up_ns:
            lasted = duration_text((peer.down_ns or observed.ended_ns) - peer.up_ns)
            yield RuleMatch(peer.name, f"{peer.name} is connected, but sent nothing in {lasted}")


def _ends_at_once(peer: ObservedPeer) -> bool:
    """Return whether the peer closed a link without any message in less than ``SHORT_NS``."""
    closed = peer.reason.startswith(("closed by the peer", "receiving failed"))
    is_short = bool(peer.up_ns and peer.down_ns) and peer.down_ns - peer.up_ns < SHORT_NS
    return closed and is_short and not (peer.messages or peer.head or peer.received_bytes or peer.first_sent_ns)


def closed_at_once(observed: Observer) -> Iterator[RuleMatch]:
    """The peer accepts a connection, and closes it before a message.  In a recording it might be any port scan."""
    if observed.expected is None:
        return
    peers = [peer for peer in _of_role(observed, observed.expected.role) if _ends_at_once(peer)]
    if peers:
        first = peers[0]
        lasted = duration_text(first.down_ns - first.up_ns)
        text = f"{first.name} closed the connection after {lasted}, before any message"
        yield RuleMatch(
            first.name,
            text + (f"; so {count_text(len(peers), 'time')}" if len(peers) > 1 else ""),
            {"count": len(peers)},
        )


def is_gateway(observed: Observer) -> Iterator[RuleMatch]:
    for peer in observed.peers.values():
        if peer.is_gateway:
            what = "a bridge of igtl-gateway, which has no message for this link now"
            if peer.is_replay:
                what = "a replay of igtl-gateway that waits for its peer: doctor does not count, and it goes on waiting"
            elif peer.messages > 1:
                what = "a bridge of igtl-gateway"
            yield RuleMatch(peer.name, f"{peer.name} is {what}")


def disconnects_at_version(observed: Observer) -> Iterator[RuleMatch]:
    """A peer disconnects immediately after a message.

    One that left inside its own first message, or sent another protocol, has not left for what it received.  In a
    recording one case is not a finding, because people stop programs.  A program that cannot read a header version
    reconnects and disconnects again and again.
    """
    matches: dict[tuple[str, int], list[RuleMatch]] = {}
    for peer in observed.peers.values():
        if not peer.down_ns or not peer.reason.startswith(("closed by the peer", "receiving failed")):
            continue
        if peer.head and not peer.messages:
            continue
        for version, sent_ns in peer.first_sent_ns.items():
            after_ns = peer.down_ns - sent_ns
            if not peer.received_versions[version] and 0 <= after_ns <= IMMEDIATE_NS:
                after = duration_text(after_ns)
                text = f"{peer.name} disconnected {after} after its first message of header version {version}"
                if peer.received_versions:
                    text += f"; it sends version {min(peer.received_versions)}"
                host = peer.address.rpartition(":")[0]
                matches.setdefault((host, version), []).append(RuleMatch(peer.name, text, {"version": version}))
    for cases in matches.values():
        if observed.expected or len(cases) >= MIN_SHORT_LINKS:
            yield cases[0]


def incomplete(observed: Observer) -> Iterator[RuleMatch]:
    for peer in observed.peers.values():
        if peer.head and is_openigtlink(peer.head) and peer.head_code != "too_large":
            yield RuleMatch(peer.name, peer.head_text, {"head": peer.head.hex()})


def too_large(observed: Observer) -> Iterator[RuleMatch]:
    for peer in observed.peers.values():
        if peer.head_code == "too_large" and is_openigtlink(peer.head):
            yield RuleMatch(peer.name, peer.head_text, {"head": peer.head.hex()})


def slow_reader(observed: Observer) -> Iterator[RuleMatch]:
    for code in ("queue_full", "queue_drop"):
        if noted := observed.notes.get(code):
            yield RuleMatch(str(noted.first.data.get("peer", "")), noted.first.text)
            return


def short_links(observed: Observer) -> Iterator[RuleMatch]:
    short: dict[str, int] = {}
    for peer in observed.peers.values():
        if peer.up_ns and peer.down_ns and peer.down_ns - peer.up_ns < SHORT_NS:
            host = peer.address.rpartition(":")[0]
            short[host] = short.get(host, 0) + 1
    for host, number in short.items():
        if number >= MIN_SHORT_LINKS:
            yield RuleMatch(
                host, f"{count_text(number, 'link')} with {host} lasted less than {duration_text(SHORT_NS)}"
            )


# ── headers ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def is_frozen(stream: ObservedStream) -> int:
    """Return the number of poses of a stream in which nothing moves or turns; 0 for other streams."""
    lengths = stream.lengths
    is_still = lengths.poses and not lengths.changed
    return lengths.messages if is_still and lengths.messages >= MIN_FROZEN else 0


def each_stream(
    applies: Callable[[ObservedStream], int], text: Callable[[ObservedStream], str]
) -> Callable[[Observer], Iterator[RuleMatch]]:
    """Return a check of each stream: a match if ``applies`` returns a positive count, described by ``text``."""

    def check(observed: Observer) -> Iterator[RuleMatch]:
        for stream in observed.streams.values():
            if number := applies(stream):
                yield RuleMatch(stream.name, text(stream), {"link": stream.link, "count": int(number)})

    return check


def deviations(stream: ObservedStream) -> str:
    return "; ".join(f"{many(number)} with {READ[kind]}" for kind, number in sorted(stream.deviations.items()))


def mixed_versions(observed: Observer) -> Iterator[RuleMatch]:
    for peer in observed.peers.values():
        if len([version for version in peer.received_versions if version in HEADER_VERSIONS]) > 1 and not peer.follows:
            counts = ", ".join(
                f"{count} of version {version}" for version, count in sorted(peer.received_versions.items())
            )
            yield RuleMatch(peer.name, f"messages of both header versions: {counts}")


def unknown_type(stream: ObservedStream) -> str:
    if stream.type.upper() in BODIES:
        return f"the type {stream.type!r} is not in capital letters: peers do not recognise it"
    return f"the type {stream.type!r} is not a type of the protocol: its messages are forwarded unchanged"


# ── stamps ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def other_epoch(stream: ObservedStream) -> int:
    timing = stream.timing
    return timing.stamped if max(abs(timing.least_ns), abs(timing.most_ns)) > EPOCH_NS else 0


def in_future(stream: ObservedStream) -> int:
    return 0 if other_epoch(stream) else stream.timing.future


def is_old(stream: ObservedStream) -> int:
    return stream.timing.stamped if OLD_NS < stream.timing.least_ns and not other_epoch(stream) else 0


def other_unit(stream: ObservedStream) -> int:
    return stream.fractions.stamped if stream.fractions.unit else 0


def in_unit(stream: ObservedStream) -> str:
    fractions = stream.fractions
    return (
        f"the fractions of {count_text(fractions.stamped, 'stamp')} count {fractions.unit}, not 2^-32 s: none is above "
        f"{fractions.largest:,}"
        + (f", and ages differ by {duration_text(fractions.spread_ns)}" if fractions.spread_ns >= NS_PER_MS else "")
        + ("; they are read so" if stream.milliseconds else "")
    )


def from_epoch(stream: ObservedStream) -> str:
    text = f"stamps are {duration_text(stream.timing.most_ns)} from the current time"
    if not stream.fractions.is_low_word:
        return text
    return f"{text}: their seconds are 0, and the fraction counts the seconds since 1970, as clients in MATLAB write it"


def is_coarse(stream: ObservedStream) -> int:
    """Return the number of coarse stamps: repeated ones, or all if they are rounded.

    Stamps that count fractions in another unit are another finding.

    Stamps at multiples of a step are not necessarily rounded: messages can be sent at these times.  In that case their
    age is nearly constant.
    """
    timing = stream.timing
    if timing.stamped < MIN_STAMPS or stream.fractions.unit or stream.fractions.is_low_word:
        return 0
    if timing.repeated * REPEATED_ONE_IN >= timing.stamped:
        return timing.repeated
    rounded = timing.step_ns >= COARSE_NS and 2 * (timing.most_ns - timing.least_ns) >= timing.step_ns
    return timing.stamped if rounded else 0


def coarse(stream: ObservedStream) -> str:
    timing = stream.timing
    if timing.repeated == timing.stamped - 1:
        return f"all {count_text(timing.stamped, 'stamp')} are equal: the sender's clock does not advance"
    step = f"rounded to {duration_text(timing.step_ns)}" if timing.step_ns else "from a clock of low resolution"
    return f"stamps are {step}; {timing.repeated} of {timing.stamped} are equal to the previous one"


# ── names ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def is_full(stream: ObservedStream) -> int:
    full = len(stream.raw_device.encode("utf-8", "surrogateescape")) >= MAX_DEVICE_NAME
    return stream.messages if full and not stream.full_names else 0


def is_dialogue(stream: ObservedStream) -> bool:
    """Return whether the stream is queries, commands or status, and not data."""
    return stream.type.startswith(("GET_", "STT_", "STP_", "RTS_")) or stream.type in {"COMMAND", "STATUS"}


def same_names(observed: Observer) -> Iterator[RuleMatch]:
    streams = observed.streams.values()
    for stream in streams:
        if len(stream.full_names) > 1:
            names = " and ".join(map(repr, sorted(stream.full_names)))
            yield RuleMatch(stream.name, f"two streams under one name: {names} are both sent as {stream.device!r}")
    links: dict[str, set[int]] = {}
    for stream in streams:
        if stream.device and not is_dialogue(stream):
            links.setdefault(stream.name, set()).add(stream.link)
    for name, numbers in links.items():
        concurrent = [number for number in numbers if _is_concurrent(observed, number, numbers)]
        if len(concurrent) > 1:
            yield RuleMatch(
                name,
                f"{counted(len(concurrent), 'peer')} send {name} at the same time; receivers treat them as one stream",
            )


def _is_concurrent(observed: Observer, number: int, others: set[int]) -> bool:
    """Return whether the link existed at the same time as another of them: a peer that reconnects is one peer."""
    link = observed.peer(number)
    return any(
        link.up_ns <= (other.down_ns or observed.ended_ns) and other.up_ns <= (link.down_ns or observed.ended_ns)
        for other in (observed.peer(one) for one in others if one != number)
    )


def same_tokens(observed: Observer) -> Iterator[RuleMatch]:
    devices: dict[str, set[str]] = {}
    for stream in observed.streams.values():
        devices.setdefault(topic_token(stream.device), set()).add(stream.device)
    for token, names in devices.items():
        if len(names) > 1:
            text = f"{' and '.join(map(repr, sorted(names)))} differ only in characters that are invalid in a ROS topic"
            yield RuleMatch(token, f"{text}; the second one gets a hash")


def has_invalid_name(stream: ObservedStream) -> int:
    raw = stream.raw_device + stream.raw_type
    invalid = "\x00" in raw or not all(char.isprintable() for char in raw)
    return stream.messages if invalid else 0


# ── content ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def is_small(stream: ObservedStream) -> int:
    lengths = stream.lengths
    few = lengths.messages < MIN_POSES if lengths.poses else lengths.positions < MIN_POSES
    if few or not lengths.moved or not TINY_MM <= lengths.largest < SMALL_MM:
        return 0
    still = lengths.steps >= MIN_STEPS and lengths.path > NOISE_STEP * lengths.span * lengths.steps
    return 0 if still else lengths.messages


def is_fine(stream: ObservedStream) -> int:
    return stream.lengths.fine


def fine(stream: ObservedStream) -> str:
    text = (
        f"spacing of {stream.lengths.smallest_spacing:.3g} mm in {stream.lengths.fine} of "
        f"{counted(stream.messages, 'image')}"
    )
    if stream.lengths.smallest_spacing:
        return text
    return f"{text}: C++ senders that do not call SetSpacing send 0, and pygtlink 1.0.0 always"


def not_rotations(stream: ObservedStream) -> str:
    text = f"columns not perpendicular or not of length 1 in {many(stream.not_orthonormal)}"
    if stream.by_rows == stream.not_orthonormal:
        text += ": its rows are; openigtlink-rust 0.4.1 writes TDATA row by row, the protocol has columns"
    return text


def not_unit(stream: ObservedStream) -> str:
    length = stream.shortest if 1 - stream.shortest > ORTHONORMAL else stream.longest
    text = f"the quaternion of {many(stream.not_unit)} has a length of {length:.3g}, not 1"
    return text if stream.shortest else f"{text}: no rotation; pygtlink 1.0.0 sends 0 unless one is given"


def denormal(observed: Observer) -> Iterator[RuleMatch]:
    for stream in observed.streams.values():
        if stream.denormal:
            text = f"numbers such as {stream.denormal_value:.3g} in {stream.denormal} of {many(stream.messages)}: "
            yield RuleMatch(stream.name, f"{text}the bytes of an integer in a float field?", {"count": stream.denormal})
    for name, topic in observed.topics.items():
        if topic.denormal:
            text = (
                f"{topic.field} is {topic.value:.3g} in {topic.denormal} of {many(topic.messages)} of {topic.type}: "
                "an int, a bool or a number of numpy was assigned to a float field, and rclpy sends other bytes of it"
            )
            yield RuleMatch(name, text, {"field": topic.field, "count": topic.denormal})


def has_gap(stream: ObservedStream) -> int:
    if stream.messages < MIN_MESSAGES:
        return 0
    mean_ns = (stream.last_ns - stream.first_ns) / (stream.messages - 1)
    return int(stream.longest_pause_ns > max(GAP_FACTOR * mean_ns, GAP_NS))


# ── ROS ───────────────────────────────────────────────────────────────────────────────────────────────────────────────


def qos_clash(observed: Observer) -> Iterator[RuleMatch]:
    for clash in observed.graph.clashes() if observed.graph else ():
        text = f"no messages from {clash.publisher} to {clash.subscriber}: {clash.why}"
        yield RuleMatch(clash.topic, text, {"publisher": clash.publisher, "subscriber": clash.subscriber})
    if noted := observed.notes.get("ros_incompatible_qos"):
        yield RuleMatch(noted.first.stream, noted.first.text, {"count": noted.count})


def unconverted(observed: Observer) -> Iterator[RuleMatch]:
    for topic, kind in sorted(observed.graph.unconverted.items()) if observed.graph else ():
        yield RuleMatch(topic, f"{topic} is configured to be sent to OpenIGTLink, but {kind} has no conversion")
    noted = observed.notes.get("no_conversion")
    if noted and noted.first.stream.startswith("/"):
        yield RuleMatch(noted.first.stream, noted.first.text, {"count": noted.count})


def late(observed: Observer) -> Iterator[RuleMatch]:
    """A stream that is late, or early, behind another one with the same movement."""
    for stream, fixed, lag_s in observed.lags:
        way = "late behind" if lag_s > 0 else "ahead of"
        text = f"{stream} is {duration_text(lag_s * NS_PER_S)} {way} {fixed}, which shows the same movement"
        yield RuleMatch(stream, text, {"behind": fixed, "lag_s": lag_s})


def no_source(observed: Observer) -> Iterator[RuleMatch]:
    """A configured source that is not there; of a damaged recording, it may be in what cannot be read."""
    if observed.damage:
        return
    missing = observed.sources.missing(
        observed.streams.values(), observed.topics, observed.peers.values(), observed.graph
    )
    for name, text, setting in missing:
        yield RuleMatch(name, text, {"setting": setting})


def no_subscriber(observed: Observer) -> Iterator[RuleMatch]:
    for topic in observed.graph.without_subscriber() if observed.graph else ():
        yield RuleMatch(topic, f"{topic} has no subscriber in ROS")


def nothing_out(observed: Observer) -> Iterator[RuleMatch]:
    if observed.graph is not None and not observed.graph.sent:
        yield RuleMatch("/igtl/out", "no ROS node publishes a topic that the gateway sends to OpenIGTLink")


def ros_refused(observed: Observer) -> Iterator[RuleMatch]:
    for code in ("ros_unknown_type", "ros_refused"):
        if noted := observed.notes.get(code):
            yield RuleMatch(noted.first.stream, noted.first.text, {"count": noted.count})


# ── the recording ─────────────────────────────────────────────────────────────────────────────────────────────────────


def damaged(observed: Observer) -> Iterator[RuleMatch]:
    if observed.damage:
        yield RuleMatch("recording", observed.damage)
    if number := observed.damaged_indexes:
        text = (
            f"the index of messages is damaged in {number:,} chunk{'' if number == 1 else 's'}, or schemas and "
            "channels before it are: all messages are there, but programs that use these may miss some"
        )
        yield RuleMatch("index", text, {"chunks": number})


def growing(observed: Observer) -> Iterator[RuleMatch]:
    if observed.growing:
        yield RuleMatch("recording", observed.growing)


def lost(observed: Observer) -> Iterator[RuleMatch]:
    for what, number in observed.losses.items():
        yield RuleMatch(what, f"{many(number)} lost: {what}", {"count": number})


def too_many_streams(observed: Observer) -> Iterator[RuleMatch]:
    if observed.too_many_streams:
        yield RuleMatch("streams", f"more than {MAX_STREAMS:,} streams or links: the others were not checked")


def no_messages(observed: Observer) -> Iterator[RuleMatch]:
    if observed.expected is None and observed.graph is None and not observed.streams:
        yield RuleMatch("recording", "the recording has no OpenIGTLink messages from peers: most rules do not apply")


#: Codes of notes that have a rule, or whose cause a rule finds in the messages themselves.
_COVERED = frozenset({
    "accept_failed", "bad_crc", "connect_failed", "deviation_read", "listen_failed", "malformed", "name_cut",
    "no_conversion", "no_source", "queue_drop", "queue_full", "refused", "ros_incompatible_qos", "ros_refused",
    "ros_unknown_type", "stalled", "too_large", "truncated",
})  # fmt: skip


def other_notes(observed: Observer) -> Iterator[RuleMatch]:
    streams = observed.streams.values()
    explained = {one.name for one in streams if one.not_finite or one.not_orthonormal or one.mirrored or one.not_unit}
    for code, noted in observed.notes.items():
        if code not in _COVERED and noted.first.level >= Level.WARN and noted.first.stream not in explained:
            where = visible(noted.first.stream) or code
            yield RuleMatch(where, f"{noted.first.text} ({code})", {"code": code, "count": noted.count})
