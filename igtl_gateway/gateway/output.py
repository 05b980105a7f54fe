"""Outputs: what an input causes, before the entries get their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.values import value
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note


@value(frozen=True, slots=True)
class Output:
    """An output without number and gateway time; attributes as in ``Entry``."""

    kind: Kind
    channel: str = ""
    type: str = ""
    payload: Sequence[Buffer] = ()
    links: tuple[int, ...] = ()
    source_ns: int = 0

    def entry(self, cause: Entry, step: int) -> Entry:
        """Return the entry of the ``step``-th output of ``cause``."""
        return Entry(
            cause.seq + step,
            cause.stamp_ns + step,
            self.kind,
            self.channel,
            self.type,
            self.payload,
            self.links,
            self.source_ns,
        )


@value(frozen=True, slots=True)
class Packed:
    """A ROS message as CDR, with its type.

    Attributes:
        cdr: without the bytes that ``head`` replaces at its beginning.
        head: of a large message, whose bytes are not copied for its stamp.
    """

    TYPE: str
    cdr: bytes
    head: bytes = b""

    @classmethod
    def of(cls, message: RosMessage) -> Packed:
        return cls(message.TYPE, message.pack())

    def payload(self) -> tuple[Buffer, ...]:
        """Return the bytes, as one buffer or as two."""
        return (self.head, memoryview(self.cdr)[len(self.head) :]) if self.head else (self.cdr,)


def ros_output(topic: str, message: RosMessage | Packed, stamp_ns: int) -> Output:
    """Return the output of a ROS message on a topic; ``stamp_ns`` is the stamp of its header, UTC ns."""
    payload = message.payload() if isinstance(message, Packed) else (message.pack(),)
    return Output(Kind.ROS_OUT, topic, message.TYPE, payload, (), stamp_ns)


def note_output(
    level: Level,
    code: str,
    text: str,
    stream: str = "",
    links: tuple[int, ...] = (),
    data: Mapping[str, Any] | None = None,
) -> Output:
    """Return the output of a note."""
    return Output(Kind.NOTE, payload=(Note(level, code, text, stream, dict(data or {})).pack(),), links=links)
