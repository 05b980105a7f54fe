"""What a side of any middleware answers by its parts: publishers, subscriptions and the graph."""

from __future__ import annotations

from typing import Any, Protocol

from igtl_gateway.base.qos import Endpoint, Qos
from igtl_gateway.edges.interface.publishers import Publishers
from igtl_gateway.edges.interface.side import Publication
from igtl_gateway.edges.interface.subscriptions import Subscriptions


class SeenGraph(Protocol):
    """The other nodes, as far as discovery has come."""

    def publications(self) -> list[Publication]: ...

    def endpoints(self) -> list[Endpoint]: ...


class Halves:
    """The base of a side that is made of two halves and the graph.

    Attributes:
        publish, count_if_unsubscribed, has_subscriber, expect_orders, write: see `Publishers`.  They are its methods,
            without a layer in between, because every message passes them.
    """

    def __init__(self, publishers: Publishers[Any], subscriptions: Subscriptions[Any], graph: SeenGraph) -> None:
        self._publishers, self._subscriptions, self._seen = publishers, subscriptions, graph
        self.publish = publishers.publish
        self.count_if_unsubscribed = publishers.count_if_unsubscribed
        self.has_subscriber = publishers.has_subscriber
        self.expect_orders = publishers.expect_orders
        self.write = publishers.write

    def advertise(self, topic: str, type_name: str, qos: Qos) -> None:
        """Create the publisher early, so that subscribers find it before the first message."""
        self._publishers.advertise(topic, type_name, qos)

    def subscribe(self, topic: str, type_name: str, qos: Qos) -> bool:
        """Subscribe now, before the first publisher: one that comes later waits for us with its first message.

        Without that, topics are subscribed to when they are found, see ``wants``.

        Returns:
            Whether that was possible; if not, a note reports why.
        """
        return self._subscriptions.subscribe(topic, type_name, qos)

    def subscriptions(self) -> list[tuple[str, str]]:
        """Topic and type of everything that we receive."""
        return self._subscriptions.topics()

    def publications(self) -> list[Publication]:
        """The topics that others publish, as far as discovery has come."""
        return self._seen.publications()

    def endpoints(self) -> list[Endpoint]:
        """Publishers and subscriptions of all topics, as far as discovery has come; without those of our own node."""
        return self._seen.endpoints()
