"""Work of the full path that is done before a message has its number: without the sequence lock, by any thread.

A surface takes a millisecond, and a list of thousands many, which the poses of others would wait for the lock.  What
depends on a message alone is done beforehand: it is decoded, and so are the children of a BIND; what takes long is
converted, with the stream that it has or will have.  The full path then asks for each result with all that it
depends on, and does itself what it is not given: its outputs are the same, and those of a verification, which has
nothing of this.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Any

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import clouds, polydata, surfaces, tracking
from igtl_gateway.convert.assembly import ForeseenVolume
from igtl_gateway.convert.cdr import CdrWriter
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.igtl_msgs import Metadata
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.raw import raw_message
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header, Mesh, RosMessage, String
from igtl_gateway.convert.table import ConversionToRos
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.metadata import RestoredMetadata, restore_metadata
from igtl_gateway.gateway.output import Packed
from igtl_gateway.gateway.streams import Streams
from igtl_gateway.gateway.to_ros.routed import child_message, context_of
from igtl_gateway.gateway.to_ros.subscribers import Subscribers
from igtl_gateway.gateway.to_ros.volumes import Volumes
from igtl_gateway.wire import Message, Raw
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.cost import AT_ONCE_NS, cost_ns
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.registry import read_child

#: Conversions that take long for a message of any size.
LONG: frozenset[Callable[[Any, ToRosContext], RosMessage | list[RosMessage]]] = frozenset(
    {
        clouds.polydata_to_cloud,
        surfaces.polydata_to_mesh,
        surfaces.polydata_to_marker,
        surfaces.polydata_to_lines,
        polydata.polydata_to_ros,
    }
)
#: ROS types without a stamp; those of all others that are made beforehand begin with a header, and have no other stamp.
_WITHOUT_STAMP = frozenset(
    {Mesh.TYPE, String.TYPE, DiagnosticStatus.TYPE, *(one.TYPE for one in MULTI_ARRAYS.values())}
)

_STAMP_END = 12  # of CDR that begins with a header
#: From here on a message gets its stamp without a copy of its bytes.
_LARGE_BYTES = 64 << 10
#: A picture is only copied, which takes a millisecond from here on.
_LONG_BYTES = 1 << 20


_Made = tuple[Sequence[Packed] | ConversionError, list[tuple[str, str]]]


@dataclass(slots=True)
class Piece:
    """What a message, or a child of a BIND, has given beforehand.

    Attributes:
        content: its content, or why there is none.
        to: context of the conversions, without a stamp; None: nothing was converted.
        made: conversion function → ROS messages or why there are none, and warnings.
        shared: what the rows share; see ``ToRosContext.made``.
        messages: conversion function → ROS message, for what is compiled from it.
        metadata: the message of the sender's metadata.
        raw: the message as a RawMessage, where there is no conversion.
        children: pieces of the children of a BIND.
        volume: what a part of an image makes of its volume.
    """

    content: Body | WireError
    to: ToRosContext | None = None
    made: dict[object, _Made] = field(default_factory=dict)
    shared: dict[str, Any] = field(default_factory=dict)
    messages: dict[object, RosMessage] = field(default_factory=dict)
    metadata: Packed | None = None
    raw: Packed | None = None
    children: tuple[Piece, ...] = ()
    volume: ForeseenVolume | None = None


@dataclass(frozen=True, slots=True)
class Results:
    """What a message has given beforehand.

    Attributes:
        payload: the message.
        decoded: the message, or why it cannot be decoded.
        restored: the contents of its metadata.
        pieces: of contents, by their identity.
    """

    payload: Buffer
    decoded: Message | WireError
    restored: RestoredMetadata | None = None
    pieces: dict[int, Piece] = field(default_factory=dict)

    @property
    def made(self) -> int:
        """How many conversions were done."""
        return sum(len(piece.made) for piece in self.pieces.values())


class Beforehand:
    """The results of the next message, and what is needed to make them.

    Attributes:
        results: of the message that is handled now; set and used with the sequence lock.
    """

    def __init__(self, config: Config, streams: Streams, subscribers: Subscribers, volumes: Volumes) -> None:
        self.results: Results | None = None
        self._acceptance = Acceptance.of(config)
        self._config = config
        self._streams = streams
        self._subscribers = subscribers
        self._volumes = volumes

    # ── from any thread ───────────────────────────────────────────────────────────────────────────────────────

    def work(self, payload: Buffer, link: int) -> Results:
        """Do what depends on the message alone; from any thread."""
        try:
            message = self._acceptance.message(payload)
        except WireError as error:
            return Results(payload, error)
        restored = restore_metadata(message, self._config.naming)
        results = Results(payload, message, restored)
        piece = self._piece(
            results, message, restored, link, takes_long=cost_ns(payload) >= AT_ONCE_NS or len(payload) >= _LONG_BYTES
        )
        if piece.to and not piece.made and isinstance(message.content, Raw):
            piece.raw = Packed.of(raw_message(payload, 0, link))
        return results

    def _piece(
        self, results: Results, message: Message, restored: RestoredMetadata, link: int, *, takes_long: bool
    ) -> Piece:
        content = message.content
        known = piece = Piece(content)
        if not (takes_long or visible(message.type) == "POLYDATA"):
            return piece
        results.pieces[id(content)] = piece
        if isinstance(content, Image) and (volume := self._volumes.foreseen(restored.device_name, content)):
            piece.volume, content = volume, volume.whole
            piece = results.pieces[id(content)] = Piece(content)
        stream = self._streams.foreseen(visible(message.type), restored.device_name)
        frame_id = stream.row.frame_id or restored.frame_id or stream.frame_id
        to = piece.to = context_of(self._config, self._streams, stream, message, restored, frame_id, link, 0)
        for row, topic in stream.outputs:
            if (
                (takes_long or row.convert in LONG)
                and not row.topic  # frames belong to their names in the order of the log
                and isinstance(content, row.content)
                and row.applies(content)
                and self._subscribers.has(topic, row.message.TYPE)
            ):
                self._convert(piece, row, content, to)
        piece.shared = {name: one for name, one in to.made.items() if name == tracking.TOOLS}
        if takes_long and to.metadata and self._subscribers.has(stream.metadata_topic, Metadata.TYPE):
            piece.metadata = Packed.of(metadata_message(to))
        if isinstance(content, Bind):
            piece.children = tuple(self._child(results, child, message, restored, link) for child in content.children)
        return known

    def _child(self, results: Results, child: Any, message: Message, restored: RestoredMetadata, link: int) -> Piece:
        try:
            inner, its = child_message(child, read_child(child), message, restored)
        except WireError as error:
            return Piece(error)
        return self._piece(results, inner, its, link, takes_long=True)

    def _convert(self, piece: Piece, row: ConversionToRos, content: Body, to: ToRosContext) -> None:
        begin = len(to.warnings)
        try:
            converted = row.convert(content, to)
        except ConversionError as error:
            piece.made[row.convert] = error, to.warnings[begin:]
            return
        messages = converted if isinstance(converted, list) else [converted]
        piece.messages[row.convert] = messages[0]
        if all(_is_patched(message) for message in messages):
            piece.made[row.convert] = [Packed.of(message) for message in messages], to.warnings[begin:]

    # ── with the sequence lock ────────────────────────────────────────────────────────────────────────────────

    def decode(self, entry: Entry) -> Message:
        """Return the decoded message of an entry.  Raises WireError."""
        results = self._of(entry)
        if results is None:
            return self._acceptance.message(entry.payload[0])
        if isinstance(results.decoded, WireError):
            raise results.decoded
        return results.decoded

    def restored(self, entry: Entry, message: Message) -> RestoredMetadata:
        """Return the contents of the metadata of a message."""
        results = self._of(entry)
        if results and results.restored and results.decoded is message:
            return results.restored
        return restore_metadata(message, self._config.naming)

    def volume(self, image: Image) -> ForeseenVolume | None:
        """Return what a part of an image makes of its volume; None: it was not made."""
        piece = self._piece_of(image)
        return piece.volume if piece else None

    def children(self, bind: Bind) -> Sequence[Body | WireError | None]:
        """Return the contents of the children of a BIND, or why there is none; None: not known."""
        piece = self._piece_of(bind)
        return [one.content for one in piece.children] if piece else [None] * len(bind.children)

    def converted(self, row: ConversionToRos, content: object, to: ToRosContext) -> Sequence[Packed] | None:
        """Return the results of a conversion; None: it was not done with this content and context.

        Raises ConversionError.
        """
        piece = self._piece_of(content)
        if piece is None or (not piece.made and not piece.shared) or not _are_alike(to, piece.to):
            return None
        if row.convert not in piece.made:
            to.made.update(piece.shared)
            return None
        messages, warnings = piece.made[row.convert]
        to.warnings.extend(warnings)
        if isinstance(messages, ConversionError):
            raise messages
        return [_stamped(message, to.stamp_ns) for message in messages]

    def metadata(self, content: object, to: ToRosContext) -> Packed | None:
        """Return the message of the sender's metadata; None: it was not made with this content and context."""
        piece = self._piece_of(content)
        if piece is None or piece.metadata is None or not _are_alike(to, piece.to):
            return None
        return _stamped(piece.metadata, to.stamp_ns)

    def raw(self, entry: Entry, content: object) -> Packed | None:
        """Return the message as a RawMessage, with gateway time; None: it was not made."""
        piece = self._piece_of(content)
        if piece is None or piece.raw is None or not self._of(entry):
            return None
        return _stamped(piece.raw, entry.stamp_ns)

    def message(self, content: object, convert: object) -> RosMessage | None:
        """Return the ROS message of a conversion, without its stamp; None: it was not made."""
        piece = self._piece_of(content)
        return piece.messages.get(convert) if piece else None

    def _of(self, entry: Entry) -> Results | None:
        results = self.results
        return results if results and entry.payload and results.payload is entry.payload[0] else None

    def _piece_of(self, content: object) -> Piece | None:
        piece = self.results.pieces.get(id(content)) if self.results else None
        return piece if piece and piece.content is content else None


def metadata_message(to: ToRosContext) -> Metadata:
    """Return the metadata of the sender as a message of its own, beside a ROS type that cannot contain it."""
    header = Header(to.stamp_ns, to.frame_id)
    return Metadata(header, to.igtl_type, to.device_name, to.message_id, to.metadata)


def _is_patched(message: Any) -> bool:
    """Return whether the only stamp of a message, if there is one, is in the header at its beginning."""
    if message.TYPE in _WITHOUT_STAMP:
        return True
    return message.TYPE != TFMessage.TYPE and bool(fields(message)[0].name == "header")


def _stamped(message: Packed, stamp_ns: int) -> Packed:
    """Return a message with its stamp."""
    if message.TYPE in _WITHOUT_STAMP:
        return message
    head = CdrWriter()
    Header(stamp_ns).write(head)
    stamp = head.finish()[:_STAMP_END]
    if len(message.cdr) >= _LARGE_BYTES:
        return Packed(message.TYPE, message.cdr, stamp)
    return Packed(message.TYPE, stamp + message.cdr[_STAMP_END:])


#: What a conversion depends on: all but the stamp, and what conversions leave in the context.
_DEPENDS = attrgetter(*(one.name for one in fields(ToRosContext) if one.name not in ("stamp_ns", "warnings", "made")))


def _are_alike(one: ToRosContext, other: ToRosContext | None) -> bool:
    """Return whether conversions have the same results in both contexts, apart from the stamp."""
    return other is not None and bool(_DEPENDS(one) == _DEPENDS(other))
