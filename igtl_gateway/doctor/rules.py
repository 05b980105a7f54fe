"""The rules: one table, each row with its check.

Causes precede their effects: if nothing arrives, the first finding in the table explains it, and later ones can be
consequences.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any

from igtl_gateway.base.quantities import by_count, count_text, duration_text, rate_text
from igtl_gateway.doctor import checks
from igtl_gateway.doctor.checks import RuleMatch, each_stream
from igtl_gateway.doctor.observer import Observer


class Severity(Enum):
    """The severity of a rule; its first letter is in the number of the rule."""

    ERROR = "error"  #: messages are lost or wrong
    WARNING = "warning"  #: messages arrive but might mislead
    INFO = "info"  #: information


@dataclass(frozen=True, slots=True)
class Rule:
    """A row of the table.

    Attributes:
        id: such as ``IGTL-E101``: letter of the severity, and a number that never changes its meaning.
        title: the finding in a few words.
        section: of the protocol (``Protocol/….md`` of OpenIGTLink) or of this project's documents.
        advice: what to do.
        check: yields the cases.
        shown: number of cases that are printed; the others are counted.
    """

    id: str
    title: str
    section: str
    advice: str
    check: Callable[[Observer], Iterable[RuleMatch]]
    shown: int = 3

    @property
    def severity(self) -> Severity:
        return next(one for one in Severity if one.name[0] == self.id[5])


@dataclass(frozen=True, slots=True)
class RuleFinding:
    """A case of a rule."""

    rule: Rule
    match: RuleMatch

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as JSON values."""
        rule, match = self.rule, self.match
        return {
            "id": rule.id,
            "severity": rule.severity.value,
            "title": rule.title,
            "where": match.where,
            "text": match.text,
            "advice": rule.advice,
            "section": rule.section,
            "data": match.data,
        }


HEADER = "Protocol/header.md"
TIME = "docs/reference/conversions.md: Stamps, units and metadata"
NAMES = "docs/reference/conversions.md: Names, topics and frames"
DOCTOR = "docs/reference/doctor.md"

RULES: tuple[Rule, ...] = (
    Rule(
        "IGTL-E701", "the recording is damaged", "docs/reference/session-log.md",
        "`igtl-gateway recover FILE` copies all readable data", checks.damaged,
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
        "IGTL-E115", "the TLS handshake fails", "docs/how-to/security.md",
        "check that both sides use TLS (`tls://`); check their certificates and CAs, the host name and the date",
        checks.no_tls,
    ),
    Rule(
        "IGTL-E101", "no server", f"{DOCTOR}: Roles",
        "start the peer as a server at this address; check host and port; check firewalls if the connection timed out",
        checks.no_listener,
    ),
    Rule(
        "IGTL-E104", "the port is in use", f"{DOCTOR}: Roles",
        "stop the program that uses the port (another gateway?), or choose another port", checks.port_taken,
    ),
    Rule(
        "IGTL-E108", "a peer was refused", f"{DOCTOR}: Roles",
        "allow its network (`--allow`) or the origin of its page (`--allow-origin`), or raise the limit it has reached",
        checks.refused,
    ),
    Rule(
        "IGTL-E105", "no client connects", f"{DOCTOR}: Roles",
        "start the peer as a client of this address; a loopback address is reachable from this machine only",
        checks.no_client,
    ),
    Rule(
        "IGTL-E107", "another protocol, or message boundaries lost", HEADER,
        "compare the port with the peer's settings; the usual port of OpenIGTLink is 18944", checks.other_protocol,
    ),
    Rule(
        "IGTL-E201", "invalid header version", f"{HEADER}: Version number",
        "use 1 for protocol versions 1 and 2, and 2 for protocol version 3; 3 is read if its body is that of version 2",
        each_stream(
            lambda one: len(one.wrong_versions),
            lambda one: f"header version {', '.join(map(str, sorted(one.wrong_versions)))}, expected 1 or 2",
        ),
    ),
    Rule(
        "IGTL-E202", "header version does not fit the body", f"{HEADER}: Extended header",
        "let the sender write version 1, or the extended header of version 2; a body without one is read if its first "
        "bytes cannot be one",
        each_stream(
            lambda one: one.misfits,
            lambda one: f"the body of {checks.many(one.misfits)} of version {min(one.versions)} is that of the other",
        ),
    ),
    Rule(
        "IGTL-E203", "the peer disconnects at a header version", f"{HEADER}: Version number",
        "the peer reads only the other version: choose its `profile`, or set the version in its settings",
        checks.disconnects_at_version,
    ),
    Rule(
        "IGTL-E206", "CRC not written", f"{HEADER}: CRC",
        "let the sender compute it (C++: Pack() after each change; clients in MATLAB do not), or set "
        "`check_crc = false`",
        each_stream(
            lambda one: one.no_crc,
            lambda one: f"the CRC of {one.no_crc} of {checks.many(one.messages)} is 0: the sender does not compute it",
        ),
    ),
    Rule(
        "IGTL-E207", "CRC wrong", f"{HEADER}: CRC",
        "the sender changes the body after computing the CRC, or uses another CRC-64 than ECMA-182; "
        "`check_crc = false` accepts the messages",
        each_stream(
            lambda one: one.bad_crc - one.no_crc,
            lambda one: f"the CRC of {one.bad_crc - one.no_crc} of {checks.many(one.messages)} does not match the body",
        ),
    ),
    Rule(
        "IGTL-E210", "malformed body", "docs/reference/messages.md",
        "correct the encoding of the sender, which the finding names if it is known to differ (pyIGTLink, pyigtl, "
        "OpenIGTLink-Java, openigtlink-rust, 3D Slicer); `igtl-gateway decode` shows the bytes",
        each_stream(
            lambda one: one.malformed, lambda one: f"{checks.many(one.malformed)} cannot be decoded: {one.error}"
        ),
    ),
    Rule(
        "IGTL-E110", "message too large", f"{HEADER}: Body size",
        "raise the limit if the size is correct; a corrupt header has the same effect", checks.too_large,
    ),
    Rule(
        "IGTL-E116", "the peer closes the connection at once", f"{DOCTOR}: Roles",
        "see the log of the peer: it accepts one client only, or clients of other networks, or expects TLS",
        checks.closed_at_once,
    ),
    Rule(
        "IGTL-E106", "connected, but silent", f"{DOCTOR}: Silence",
        "configure the peer to send data (3D Slicer: outgoing nodes of the connector; PLUS: data sent to clients)",
        checks.silent,
    ),
    Rule(
        "IGTL-E601", "ROS: publisher and subscriber are not compatible", f"{DOCTOR}: ROS graph",
        "subscribe with the published type and a compatible QoS: best effort and volatile match every publisher",
        checks.qos_clash,
    ),
    Rule(
        "IGTL-W604", "ROS: no conversion for this type", "docs/reference/conversions.md: ROS to OpenIGTLink",
        "publish one of the types in the table, or igtl_msgs/RawMessage", checks.unconverted,
    ),
    Rule(
        "IGTL-W606", "ROS: topic refused", f"{DOCTOR}: ROS graph",
        "install the package of the type, or correct the name", checks.ros_refused,
    ),
    Rule(
        "IGTL-W607", "a configured source is not there", "docs/how-to/nothing-arrives.md",
        "correct the name, or start the program that sends it", checks.no_source, shown=20,
    ),
    Rule(
        "IGTL-W501", "metres sent as millimetres?", "Protocol/transform.md",
        'OpenIGTLink is in millimetres: multiply by 1000 in the sender, or set `igtl_unit = "m"` for the stream',
        each_stream(
            checks.is_small,
            lambda one: f"all {one.lengths.positions} positions are within {one.lengths.largest:.3g} mm of the origin, "
            "as if the unit were metres",
        ),
    ),
    Rule(
        "IGTL-W502", "lengths too large for millimetres", "Protocol/transform.md",
        "the sender applies a factor of 1000 twice, or uses micrometres",
        each_stream(
            lambda one: one.lengths.messages if one.lengths.largest > checks.LARGE_MM else 0,
            lambda one: f"positions up to {one.lengths.largest / 1000:,.0f} m from the origin",
        ),
    ),
    Rule(
        "IGTL-E503", "NaN or infinity", "Protocol/transform.md",
        "do not send unknown poses, or mark them in the metadata (TransformStatus)",
        each_stream(lambda one: one.not_finite, lambda one: f"NaN or infinity in {checks.many(one.not_finite)}"),
    ),
    Rule(
        "IGTL-W504", "rotation matrix is not orthonormal", "Protocol/transform.md",
        "the columns of the matrix must be perpendicular and have length 1; remove scale and shear",
        each_stream(
            lambda one: one.not_orthonormal,
            checks.not_rotations,
        ),
    ),
    Rule(
        "IGTL-W509", "quaternion is not of length 1", "Protocol/position.md",
        "send x, y, z, w with length 1; 0, 0, 0, 1 is no rotation; a POSITION of 12 bytes has none",
        each_stream(lambda one: one.not_unit, checks.not_unit),
    ),
    Rule(
        "IGTL-W510", "denormal numbers", f"{DOCTOR}: Numbers",
        "assign float(value); rclpy checks assignments if ROS_PYTHON_CHECK_FIELDS is 1", checks.denormal,
    ),
    Rule(
        "IGTL-W505", "left-handed axes", "Protocol/transform.md",
        "RAS is right-handed: check for two exchanged axes, or one negated axis",
        each_stream(
            lambda one: one.mirrored, lambda one: f"the rotation matrix of {checks.many(one.mirrored)} is a reflection"
        ),
    ),
    Rule(
        "IGTL-W506", "implausible pixel spacing", "Protocol/image.md",
        "the length of the matrix columns must be the spacing in millimetres, for 2-D images too",
        each_stream(checks.is_fine, checks.fine),
    ),
    Rule(
        "IGTL-W402", "one name for two streams", NAMES,
        "give each stream its own device name, different within the first 20 bytes", checks.same_names,
    ),
    Rule(
        "IGTL-W401", "name of 20 bytes or more, possibly truncated", f"{HEADER}: Device name",
        "shorten the name; the gateway itself sends the full name in the metadata of header version 2",
        each_stream(
            checks.is_full,
            lambda one: f"the device name {one.device!r} fills its 20 bytes and might be truncated",
        ),
    ),
    Rule(
        "IGTL-W403", "no device name", f"{HEADER}: Device name",
        "name the stream: all streams without a name share one topic",
        each_stream(
            lambda one: 0 if one.device or checks.is_dialogue(one) else one.messages,
            lambda one: f"{one.type} without a device name",
        ),
    ),
    Rule(
        "IGTL-W404", "invalid bytes in a name", f"{HEADER}: Device name",
        "pad names with zeros, and use UTF-8",
        each_stream(
            checks.has_invalid_name,
            lambda one: f"the name {one.raw_device!r} has bytes after a NUL, or unprintable bytes",
        ),
    ),
    Rule(
        "IGTL-W405", "name in the body that fills its field", "docs/reference/messages.md",
        "use at most 19 bytes: C++ readers drop a name without a final NUL",
        each_stream(
            lambda one: len(one.element_names),
            lambda one: f"element names fill their field: {', '.join(map(repr, sorted(one.element_names)[:3]))}",
        ),
    ),
    Rule(
        "IGTL-W406", "two devices, one ROS topic", NAMES,
        "use only letters, digits and _ in device names", checks.same_tokens,
    ),
    Rule(
        "IGTL-W305", "stamps of another epoch", "Protocol/timestamp.md",
        'use UTC since 1970 in the sender, or the time of receipt (`stamp = "receive"`); a replay has old stamps too',
        each_stream(checks.other_epoch, checks.from_epoch),
    ),
    Rule(
        "IGTL-W307", "fractions of stamps in another unit", "Protocol/timestamp.md",
        "multiply the fraction of a second by 2^32 in the sender; OpenIGTLink4J writes milliseconds, which "
        "`--peer HOST:PORT=openigtlink4j` reads; or use the time of receipt (`stamp = \"receive\"`)",
        each_stream(checks.other_unit, checks.in_unit),
    ),
    Rule(
        "IGTL-W303", "stamps in the future", "Protocol/timestamp.md",
        "synchronise the clocks of the two machines (NTP, PTP)",
        each_stream(
            checks.in_future, lambda one: f"stamps are up to {duration_text(one.timing.least_ns)} in the future"
        ),
    ),
    Rule(
        "IGTL-W306", "stamps are old", "Protocol/timestamp.md",
        "synchronise the clocks; if they are correct, the messages wait before they are sent",
        each_stream(
            checks.is_old, lambda one: f"messages are {duration_text(one.timing.least_ns)} old on arrival, or more"
        ),
    ),
    Rule(
        "IGTL-W308", "a stream is late", "docs/how-to/sync.md",
        "`igtl-gateway sync FILE` measures the lag, and corrects it with `--apply`", checks.late,
    ),
    Rule(
        "IGTL-W304", "stamps decrease", "Protocol/timestamp.md",
        "check whether the sender's clock was set, or messages overtake each other",
        each_stream(
            lambda one: one.timing.backwards,
            lambda one: f"{one.timing.backwards} of {one.timing.stamped} stamps "
            f"{by_count(one.timing.backwards, 'is', 'are')} earlier than the previous one",
        ),
    ),
    Rule(
        "IGTL-W302", "stamps quantised or unchanged", "Protocol/timestamp.md",
        'stamp each message with a clock of high resolution, or use the time of receipt (`stamp = "receive"`)',
        each_stream(checks.is_coarse, checks.coarse),
    ),
    Rule(
        "IGTL-W301", "stamps unset", TIME,
        "set stamps in the sender; without stamps the gateway uses the time of receipt",
        each_stream(
            lambda one: one.timing.unset,
            lambda one: f"{one.timing.unset} of {checks.many(one.timing.messages)} have the stamp 0 (unset)",
        ),
    ),
    Rule(
        "IGTL-W109", "incomplete message", HEADER,
        "check the sender: it stopped or lost its link inside a message, or announces a larger body than it sends",
        checks.incomplete,
    ),
    Rule(
        "IGTL-W112", "connects and disconnects repeatedly", f"{DOCTOR}: Roles",
        "check the peer's log: it connects, and disconnects immediately", checks.short_links,
    ),
    Rule(
        "IGTL-W114", "the peer reads too slowly", "docs/evidence/performance.md",
        "send less, or let the peer read faster; until then old poses and images are dropped", checks.slow_reader,
    ),
    Rule(
        "IGTL-W204", "both header versions", f"{HEADER}: Version number",
        "no action if all readers support version 2; readers of protocol versions 1 and 2 lose the stream at it",
        checks.mixed_versions,
    ),
    Rule(
        "IGTL-W209", "messages that deviate, and are read", f"{HEADER}: Extended header",
        "let the sender write header version 1, or version 2 with its extended header; until then it is answered in "
        "version 1",
        each_stream(lambda one: one.deviations.total(), checks.deviations),
    ),
    Rule(
        "IGTL-W208", "unknown type", f"{HEADER}: Type name",
        "no action if the readers support it; PLUS and old readers lose the stream at unknown types",
        each_stream(lambda one: one.messages if one.unknown else 0, checks.unknown_type),
    ),
    Rule(
        "IGTL-W507", "pause in a stream", f"{DOCTOR}: Rates",
        "check the tracker's line of sight, the sender and the network",
        each_stream(
            checks.has_gap,
            lambda one: f"a pause of {duration_text(one.longest_pause_ns)} in a stream of {rate_text(one.rate_hz)}",
        ),
    ),
    Rule(
        "IGTL-W703", "messages lost", "docs/reference/session-log.md",
        "see the losses in `igtl-gateway info FILE`; large ROS messages: start their node with the Fast DDS profile of "
        "docs/how-to/ros-robot.md", checks.lost,
    ),
    Rule(
        "IGTL-W801", "other note", f"{DOCTOR}: Notes",
        "see the text of the note", checks.other_notes,
    ),
    Rule(
        "IGTL-W702", "too many streams or links", f"{DOCTOR}: Limits",
        "use fixed device names; a peer sends a new name for each message", checks.too_many_streams,
    ),
    Rule(
        "IGTL-I117", "the peer is igtl-gateway itself", f"{DOCTOR}: Silence",
        "examine the program that sends to this bridge; `igtl-gateway doctor FILE` examines a recording of the bridge",
        checks.is_gateway,
    ),
    Rule(
        "IGTL-I508", "poses do not change", f"{DOCTOR}: Rates",
        "no action for a calibration; a moving tool is out of sight, or the sender repeats its last pose",
        each_stream(
            checks.is_frozen, lambda one: f"all {count_text(one.lengths.messages, 'pose')} are equal"
        ),
    ),
    Rule(
        "IGTL-I603", "ROS: no subscriber", f"{DOCTOR}: ROS graph",
        "subscribe to the topic; `ros2 topic list` shows it after the first message", checks.no_subscriber,
    ),
    Rule(
        "IGTL-I605", "ROS: nothing to send", f"{DOCTOR}: ROS graph",
        "publish below /igtl/out/, or name topics with `--send`", checks.nothing_out,
    ),
    Rule(
        "IGTL-I704", "no OpenIGTLink messages", "docs/reference/session-log.md",
        "record with peers connected", checks.no_messages,
    ),
    Rule(
        "IGTL-I705", "the recording goes on", "docs/reference/session-log.md",
        "ask again when the recording has ended: findings are of what is on the disk by now", checks.growing,
    ),
)  # fmt: skip


def judge(observed: Observer) -> list[RuleFinding]:
    """Return all findings, in the order of the table."""
    return [RuleFinding(rule, match) for rule in RULES for match in rule.check(observed)]
