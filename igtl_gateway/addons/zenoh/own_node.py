"""The gateway's node in the sessions of Zenoh, one after the other: what its publishers and subscriptions declare.

The two ends of a topic or service find each other by the hash of its type.
"""

from __future__ import annotations

from typing import Any

from igtl_gateway.addon import UnknownTypeError
from igtl_gateway.addon.untrusted import DerivedType
from igtl_gateway.addon.writing import RosTypes
from igtl_gateway.addons.zenoh.connection import Connection
from igtl_gateway.addons.zenoh.names import Node, data_key
from igtl_gateway.addons.zenoh.services import SERVICES


class OwnNode:
    """The node of an edge.

    Args:
        connection: has the session.
        domain: number of the ROS domain.
        name: of the node, without namespace.
        namespace: beginning with a slash.
    """

    def __init__(self, connection: Connection, domain: int, name: str, namespace: str) -> None:
        self.connection = connection
        self.domain = domain
        self.hashes = TypeHashes()
        self._name, self._namespace = name, namespace
        self._entities = 0
        self._node: Node | None = None

    def joined(self, session: Any) -> Node:
        """Return the node in a new session."""
        self._node = Node(self.domain, str(session.info.zid()), 0, self._name, self._namespace)
        return self._node

    def next(self, session: Any) -> tuple[Node, int]:
        """Return the node, and the number of a new entity; the caller has the lock of the connection."""
        self._entities += 1
        return self._node or self.joined(session), self._entities

    def key(self, name: str, type_name: str) -> tuple[str, str]:
        """Return data key and type hash of a topic or service.  Raises ValueError, UnknownTypeError."""
        type_hash = self.hashes.of(type_name)
        return data_key(self.domain, name, type_name, type_hash), type_hash


class TypeHashes:
    """Finds hashes, and keeps them: those of messages by their definitions, as recordings have them."""

    def __init__(self) -> None:
        self._types: RosTypes | None = None
        self._found: dict[str, str] = {}

    def of(self, ros_type: str) -> str:
        """Return the hash of a message or service.  Raises UnknownTypeError without its definition."""
        if ros_type not in self._found:
            self._types = self._types or RosTypes()
            service = SERVICES.get(ros_type)
            if service:
                self._found[ros_type] = self._types.service_hash(ros_type, service.definition)
            elif definition := self._types.find(ros_type):
                self._found[ros_type] = definition.type_hash
            else:
                derived = DerivedType.of(ros_type)
                place = derived.file if derived else f"{ros_type}.msg"
                raise UnknownTypeError(f"unknown type, found no definition of it (share/{place})")
        return self._found[ros_type]
