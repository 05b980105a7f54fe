"""Who meets whom in the ROS graph: the gateway's topics, as they are and as they will be, and those of others."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from igtl_gateway.convert.table import TO_ROS
from igtl_gateway.gateway import Gateway
from igtl_gateway.qos import Endpoint, Qos, incompatible

#: Where the gateway publishes and listens unless it is configured otherwise.
IN, OUT = "/igtl/in/", "/igtl/out/"


@dataclass(frozen=True, slots=True)
class PublishedTopic:
    """A topic that the gateway publishes."""

    type: str
    qos: Qos


@dataclass(frozen=True, slots=True)
class QosClash:
    """A publisher and a subscription between which nothing passes, and why."""

    topic: str
    publisher: str
    subscriber: str
    why: str


@dataclass(frozen=True, slots=True)
class Graph:
    """What there is on the gateway's topics.

    Attributes:
        offers: topic → what the gateway publishes there.
        endpoints: the publishers and subscriptions of others on topics of the gateway; a running bridge is one of them.
        unconverted: topic → type that the gateway is to send, but nothing converts.
        sent: topics that the gateway sends.
    """

    offers: Mapping[str, PublishedTopic]
    endpoints: Sequence[Endpoint]
    unconverted: Mapping[str, str]
    sent: frozenset[str]

    @classmethod
    def of(cls, gateway: Gateway, published: Mapping[str, str], endpoints: Iterable[Endpoint]) -> Graph:
        """Out of the whole graph what concerns the gateway, which has ``published`` (topic → type) so far."""
        offers = {topic: PublishedTopic(kind, qos) for topic, kind in published.items() if (qos := gateway.qos(topic))}
        chosen, unconverted, sent = [], {}, set()
        for endpoint in endpoints:
            topic, kind = endpoint.topic, endpoint.type
            if topic not in offers and not endpoint.publishes and (offer := _offer(topic, kind)):
                offers[topic] = offer
            if endpoint.publishes and topic not in offers and gateway.lacks_conversion(topic, kind):
                unconverted[topic] = kind
            elif endpoint.publishes and topic not in offers and gateway.subscription(topic, kind):
                sent.add(topic)
            if topic in offers or topic in sent or topic.startswith((IN, OUT)):
                chosen.append(endpoint)
        return cls(offers, chosen, unconverted, frozenset(sent))

    def clashes(self) -> Iterator[QosClash]:
        """Pairs that the middleware keeps apart.  The gateway's own subscriptions adapt to what is offered."""
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
        """Topics that the gateway has something for and nobody subscribes to."""
        subscribed = {one.topic for one in self.endpoints if not one.publishes}
        return sorted(topic for topic in self.offers if topic not in subscribed)


def _offer(topic: str, kind: str) -> PublishedTopic | None:
    """What the gateway would publish on a topic of a device that has not been seen yet, by the end of its name.

    A topic is offered with the type that its subscriber expects, where the table has that type for it.
    """
    last = topic.rpartition("/")[2]
    rows = [row for row in TO_ROS if not row.topic and row.kind == last]
    if not topic.startswith(IN) or not rows:
        return None
    row = next((row for row in rows if row.message.TYPE == kind), rows[0])
    return PublishedTopic(row.message.TYPE, row.qos)
