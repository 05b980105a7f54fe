"""CLIENTINFO, a type of PlusServer's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from igtl_gateway.wire.text import String


@dataclass(frozen=True, slots=True)
class ClientInfo(String):
    """CLIENTINFO: the data that a client requests from a PLUS server, as XML; same layout as STRING.

    ``<ClientInfo …>`` replaces the complete subscription: types, names of transforms and images, TDATA resolution.

    Accepted: as STRING.

    Sent: as STRING.
    """

    PROTOCOL: ClassVar[str] = "2"
