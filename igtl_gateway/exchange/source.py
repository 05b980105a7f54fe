"""What every importer gives: items in the order of time, and an account of what the source declared.

An importer reads a file of another program as a stream of :class:`ImportedItem`, with bounded memory, and keeps count.
:func:`numbered` makes entries of a session of them.  The gateway is not asked: an imported session has inputs
only, and whoever wants outputs replays it through the gateway.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from igtl_gateway.buffers import Buffer
from igtl_gateway.errors import DamagedRecording, GatewayError
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, header_names
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note

MESSAGES, BYTES = "messages", "bytes"


@dataclass(frozen=True, slots=True)
class ImportedItem:
    """An input at ``time_ns`` (UTC); the other fields as those of ``Entry``."""

    time_ns: int
    kind: Kind
    payload: Buffer
    channel: str = ""
    type: str = ""
    links: tuple[int, ...] = ()
    source_ns: int = 0


@dataclass(slots=True)
class ImportedStream:
    """The account of one stream, in messages or in bytes.

    Attributes:
        stream: its name in the source.
        declared: what the source says it has.
        type: message type.
        taken: what came over.
        left_out: what was left out on purpose, and ``why``.
        unit: of all numbers.
    """

    stream: str
    declared: int
    type: str = ""
    taken: int = 0
    left_out: int = 0
    why: str = ""
    unit: str = MESSAGES

    @property
    def good(self) -> bool:
        """Whether everything that the source declared is accounted for."""
        return self.declared == self.taken + self.left_out


class Source(Protocol):
    """An open file of another program; a context manager by ``close``.

    Attributes:
        title: what it is, for people.
        facts: what the session should remember of it.
        rows: the account; final once ``items`` is exhausted.
        notes: what else people should know.
    """

    title: str
    facts: dict[str, str]
    rows: list[ImportedStream]
    notes: list[str]

    def items(self) -> Iterator[ImportedItem]:
        """Everything, in order.  Raises DamagedRecording where the file cannot be read any further."""
        ...

    def qos_of(self, topic: str, ros_type: str) -> Qos | None:
        """Quality of service of a ROS topic; None where the file does not say."""
        ...

    def definition_of(self, ros_type: str) -> tuple[str, str] | None:
        """``ros2msg`` text and hash (or ``""``) of a ROS type, where the file has one."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...


@dataclass(slots=True)
class NonRosSource:
    """What the importers of files without ROS have in common: nothing to say of topics and types."""

    title: str = ""
    facts: dict[str, str] = field(default_factory=dict)
    rows: list[ImportedStream] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def qos_of(self, _topic: str, _type: str) -> Qos | None:
        return None

    def definition_of(self, _type: str) -> tuple[str, str] | None:
        return None


def numbered(items: Iterable[ImportedItem]) -> Iterator[Entry]:
    """The entries of a session; what is not later than the one before gets the next nanosecond."""
    stamp_ns = -1
    for seq, item in enumerate(items, 1):
        stamp_ns = max(item.time_ns, stamp_ns + 1)
        yield Entry(
            seq, stamp_ns, item.kind, item.channel, item.type, (item.payload,), item.links, max(item.source_ns, 0)
        )


def peer_item(time_ns: int, link: int, message: Buffer) -> ImportedItem:
    """A message of an OpenIGTLink peer, named and stamped by its header."""
    stream, igtl_type, source_ns = header_names(message)
    return ImportedItem(time_ns, Kind.IGTL_IN, message, stream, igtl_type, (link,), source_ns)


def link_up_item(time_ns: int, link: int, facts: dict[str, str]) -> ImportedItem:
    """A peer came; ``facts`` has ``peer``, ``local`` and ``role`` (ours)."""
    note = Note(Level.INFO, LINK_UP, f"{facts['peer']} connected", data=dict(facts))
    return ImportedItem(time_ns, Kind.LINK, note.pack(), links=(link,))


def link_down_item(time_ns: int, link: int, facts: dict[str, str], reason: str) -> ImportedItem:
    """A peer went."""
    note = Note(Level.INFO, LINK_DOWN, f"{facts['peer']} disconnected: {reason}", data={**facts, "reason": reason})
    return ImportedItem(time_ns, Kind.LINK, note.pack(), links=(link,))


def note_item(
    time_ns: int, code: str, text: str, *, stream: str = "", data: dict[str, object] | None = None
) -> ImportedItem:
    """Something that the source tells besides messages."""
    return ImportedItem(time_ns, Kind.EDGE_NOTE, Note(Level.INFO, code, text, stream, dict(data or {})).pack())


@contextmanager
def library_errors_as_damage(path: Path) -> Iterator[None]:
    """Around what reads foreign bytes: whatever a library makes of damaged ones becomes DamagedRecording."""
    try:
        yield
    except GatewayError:
        raise
    except OSError as error:
        raise DamagedRecording(f"{path}: {error.strerror or error}") from None
    except Exception as error:
        raise DamagedRecording(f"{path}: {type(error).__name__}: {error}") from error
