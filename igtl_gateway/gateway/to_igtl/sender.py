"""Encodes one message for many peers: by profile, header version and pace.

Peers that get the same bytes share one entry, so that each form of a message is encoded once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.base.values import value
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.profiles import UNRECOGNISED, Adapted
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import NOT_FOR
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.metadata import compose_metadata
from igtl_gateway.gateway.outcome import Finding
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body

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
    """

    outputs: list[Output] = field(default_factory=list)
    warnings: list[Finding] = field(default_factory=list)
    refused: list[Finding] = field(default_factory=list)


def send(entry: Entry, out: OutboundMessage, peers: Iterable[Peer], *, asked: bool = False) -> SendResult:
    """Return one output for each form of the message, header version 1 first.

    Args:
        entry: the input that causes it.
        out: the message.
        peers: the addressees.
        asked: whether it answers a query, so that the pace of streams does not apply.

    Raises:
        MalformedBody: a content that cannot be encoded.
    """
    sent = SendResult()
    forms: dict[tuple[int, str, tuple[tuple[str, str], ...]], tuple[Body, list[int]]] = {}
    adapted: dict[Adapt, Body] = {}
    for peer in peers:
        if not peer.may_send(out.igtl_type):
            sent.refused.append(held_back(entry, peer, out.igtl_type))
        elif asked or peer.claim_due(out.igtl_type, out.device, entry.stamp_ns):
            content, name = out.content, ""
            if adapt := peer.profile.adapt.get(type(content)):
                if adapt not in adapted:
                    adapted[adapt], text = adapt(content)
                    if text:  # reported once for each stream and cause
                        sent.warnings.append(
                            Finding(Level.WARN, "adapted", text, entry.channel, entry.links, entry.channel)
                        )
                if adapted[adapt] is not content:
                    content, name = adapted[adapt], adapt.__name__
            forms.setdefault((peer.version, name, peer.expects(content)), (content, []))[1].append(peer.link)
            peer.last_sent_ns = entry.stamp_ns
    for (version, _, expected), (content, links) in sorted(forms.items(), key=lambda form: form[0]):
        message = Message(out.igtl_type, out.device, content, ns_to_ticks(out.stamp_ns))
        if version > 1:
            names = (out.device, out.full_name or out.device)
            given = {item.key for item in out.metadata}
            added = tuple(MetadataItem(key, 0, value) for key, value in expected if key not in given)
            items = compose_metadata(*names, out.ros_stamp_ns, out.frame_id, out.child_frame_id, out.metadata + added)
            message = Message(out.igtl_type, out.device, content, message.ticks, version, 0, items)
        sent.outputs.append(
            Output(Kind.IGTL_OUT, out.channel, out.igtl_type, encode(message), tuple(links), out.stamp_ns)
        )
    return sent


def held_back(entry: Entry, peer: Peer, igtl_type: str) -> Finding:
    """Return the finding about a message that a peer is not sent because of its profile."""
    address, profile = peer.address or "the peer", peer.profile.name
    unknown = peer.profile is UNRECOGNISED
    why = f"its profile {profile} cannot receive this type"
    if unknown:
        why = (
            "it is not recognised, and programs such as PLUS lose the stream at this type; a profile "
            f"(--peer {peer.place}=default: all types) or --no-cautious sends it"
        )
    return Finding(
        Level.WARN if unknown else Level.INFO,
        "not_for_peer",
        f"{igtl_type} is not sent to {address}: {why}",
        entry.channel,
        entry.links,
        subject=igtl_type,
        by=peer.link,
        loss=(igtl_type, f"{NOT_FOR}{profile}"),
    )
