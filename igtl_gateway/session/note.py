"""Notes: what happened besides messages, in words for people and in fields for programs."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any


class Level(IntEnum):
    """Severity, with the numbers of rcl_interfaces/msg/Log."""

    INFO = 20
    WARN = 30
    ERROR = 40


@dataclass(frozen=True, slots=True)
class Note:
    """A fact about the session.

    Attributes:
        level: how bad it is.
        code: stable machine-readable name, such as ``"link_up"``, ``"bad_crc"``, ``"queue_drop"``.
        text: one sentence for people.
        stream: the stream concerned (topic or ``TYPE/device``), or ``""``.
        data: further facts as JSON values (the cause of an error, counts, addresses).
    """

    level: Level
    code: str
    text: str
    stream: str = ""
    data: dict[str, Any] = field(default_factory=dict)

    def pack(self) -> bytes:
        """As JSON with sorted keys: the payload of a note entry."""
        return json.dumps(
            {"level": self.level.name, "code": self.code, "text": self.text, "stream": self.stream, "data": self.data},
            sort_keys=True,
            ensure_ascii=False,
            separators=(",", ":"),
        ).encode("utf-8", "surrogateescape")

    @classmethod
    def unpack(cls, payload: bytes) -> Note:
        """The note in the payload of an entry.  Raises ValueError if it is not one."""
        fields = json.loads(payload.decode("utf-8", "surrogateescape"))
        return cls(Level[fields["level"]], fields["code"], fields["text"], fields["stream"], fields["data"])
