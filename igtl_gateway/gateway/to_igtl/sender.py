"""Encodes one message for many peers: by profile, header version and pace.

Peers that get the same bytes share one entry, so that each form of a message is encoded once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.base.values import value
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.profiles import Adapted
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.metadata import compose_metadata
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

    @property
    def channel(self) -> str:
        """Name of the stream."""
        return f"{self.igtl_type}/{self.device}"


@dataclass(slots=True)
class SendResult:
    """The result of encoding a message for peers.

    Attributes:
        outputs: the encoded messages.
        refused: (profile, type) of the peers that cannot read the type.
        warnings: adaptations for some peers.
    """

    outputs: list[Output]
    refused: list[tuple[Peer, str]]
    warnings: list[tuple[str, str]]


def send(out: OutboundMessage, peers: Iterable[Peer], now_ns: int, *, asked: bool = False) -> SendResult:
    """Return one output for each form of the message, header version 1 first.

    Args:
        out: the message.
        peers: the addressees.
        now_ns: gateway time.
        asked: whether it answers a query, so that the pace of streams does not apply.

    Raises:
        MalformedBody: a content that cannot be encoded.
    """
    sent = SendResult([], [], [])
    forms: dict[tuple[int, str, tuple[tuple[str, str], ...]], tuple[Body, list[int]]] = {}
    adapted: dict[Adapt, Body] = {}
    for peer in peers:
        if not peer.may_send(out.igtl_type):
            sent.refused.append((peer, out.igtl_type))
        elif asked or peer.claim_due(out.igtl_type, out.device, now_ns):
            content, name = out.content, ""
            if adapt := peer.profile.adapt.get(type(content)):
                if adapt not in adapted:
                    adapted[adapt], warning = adapt(content)
                    sent.warnings += [("adapted", warning)] if warning else []
                if adapted[adapt] is not content:
                    content, name = adapted[adapt], adapt.__name__
            forms.setdefault((peer.version, name, _expected(peer, content)), (content, []))[1].append(peer.link)
            peer.last_sent_ns = now_ns
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


def _expected(peer: Peer, content: Body) -> tuple[tuple[str, str], ...]:
    """Return the metadata that a peer expects with a content; none in header version 1, which has no metadata."""
    expects = peer.profile.expects.get(type(content)) if peer.recent and peer.version > 1 else None
    return expects(content) if expects else ()
