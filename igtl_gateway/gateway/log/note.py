"""Notes: what happened besides messages, in words for people and in fields for programs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

#: Codes of the notes about links.
LINK_UP, LINK_DOWN = "link_up", "link_down"
#: Reason, in the data of its note, of a link that ends because the bridge does.
STOPPED = "stopped"
#: Code of notes without a stream → the fact by which they differ.
_SUBJECTS = {"refused": "reason", "connect_failed": "peer"}


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

    @property
    def subject(self) -> str:
        """What distinguishes it from others of its code: its stream, or a fact, as a server that cannot be reached."""
        return self.stream or str(self.data.get(_SUBJECTS.get(self.code, ""), ""))

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
        try:
            fields = json.loads(payload.decode("utf-8", "surrogateescape"))
            level, texts, data = fields["level"], [fields[name] for name in _TEXTS], fields["data"]
            code, text, stream = texts
            found = cls(Level[level], code, text, stream, data)
        except (LookupError, TypeError, RecursionError) as error:
            raise ValueError(f"found no note: {type(error).__name__} {error}") from None
        if not all(type(each) is str for each in texts) or not isinstance(data, dict):
            raise ValueError(
                f"found a note with {', '.join(_TEXTS)} and data of other types, expected strings and facts"
            )
        for name, is_right in _FACTS.items():
            if name in data and not is_right(data[name]):
                raise ValueError(f"found {name!r} of another type or value than it has in notes")
        return found

    @classmethod
    def of(cls, payload: bytes) -> Note:
        """The note in the payload of an entry, or ``UNREADABLE`` if there is none: for entries of a file."""
        try:
            return cls.unpack(payload)
        except ValueError:
            return UNREADABLE


_TEXTS = ("code", "text", "stream")


def _is_text(value: Any) -> bool:
    return type(value) is str


def _is_number(value: Any) -> bool:
    return type(value) is int and abs(value) < 1 << 63


def _is_count(value: Any) -> bool:
    """A number, or numbers by stream."""
    return all(map(_is_number, value.values())) if isinstance(value, dict) else _is_number(value)


def _is_hex(value: Any) -> bool:
    return _is_text(value) and not len(value) % 2 and set(value) <= _HEX


_HEX = frozenset("0123456789abcdefABCDEF")
#: Facts that programs act on, and what they have to be.
_FACTS: Mapping[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("peer", "local", "role", "reason", "asked"), _is_text),
    **dict.fromkeys(
        ("sent_messages", "received_bytes", "count", "step_ns", "jump_ns", "ahead_ns", "ago_ns"), _is_number
    ),
    "dropped": _is_count,
    "head": _is_hex,
}
#: Stands for the payload of an entry that is not a note.
UNREADABLE = Note(Level.WARN, "unreadable_note", "the payload of this entry is not a note")
