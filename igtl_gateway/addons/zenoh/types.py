"""Type hashes of messages and services, by which the two ends of a topic find each other."""

from __future__ import annotations

from igtl_gateway.addon import UnknownTypeError
from igtl_gateway.addons.zenoh.services import SERVICES
from igtl_gateway.record.sessionfile.schemas import RosTypes


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
                raise UnknownTypeError(f"unknown type, found no definition of it (share/{ros_type}.msg)")
        return self._found[ros_type]
