"""Encodes one message for many peers: by profile, header version and pace.

Peers that get the same bytes share one entry, so that each form of a message is encoded once.  A peer that does not
read the type gets what its profile has in place of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.base.values import value
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.profiles import UNRECOGNISED, Adapted
from igtl_gateway.convert.substitutes import Shown
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import NOT_FOR
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.metadata import compose_metadata
from igtl_gateway.gateway.naming import ShownNames
from igtl_gateway.gateway.outcome import Finding, conversion_failure
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.gateway.substitution import Step, in_place_of
from igtl_gateway.wire import Message, Raw, encode
from igtl_gateway.wire.body import Body

#: Code of the note about the unit of arms for a peer; its data have the ``unit``.
ARM_UNIT = "arm_unit"

Adapt = Callable[[Any], Adapted]


@value(frozen=True, slots=True)
class OutboundMessage:
    """A message for peers, before it is encoded.

    Attributes:
        igtl_type, device: type and device name on the wire.
        content: content of the body.
        stamp_ns: stamp of the header, UTC ns.
        full_name: full device name; "" if ``device`` is complete.
        ros_stamp_ns, frame_id, child_frame_id: from the ROS message, for the metadata.
        metadata: metadata of the user.
        is_static: whether the pose is valid at all times.
        in_unit: returns the content with lengths in another unit, where peers get it in their own; None: they do not.
    """

    igtl_type: str
    device: str
    content: Body
    stamp_ns: int
    full_name: str = ""
    ros_stamp_ns: int = 0
    frame_id: str = ""
    child_frame_id: str = ""
    metadata: tuple[MetadataItem, ...] = ()
    is_static: bool = False
    in_unit: Callable[[str], Body] | None = None

    @property
    def channel(self) -> str:
        """Name of the stream."""
        return f"{self.igtl_type}/{self.device}"


@dataclass(slots=True)
class SendResult:
    """The result of encoding a message for peers.

    Attributes:
        outputs: the encoded messages.
        warnings: findings about adaptations for some peers.
        refused: findings about the peers that cannot read the type.
        shown: findings about what peers get in its place.
    """

    outputs: list[Output] = field(default_factory=list)
    warnings: list[Finding] = field(default_factory=list)
    refused: list[Finding] = field(default_factory=list)
    shown: list[Finding] = field(default_factory=list)

    @property
    def findings(self) -> list[Finding]:
        """All findings."""
        return [*self.warnings, *self.refused, *self.shown]


def send(
    entry: Entry,
    out: OutboundMessage,
    peers: Iterable[Peer],
    *,
    asked: bool = False,
    names: ShownNames | None = None,
) -> SendResult:
    """Return one output for each form of the message, header version 1 first.

    Args:
        entry: the input that causes it.
        out: the message.
        peers: the addressees.
        asked: whether it answers a query, so that the pace of streams does not apply.
        names: the names of what is sent in place of other messages; None: nothing is.

    Raises:
        MalformedBody: a content that cannot be encoded.
    """
    sent = SendResult()
    others: list[Peer] = []
    forms: dict[tuple[int, str, bool, tuple[tuple[str, str], ...]], tuple[Body, list[int]]] = {}
    adapted: dict[Adapt, Body] = {}
    units: dict[str, Body] = {}
    for peer in peers:
        if not peer.may_send(out.igtl_type):
            row = peer.instead_of(out.igtl_type)
            if names and row and row.show and not isinstance(out.content, Raw):
                others.append(peer)
            else:
                sent.refused.append(held_back(entry, peer, out.igtl_type, out.channel))
        elif peer.must_wait(out.igtl_type):
            sent.refused.append(waiting(entry, peer, out.channel))
        elif asked or peer.claim_due(out.igtl_type, out.device, entry.stamp_ns):
            content, name = out.content, ""
            if out.in_unit and (unit := peer.profile.arm_unit):
                if unit not in units:
                    units[unit] = out.in_unit(unit)
                if units[unit] is not content:
                    content, name = units[unit], unit
                    sent.shown.append(unit_finding(peer))
            if adapt := peer.profile.adapt.get(type(content)):
                if adapt not in adapted:
                    adapted[adapt], text = adapt(content)
                    if text:  # reported once for each stream and cause
                        sent.warnings.append(
                            Finding(Level.WARN, "adapted", text, entry.channel, entry.links, entry.channel)
                        )
                if adapted[adapt] is not content:
                    content, name = adapted[adapt], adapt.__name__
            key = (peer.version, name, gets_stamp(out, peer), peer.expects(content))
            forms.setdefault(key, (content, []))[1].append(peer.link)
            peer.last_sent_ns = entry.stamp_ns
    for (version, _, stamped, expected), (content, links) in sorted(forms.items(), key=lambda form: form[0]):
        message = Message(out.igtl_type, out.device, content, ns_to_ticks(out.stamp_ns))
        if version > 1:
            called = (out.device, out.full_name or out.device)
            given = {item.key for item in out.metadata}
            added = tuple(MetadataItem(key, 0, value) for key, value in expected if key not in given)
            ros_stamp_ns = out.ros_stamp_ns or (out.stamp_ns if stamped else 0)
            items = compose_metadata(*called, ros_stamp_ns, out.frame_id, out.child_frame_id, out.metadata + added)
            message = Message(out.igtl_type, out.device, content, message.ticks, version, 0, items)
        sent.outputs.append(
            Output(Kind.IGTL_OUT, out.channel, out.igtl_type, encode(message), tuple(links), out.stamp_ns)
        )
    if names and others:
        _send_instead(entry, out, others, sent, asked=asked, names=names)
    return sent


def gets_stamp(out: OutboundMessage, peer: Peer) -> bool:
    """Return whether a peer gets the stamp of the message in the metadata, because the ROS message has none."""
    has_none = not out.ros_stamp_ns and not out.is_static and out.stamp_ns > 0
    return has_none and peer.profile.stamped and peer.version > 1


def _send_instead(
    entry: Entry, out: OutboundMessage, peers: Sequence[Peer], sent: SendResult, *, asked: bool, names: ShownNames
) -> None:
    """Send peers what their table has in place of a message."""
    message = Shown(out.igtl_type, out.full_name or out.device, out.content)
    for step in in_place_of(message, out.channel, peers, names):
        if step.error is not None:
            text = f"{step.source} is not shown as {step.row.shown_as}"
            sent.refused.append(conversion_failure(step.error, text, entry))
            continue
        assert step.shown is not None
        moved = _moved(out, step.shown, step)
        sent.refused += [held_back(entry, peer, moved.igtl_type, moved.channel) for peer in step.left]
        part = send(entry, moved, step.readers, asked=asked)
        sent.outputs += part.outputs
        sent.warnings += part.warnings
        sent.refused += part.refused
        sent.shown += part.shown
        sent.shown += [_shown(entry, peer, moved, step) for peer in step.readers]


def _moved(out: OutboundMessage, shown: Shown, step: Step) -> OutboundMessage:
    return OutboundMessage(
        shown.igtl_type,
        step.device,
        shown.content,
        out.stamp_ns,
        step.full_name,
        out.ros_stamp_ns,
        out.frame_id,
        out.child_frame_id if step.is_own else "",
        out.metadata,
        out.is_static,
    )


def _shown(entry: Entry, peer: Peer, moved: OutboundMessage, step: Step) -> Finding:
    """Return the finding about what a peer gets in place of a stream; reported once for each of the two."""
    address, profile = peer.address or "the peer", peer.profile.name
    text = f"{step.source} goes to {address} as {moved.channel}: {step.row.why} (profile {profile})"
    subject = f"{step.source} {moved.channel}"
    return Finding(Level.INFO, "shown_instead", text, entry.channel, entry.links, subject=subject, by=peer.link)


def unit_finding(peer: Peer) -> Finding:
    """Return the finding about the unit of arms for a peer; reported once."""
    unit, name = peer.profile.arm_unit, peer.profile.name
    text = f"{peer.address or 'the peer'} gets and sends CRTK arms in {unit}: it takes every length so (profile {name})"
    return Finding(Level.INFO, ARM_UNIT, text, links=(peer.link,), subject="", by=peer.link, data={"unit": unit})


def waiting(entry: Entry, peer: Peer, channel: str) -> Finding:
    """Return the finding about a message that is too early for a peer; reported once for each peer."""
    peer.missed = True
    address = peer.address or "the peer"
    return Finding(
        Level.INFO,
        "not_for_peer",
        f"{channel} is sent to {address} after its first message, or after 250 ms: it may be 3D Slicer",
        entry.channel,
        entry.links,
        subject="",
        by=peer.link,
        loss=(channel, f"{NOT_FOR}{UNRECOGNISED.name}"),
    )


def held_back(entry: Entry, peer: Peer, igtl_type: str, channel: str) -> Finding:
    """Return the finding about a message that a peer is not sent because of its profile.

    Peers with a table of substitutes: once for each stream; others: once for each type.
    """
    address, profile = peer.address or "the peer", peer.profile.name
    unknown, row = peer.profile is UNRECOGNISED, peer.instead_of(igtl_type)
    why = f"its profile {profile} cannot receive this type"
    if row:
        why = f"{row.why} (profile {profile})"
    elif unknown:
        why = (
            "it is not recognised, and programs such as PLUS lose the stream at this type; a profile "
            f"(--peer {peer.place}=default: all types) or --no-cautious sends it"
        )
    about = channel if row else igtl_type
    return Finding(
        Level.WARN if unknown else Level.INFO,
        "not_for_peer",
        f"{about} is not sent to {address}: {why}",
        entry.channel,
        entry.links,
        subject=about,
        by=peer.link,
        loss=(about, f"{NOT_FOR}{profile}"),
    )
