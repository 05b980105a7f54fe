"""The ROS graph as the liveliness tokens show it: who publishes and subscribes, with which quality of service.

Any program may write tokens.  What is no token of ROS is noted once, and there is a limit to their number.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from igtl_gateway.addon.reading import Endpoint, Level
from igtl_gateway.addon.ros_side import Publication, Reports
from igtl_gateway.addons.zenoh.names import SPACE, Entity, Kind, gid, read_token

#: Most entities of the graph.
_MOST = 65_536
_SHOWN = 200


class Graph:
    """The entities of all other sessions in a domain.

    Args:
        reports: takes the notes.
        changed: called, from a thread of Zenoh, with an entity that came; with None, if one has ended.
    """

    def __init__(self, reports: Reports, changed: Callable[[Entity | None], None]) -> None:
        self._reports = reports
        self._changed = changed
        self._lock = threading.Lock()
        self._entities: dict[str, Entity] = {}
        self._bad: list[str] = []
        self._own = ""
        self._put: Any = None
        self._subscriber: Any = None  # Zenoh undeclares what has no reference

    def declare(self, session: Any, domain: int, put: Any) -> None:
        """Follow the tokens of a domain.  ``put``: Zenoh's kind of samples that declare."""
        self._own, self._put = str(session.info.zid()), put
        self._subscriber = session.liveliness().declare_subscriber(f"{SPACE}/{domain}/**", self._on_token, history=True)

    def publications(self) -> list[Publication]:
        """The topics that others publish; each type of a topic is one."""
        counts: dict[tuple[str, str], int] = {}
        for entity in self._of(Kind.PUBLISHER):
            place = entity.topic, entity.type
            counts[place] = counts.get(place, 0) + 1
        return [Publication(*place, count) for place, count in sorted(counts.items())]

    def publishers(self) -> list[Entity]:
        """All publishers."""
        return self._of(Kind.PUBLISHER)

    def gids_of(self, zid: str) -> set[bytes]:
        """The identifiers of the publishers of a session."""
        with self._lock:
            tokens = [token for token, each in self._entities.items() if each.node.zid == zid]
        return {gid(token) for token in tokens}

    def subscriber_count(self, key: str) -> int:
        """The number of subscriptions to a data key."""
        return sum(each.key == key for each in self._of(Kind.SUBSCRIPTION))

    def endpoints(self) -> list[Endpoint]:
        """Publishers and subscriptions of all topics."""
        found = [*self._of(Kind.PUBLISHER), *self._of(Kind.SUBSCRIPTION)]
        return [
            Endpoint(each.topic, each.type, each.node.full_name, each.kind is Kind.PUBLISHER, each.qos)
            for each in sorted(found, key=lambda each: each.topic)
        ]

    def note_bad(self) -> None:
        """Note what is no token of ROS; not from Zenoh's threads."""
        while self._bad:
            self._reports.note_once(Level.WARN, "ros_bad_token", self._bad.pop())

    def _of(self, kind: Kind) -> list[Entity]:
        with self._lock:
            return [each for each in self._entities.values() if each.kind is kind]

    def _on_token(self, sample: Any) -> None:
        token = str(sample.key_expr)
        if sample.kind != self._put:
            with self._lock:
                self._entities.pop(token, None)
            self._changed(None)
            return
        try:
            entity = read_token(token)
        except ValueError as error:
            self._refuse(f"{token[:_SHOWN]}: no token of ROS, it is ignored: {error}")
            return
        if entity.node.zid == self._own:
            return
        with self._lock:
            full = len(self._entities) >= _MOST and token not in self._entities
            if not full:
                self._entities[token] = entity
        if full:
            self._refuse(
                f"the graph has more than {_MOST} nodes, publishers and subscriptions; further ones are ignored"
            )
        else:
            self._changed(entity)

    def _refuse(self, text: str) -> None:
        if not self._bad:
            self._bad.append(text)
            self._changed(None)
