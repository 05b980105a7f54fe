"""What all streams compile from: the session's parts, and how CDR writes a name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from igtl_gateway.buffers import Buffer
from igtl_gateway.config import Config
from igtl_gateway.qos import Qos
from igtl_gateway.session.ledger import Ledger

#: In CDR that begins with a header: where its stamp and its frame id are.
STAMP_AT, NAMES_AT = 4, 12


class CompileContext(NamedTuple):
    """Parts of a session.

    Attributes:
        config, ledger: of the session.
        qos: of a topic that is published.
        waiting: latched topic → its last message, where it has no subscriber yet.
    """

    config: Config
    ledger: Ledger
    qos: Callable[[str], Qos | None]
    waiting: dict[str, Any]


def end_of_name(cdr: Buffer, at: int) -> int:
    """The offset behind a string in CDR; its length is at ``at``."""
    return at + 4 + int.from_bytes(cdr[at : at + 4], "little")
