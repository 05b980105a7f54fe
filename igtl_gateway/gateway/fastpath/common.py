"""Common parts of the compilers: the parts of the session that they need, and the layout of strings in CDR."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from igtl_gateway.buffers import Buffer
from igtl_gateway.config import Config
from igtl_gateway.qos import Qos
from igtl_gateway.session.ledger import Ledger

#: Offsets of the stamp and of the frame id in CDR that begins with a std_msgs/Header.
STAMP_AT, NAMES_AT = 4, 12


class CompileContext(NamedTuple):
    """The parts of a session that streams are compiled from.

    Attributes:
        config, ledger: configuration and ledger of the session.
        qos: returns the QoS of a published topic.
        waiting: latched topic without a subscriber → its last message.
    """

    config: Config
    ledger: Ledger
    qos: Callable[[str], Qos | None]
    waiting: dict[str, Any]


def end_of_name(cdr: Buffer, at: int) -> int:
    """Return the offset after a string in CDR whose length is at ``at``."""
    return at + 4 + int.from_bytes(cdr[at : at + 4], "little")
