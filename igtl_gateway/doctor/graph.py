"""Publishers and subscriptions of the ROS graph on the gateway's topics, including topics of expected devices."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from igtl_gateway.base.qos import Endpoint, Qos, incompatible
from igtl_gateway.convert.table import TO_ROS
from igtl_gateway.gateway import Gateway

#: Prefixes of the topics that the gateway publishes and subscribes to by default.
IN, OUT = "/igtl/in/", "/igtl/out/"


@dataclass(frozen=True, slots=True)
class PublishedTopic:
    """A topic that the gateway publishes."""

    type: str
    qos: Qos


@dataclass(frozen=True, slots=True)
class QosClash:
    """A publisher and a subscription that are incompatible, with the reason."""

    topic: str
    publisher: str
    subscriber: str
    why: str


@dataclass(frozen=True, slots=True)
class Graph:
    """The publishers and subscriptions on the gateway's topics.

    Attributes:
        offers: topic → what the gateway publishes there.
        endpoints: publishers and subscriptions of other nodes on topics of the gateway; also those of a running bridge.
        unconverted: topic → type that the gateway is configured to send, but that has no conversion.
        sent: topics that the gateway sends to peers.
        published: each topic that other nodes publish → its types.
    """

    offers: Mapping[str, PublishedTopic]
    endpoints: Sequence[Endpoint]
    unconverted: Mapping[str, str]
    sent: frozenset[str]
    published: Mapping[str, frozenset[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, gateway: Gateway, published: Mapping[str, str], endpoints: Iterable[Endpoint]) -> Graph:
        """Select the part of the ROS graph that concerns a gateway which has ``published`` (topic → type) so far."""
        offers = {topic: PublishedTopic(kind, qos) for topic, kind in published.items() if (qos := gateway.qos(topic))}
        chosen, unconverted, sent = [], {}, set()
        all_published: dict[str, frozenset[str]] = {}
        for endpoint in endpoints:
            topic, kind = endpoint.topic, endpoint.type
            if endpoint.publishes:
                all_published[topic] = all_published.get(topic, frozenset()) | {kind}
            if topic not in offers and not endpoint.publishes and (offer := _offer(topic, kind)):
                offers[topic] = offer
            if endpoint.publishes and topic not in offers and gateway.lacks_conversion(topic, kind):
                unconverted[topic] = kind
            elif endpoint.publishes and topic not in offers and gateway.subscription(topic, kind):
                sent.add(topic)
            if topic in offers or topic in sent or topic.startswith((IN, OUT)):
                chosen.append(endpoint)
        return cls(offers, chosen, unconverted, frozenset(sent), all_published)

    def clashes(self) -> Iterator[QosClash]:
        """Yield the pairs that the middleware does not connect.  The gateway's subscriptions adapt to publishers."""
        pairs: dict[tuple[str, str, str], QosClash] = {}
        for reader in self.endpoints:
            if reader.publishes:
                continue
            writers = [one for one in self.endpoints if one.publishes and one.topic == reader.topic]
            offers = [(writer.node, writer.type, writer.qos) for writer in writers]
            if not writers and (offer := self.offers.get(reader.topic)):
                offers = [("the gateway", offer.type, offer.qos)]
            for node, kind, qos in offers:
                why = f"{kind} published, {reader.type} expected" if kind != reader.type else ""
                if why := why or incompatible(qos, reader.qos):
                    pairs.setdefault((reader.topic, node, reader.node), QosClash(reader.topic, node, reader.node, why))
        yield from pairs.values()

    def without_subscriber(self) -> list[str]:
        """Return the topics that the gateway publishes and that have no subscriber."""
        subscribed = {one.topic for one in self.endpoints if not one.publishes}
        return sorted(topic for topic in self.offers if topic not in subscribed)


def _offer(topic: str, kind: str) -> PublishedTopic | None:
    """Return what the gateway would publish on the topic of a device that has not sent yet; None if it is not one.

    The last part of the topic decides.  The type is the one that the subscriber expects, if the table has it.
    """
    last = topic.rpartition("/")[2]
    rows = [row for row in TO_ROS if not row.topic and row.kind == last]
    if not topic.startswith(IN) or not rows:
        return None
    row = next((row for row in rows if row.message.TYPE == kind), rows[0])
    return PublishedTopic(row.message.TYPE, row.qos)
