"""The interface of all importers: items in the order of time, and an account of the declared messages.

An importer reads a file of another program as a stream of :class:`ImportedItem`, with bounded memory, and counts them.
:func:`numbered` converts them to the entries of a session.  An imported session has only inputs, because the gateway
does not process them; a replay through the gateway computes the outputs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

from mcap.records import Attachment, Metadata

from igtl_gateway.addon import DamagedRecording, GatewayError
from igtl_gateway.addon.messages import header_names
from igtl_gateway.addon.notes import LINK_DOWN, LINK_UP
from igtl_gateway.addon.reading import Buffer, Entry, Kind, Level, Note, Qos
from igtl_gateway.addon.writing import Definition

MESSAGES, BYTES = "messages", "bytes"


@dataclass(frozen=True, slots=True)
class ImportedItem:
    """An input at ``time_ns`` (UTC); the other fields are those of ``Entry``."""

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
        stream: name in the source.
        declared: number that the source declares.
        type: message type.
        taken: number imported.
        left_out: number left out deliberately.
        why: reason for the difference, for people.
        unit: unit of all numbers: MESSAGES, BYTES or a kind of parts.
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
        """Return whether all declared messages were imported or left out."""
        return self.declared == self.taken + self.left_out


class Source(Protocol):
    """An open file of another program; a context manager by ``close``.

    Attributes:
        title: kind and name of the file, for people.
        facts: metadata for the session.
        rows: the account; complete when ``items`` is exhausted.
        notes: further facts for people.
    """

    title: str
    facts: dict[str, str]
    rows: list[ImportedStream]
    notes: list[str]

    def items(self) -> Iterator[ImportedItem]:
        """Yield all items in order.  Raises DamagedRecording at the first place that cannot be read."""
        ...

    def qos_of(self, topic: str, ros_type: str) -> Qos | None:
        """Return the quality of service of a ROS topic; None if the file does not contain it."""
        ...

    def definition_of(self, ros_type: str) -> Definition | None:
        """Return the definition of a ROS type; None if the file does not contain it."""
        ...

    def beside(self) -> Iterator[Attachment | Metadata]:
        """Yield the attachments and metadata records of an MCAP file that are carried over."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...


@runtime_checkable
class DividedSource(Source, Protocol):
    """A source whose parts can be sessions of their own."""

    def each(self) -> Iterator[tuple[str, Source]]:
        """Yield name and source of each part, in the order of time."""
        ...


@dataclass(slots=True)
class NonRosSource:
    """Base class of importers, with the defaults for files without ROS topics and types."""

    title: str = ""
    facts: dict[str, str] = field(default_factory=dict)
    rows: list[ImportedStream] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def qos_of(self, _topic: str, _type: str) -> Qos | None:
        return None

    def definition_of(self, _type: str) -> Definition | None:
        return None

    def beside(self) -> Iterator[Attachment | Metadata]:
        return iter(())


def numbered(items: Iterable[ImportedItem]) -> Iterator[Entry]:
    """Yield the entries of a session; an item that is not later than the previous one is placed 1 ns after it."""
    stamp_ns = -1
    for seq, item in enumerate(items, 1):
        stamp_ns = max(item.time_ns, stamp_ns + 1)
        yield Entry(
            seq, stamp_ns, item.kind, item.channel, item.type, (item.payload,), item.links, max(item.source_ns, 0)
        )


def peer_item(time_ns: int, link: int, message: Buffer) -> ImportedItem:
    """Return the item of a message from an OpenIGTLink peer, with stream and source stamp from its header."""
    stream, igtl_type, source_ns = header_names(message)
    return ImportedItem(time_ns, Kind.IGTL_IN, message, stream, igtl_type, (link,), source_ns)


def link_up_item(time_ns: int, link: int, facts: dict[str, str]) -> ImportedItem:
    """Return the item of a connected peer; ``facts`` contains ``peer``, ``local`` and the gateway's ``role``."""
    note = Note(Level.INFO, LINK_UP, f"{facts['peer']} connected", data=dict(facts))
    return ImportedItem(time_ns, Kind.LINK, note.pack(), links=(link,))


def link_down_item(time_ns: int, link: int, facts: dict[str, str], reason: str) -> ImportedItem:
    """Return the item of a disconnected peer."""
    note = Note(Level.INFO, LINK_DOWN, f"{facts['peer']} disconnected: {reason}", data={**facts, "reason": reason})
    return ImportedItem(time_ns, Kind.LINK, note.pack(), links=(link,))


def file_begin_items(path: Path, time_ns: int, link: int) -> tuple[ImportedItem, ImportedItem]:
    """Return the items that a file of another program begins with: it is the peer, and no gateway received it."""
    text = f"imported from {path.name}; no gateway received these messages"
    return link_up_item(time_ns, link, _file_facts(path)), note_item(time_ns, "imported", text)


def file_end_item(path: Path, time_ns: int, link: int, reason: str = "the end of the file") -> ImportedItem:
    """Return the last item of a file that began with ``file_begin_items``."""
    return link_down_item(time_ns, link, _file_facts(path), reason)


def _file_facts(path: Path) -> dict[str, str]:
    return {"peer": f"file {path.name}", "local": "import", "role": "server"}


def note_item(
    time_ns: int, code: str, text: str, *, stream: str = "", data: dict[str, object] | None = None
) -> ImportedItem:
    """Return the item of a note for a fact of the source that is not a message."""
    return ImportedItem(time_ns, Kind.EDGE_NOTE, Note(Level.INFO, code, text, stream, dict(data or {})).pack())


@contextmanager
def library_errors_as_damage(path: Path) -> Iterator[None]:
    """Context manager that converts the errors of libraries for untrusted bytes to DamagedRecording."""
    try:
        yield
    except GatewayError:
        raise
    except OSError as error:
        raise DamagedRecording(f"{path}: {error.strerror or error}") from None
    except Exception as error:
        raise DamagedRecording(f"{path}: {type(error).__name__}: {error}") from error
