"""The rules: one table, each row with the check that applies it.

The order is that of the causes: where nothing arrives, the first finding in the table explains it, and what comes
further down may follow from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any

from igtl_gateway.doctor import checks
from igtl_gateway.doctor.checks import Hit, each
from igtl_gateway.doctor.observer import Observer


class Severity(Enum):
    """How bad it is; the letter stands in the number of the rule."""

    ERROR = "error"  #: messages do not get through, or are wrong
    WARNING = "warning"  #: they get through, and may mislead
    INFO = "info"  #: good to know


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


HEADER = "Protocol/header.md"
TIME = "docs/conversions.md: Stamps, units and metadata"
NAMES = "docs/conversions.md: Names, topics and frames"
DOCTOR = "docs/doctor.md"

RULES: tuple[Rule, ...] = (
    Rule(
        "IGTL-E701", "the recording is damaged", "docs/session-log.md",
        "`igtl-gateway recover FILE` saves what can be saved", checks.damaged,
    ),
    Rule(
        "IGTL-E102", "wrong role: both are clients", f"{DOCTOR}: Roles",
        "let one side listen: `--listen` for the gateway, or the server role for the peer", checks.both_clients,
    ),
    Rule(
        "IGTL-E103", "wrong role: both are servers", f"{DOCTOR}: Roles",
        "let one side connect: `--connect HOST:PORT` for the gateway, or the client role for the peer",
        checks.both_servers,
    ),
    Rule(
        "IGTL-E115", "TLS does not come about", "docs/security.md",
        "compare what both sides speak (`tls://`), their certificates and CAs, the name of the host, and the date",
        checks.no_tls,
    ),
    Rule(
        "IGTL-E101", "no listener", f"{DOCTOR}: Roles",
        "start the peer as a server there; compare host and port; look at firewalls if it timed out",
        checks.no_listener,
    ),
    Rule(
        "IGTL-E104", "the port is taken", f"{DOCTOR}: Roles",
        "stop the program that has the port (a gateway that runs already?), or choose another port", checks.port_taken,
    ),
    Rule(
        "IGTL-E108", "a peer was refused", f"{DOCTOR}: Roles",
        "name the peer's network with `--allow`, or raise the limit that it met", checks.refused,
    ),
    Rule(
        "IGTL-E105", "nobody connects", f"{DOCTOR}: Roles",
        "start the peer as a client of this address; behind a loopback address only this machine is served",
        checks.nobody_connects,
    ),
    Rule(
        "IGTL-E107", "another protocol, or the place in the stream was lost", HEADER,
        "compare the port with the peer's settings; OpenIGTLink is 18944 by custom", checks.other_protocol,
    ),
    Rule(
        "IGTL-E201", "header version that does not exist", f"{HEADER}: Version number",
        "1 is for protocols 1 and 2, 2 for protocol 3; the sender writes something else there",
        each(
            lambda one: len(checks.wrong_versions(one)),
            lambda one: f"header version {', '.join(map(str, checks.wrong_versions(one)))}, expected 1 or 2",
        ),
    ),
    Rule(
        "IGTL-E202", "header version does not fit the body", f"{HEADER}: Extended header",
        "the sender names one header version and writes the body of the other",
        each(
            lambda one: one.misfits,
            lambda one: f"{one.misfits} messages say version {min(one.versions)}, with the body of the other one",
        ),
    ),
    Rule(
        "IGTL-E203", "the peer leaves at a header version", f"{HEADER}: Version number",
        "the peer reads the other version only: choose its `profile`, or set the version in its settings",
        checks.leaves,
    ),
    Rule(
        "IGTL-E206", "CRC not written", f"{HEADER}: CRC",
        "let the sender compute it (C++: Pack() before sending), or set `check_crc = false`",
        each(
            lambda one: one.no_crc,
            lambda one: f"the CRC of {one.no_crc} of {one.messages} messages is 0: the sender does not compute it",
        ),
    ),
    Rule(
        "IGTL-E207", "CRC wrong", f"{HEADER}: CRC",
        "the sender changes the body after computing it, or uses another CRC-64 than ECMA-182; "
        "`check_crc = false` lets the messages through",
        each(
            lambda one: one.bad_crc - one.no_crc,
            lambda one: f"the CRC of {one.bad_crc - one.no_crc} of {one.messages} messages is not that of the body",
        ),
    ),
    Rule(
        "IGTL-E210", "malformed body", "docs/messages.md",
        "the sender's encoding differs from the protocol; `igtl-gateway decode` shows the bytes",
        each(lambda one: one.malformed, lambda one: f"{one.malformed} messages cannot be read: {one.error}"),
    ),
    Rule(
        "IGTL-E110", "message too large", f"{HEADER}: Body size",
        "raise the limit if that size is meant; a corrupt header looks the same", checks.too_large,
    ),
    Rule(
        "IGTL-E106", "connected, but silent", f"{DOCTOR}: Silence",
        "tell the peer what to send (3D Slicer: outgoing nodes of the connector; PLUS: what clients are sent)",
        checks.silent,
    ),
    Rule(
        "IGTL-E601", "ROS: nothing passes between two that share a topic", f"{DOCTOR}: ROS graph",
        "subscribe with the type and QoS that is published: best effort and volatile fit every publisher",
        checks.qos_clash,
    ),
    Rule(
        "IGTL-W604", "ROS: nothing converts this type", "docs/conversions.md: ROS to OpenIGTLink",
        "publish one of the types of the table, or igtl_msgs/RawMessage", checks.unconverted,
    ),
    Rule(
        "IGTL-W606", "ROS: topic refused", f"{DOCTOR}: ROS graph",
        "install the package of the type, or correct the name", checks.ros_refused,
    ),
    Rule(
        "IGTL-W501", "metres sent as millimetres?", "Protocol/transform.md",
        'OpenIGTLink is in millimetres: multiply by 1000 in the sender, or set `igtl_unit = "m"` for the stream',
        each(
            checks.is_small,
            lambda one: f"all {one.lengths.positions} positions are within {one.lengths.largest:.3g} mm of the origin, "
            "as if they were metres",
        ),
    ),
    Rule(
        "IGTL-W502", "lengths too large for millimetres", "Protocol/transform.md",
        "a factor of 1000 was applied twice, or the sender counts in micrometres",
        each(
            lambda one: one.lengths.messages if one.lengths.largest > checks.LARGE_MM else 0,
            lambda one: f"positions up to {one.lengths.largest / 1000:,.0f} m from the origin",
        ),
    ),
    Rule(
        "IGTL-E503", "numbers that are none", "Protocol/transform.md",
        "stop sending a pose that is not known, or say so in the metadata (TransformStatus)",
        each(lambda one: one.not_finite, lambda one: f"NaN or infinity in {one.not_finite} messages"),
    ),
    Rule(
        "IGTL-W504", "rotation is none", "Protocol/transform.md",
        "columns of the matrix are the axes, of length 1 and at right angles; a scale does not belong there",
        each(
            lambda one: one.not_orthonormal,
            lambda one: f"axes not of length 1 or not at right angles in {one.not_orthonormal} messages",
        ),
    ),
    Rule(
        "IGTL-W505", "left-handed axes", "Protocol/transform.md",
        "RAS is right-handed: two axes are exchanged, or one is negated",
        each(lambda one: one.mirrored, lambda one: f"axes of {one.mirrored} messages are a mirror image"),
    ),
    Rule(
        "IGTL-W506", "spacing of pixels", "Protocol/image.md",
        "the directions of the matrix have the spacing in millimetres as their length; 2-D images need one, too",
        each(checks.is_fine, lambda one: f"spacing of {one.lengths.smallest_spacing:.3g} mm"),
    ),
    Rule(
        "IGTL-W402", "one name for two streams", NAMES,
        "give each stream a device name of its own that differs within its first 20 bytes", checks.same_names,
    ),
    Rule(
        "IGTL-W401", "name of 20 bytes or more, perhaps cut off", f"{HEADER}: Device name",
        "shorten the name; the gateway itself sends the whole one in the metadata of header version 2",
        each(
            checks.is_full,
            lambda one: f"the device name {one.device!r} fills its 20 bytes: the rest may be cut off",
        ),
    ),
    Rule(
        "IGTL-W403", "no device name", f"{HEADER}: Device name",
        "name the stream: all without a name become one",
        each(
            lambda one: 0 if one.device or checks.is_talk(one) else one.messages,
            lambda one: f"{one.type} without a device name",
        ),
    ),
    Rule(
        "IGTL-W404", "odd bytes in a name", f"{HEADER}: Device name",
        "fill names up with zeros, and use UTF-8",
        each(
            checks.odd_name,
            lambda one: f"the name {one.raw_device!r} has bytes behind a zero, or that cannot be shown",
        ),
    ),
    Rule(
        "IGTL-W405", "name in the body that fills its field", "docs/messages.md",
        "at most 19 bytes: C++ readers drop a name without a zero at its end",
        each(
            lambda one: len(one.element_names),
            lambda one: f"names of elements fill their field: {', '.join(map(repr, sorted(one.element_names)[:3]))}",
        ),
    ),
    Rule(
        "IGTL-W406", "two devices, one ROS topic", NAMES,
        "name devices with letters, digits and _ only", checks.same_tokens,
    ),
    Rule(
        "IGTL-W305", "stamps of another epoch", "Protocol/timestamp.md",
        'stamps are UTC since 1970: take the time of receipt (`stamp = "receive"`); or what comes is a replay',
        each(
            checks.other_epoch,
            lambda one: f"stamps are {abs(one.timing.most_ns) / checks.EPOCH_NS:,.0f} days away from now",
        ),
    ),
    Rule(
        "IGTL-W303", "stamps in the future", "Protocol/timestamp.md",
        "the clocks of the two machines differ: synchronise them (NTP, PTP)",
        each(checks.in_future, lambda one: f"stamps are up to {checks.ms(-one.timing.least_ns)} in the future"),
    ),
    Rule(
        "IGTL-W306", "stamps are old", "Protocol/timestamp.md",
        "clocks differ, or messages wait before they are sent; the two cannot be told apart from here",
        each(checks.is_old, lambda one: f"messages are {checks.ms(one.timing.least_ns)} old on arrival, or more"),
    ),
    Rule(
        "IGTL-W304", "stamps run backwards", "Protocol/timestamp.md",
        "the sender's clock was set, or messages overtake each other",
        each(
            lambda one: one.timing.backwards,
            lambda one: f"{one.timing.backwards} of {one.timing.stamped} stamps are earlier than the one before",
        ),
    ),
    Rule(
        "IGTL-W302", "stamps quantised, or standing still", "Protocol/timestamp.md",
        'stamp each message with a fine clock, or take the time of receipt (`stamp = "receive"`)',
        each(checks.is_coarse, checks.coarse),
    ),
    Rule(
        "IGTL-W301", "stamps unset", TIME,
        "nothing, if the time of receipt is good enough: the gateway takes that; else let the sender set them",
        each(
            lambda one: one.timing.unset,
            lambda one: f"{one.timing.unset} of {one.timing.messages} messages have the stamp 0, which is unset",
        ),
    ),
    Rule(
        "IGTL-W109", "a message that was not finished", HEADER,
        "the sender died or lost its connection inside a message, or announces more than it sends", checks.cut,
    ),
    Rule(
        "IGTL-W112", "comes and goes", f"{DOCTOR}: Roles",
        "look into the peer's log: it connects, and leaves at once", checks.comes_and_goes,
    ),
    Rule(
        "IGTL-W114", "the peer reads too slowly", "docs/performance.md",
        "send less often, or let it read faster; poses and pictures are replaced by newer ones meanwhile", checks.slow,
    ),
    Rule(
        "IGTL-W204", "both header versions", f"{HEADER}: Version number",
        "nothing, if all who read it know version 2; readers of protocol 1 and 2 lose the stream at it",
        checks.mixed_versions,
    ),
    Rule(
        "IGTL-W208", "type that is not known", f"{HEADER}: Type name",
        "nothing, if the reader knows it; PLUS and old readers lose the stream at unknown types",
        each(lambda one: one.messages if one.unknown else 0, checks.unknown_type),
    ),
    Rule(
        "IGTL-W507", "pause in a stream", f"{DOCTOR}: Rates",
        "a tool out of sight, a stalled sender or network",
        each(
            checks.has_gap,
            lambda one: f"a pause of {checks.ms(one.longest_pause_ns)} in a stream of {one.rate_hz:.1f} Hz",
        ),
    ),
    Rule(
        "IGTL-W703", "messages lost", "docs/session-log.md",
        "see `igtl-gateway info FILE`: losses", checks.lost,
    ),
    Rule(
        "IGTL-W801", "something else that was noted", f"{DOCTOR}: Notes",
        "see the text", checks.other_notes,
    ),
    Rule(
        "IGTL-W702", "too many to look at", f"{DOCTOR}: Limits",
        "a peer invents names: give its streams fixed ones", checks.crowded,
    ),
    Rule(
        "IGTL-I603", "ROS: nobody listens", f"{DOCTOR}: ROS graph",
        "subscribe to the topic; `ros2 topic list` shows it once messages came", checks.unheard,
    ),
    Rule(
        "IGTL-I605", "ROS: nothing to send", f"{DOCTOR}: ROS graph",
        "publish below /igtl/out/, or name topics with `--send`", checks.nothing_out,
    ),
    Rule(
        "IGTL-I704", "no OpenIGTLink in it", "docs/session-log.md",
        "record with peers connected", checks.no_messages,
    ),
)  # fmt: skip


def judge(seen: Observer) -> list[Finding]:
    """All findings, in the order of the table."""
    return [Finding(rule, hit) for rule in RULES for hit in rule.check(seen)]
