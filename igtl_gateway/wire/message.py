"""A whole OpenIGTLink message: header, extended header, content, metadata ⇄ bytes.

Layouts follow the protocol's ``header.md`` and, where that contradicts itself, the reference library.  A body of
version 1 is the content.  A body of version 2 is extended header, content, metadata header and metadata.  Their
layouts are below; that of the header is in ``igtl_gateway.wire.header``.

Decoding copies nothing: content and arrays are views on the received buffer.  Encoding returns a list of buffers for
one scatter-gather send; a payload is never joined with its header.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import field
from typing import Any, ClassVar

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.errors import ChecksumMismatch, MalformedBody, TruncatedMessage, WireError
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import fraction_to_ns
from igtl_gateway.base.values import value
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.deviations import BARE, READ, VERSION_3, explained
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.header import HEADER_SIZE, HEADER_VERSIONS, READING, Header, crc64
from igtl_gateway.wire.layout import Field, compile_struct, offset_of
from igtl_gateway.wire.layout import Layout as Rows
from igtl_gateway.wire.query import EmptyQuery, split_query
from igtl_gateway.wire.registry import BODIES, describe_content, read_content
from igtl_gateway.wire.text import US_ASCII, mib_of

#: The reference library's reader holds metadata sizes in 16 bits and refuses more.
MAX_METADATA_SENT = 65_535
#: What we accept: far above any real use, far below what could hurt.
MAX_METADATA_ACCEPTED = 1 << 20
#: Items of one message.  Real senders have tens, and the attributes of a DICOM header are hundreds; each is an object.
MAX_ITEMS = 1_024


@value(frozen=True, slots=True)
class Item:
    """One metadata pair of header version 2.

    Attributes:
        key: US-ASCII by document, any text in practice.
        value: raw bytes; ``text`` reads them.
        encoding: IANA MIBenum of the value (3 US-ASCII, 106 UTF-8).
    """

    key: str
    value: bytes
    encoding: int = US_ASCII

    @property
    def text(self) -> str:
        """The value as text; undecodable bytes are replaced."""
        return self.value.decode("utf-8", "replace")

    @classmethod
    def of(cls, key: str, text: str) -> Item:
        """Return a pair with a string as value, marked as UTF-8 only if it is not ASCII."""
        return cls(key, text.encode("utf-8", "surrogateescape"), mib_of(text))


def sorted_items(items: Iterable[Item]) -> tuple[Item, ...]:
    """Metadata as the reference library keeps it: one item per key, the last one, in the order of the key's bytes.

    For metadata that we make; what was received is encoded again in the order in which it came.
    """
    last = {item.key.encode("utf-8", "surrogateescape"): item for item in items}
    return tuple(last[key] for key in sorted(last))


@value(frozen=True, slots=True)
class MetadataLayout:
    """What surrounds the content of a version 2 message, where its sender did that unlike us.

    Attributes:
        extension: what follows the 12 known bytes of the extended header.
        metadata_header, metadata: as received: missing, with bytes behind the items, or larger than we send.
        deviation: key of ``deviations.READ`` if the message is not one of the protocol; "" otherwise.
    """

    extension: bytes
    metadata_header: bytes
    metadata: bytes
    deviation: str = ""

    def holds(self, metadata: tuple[Item, ...]) -> bool:
        """Return whether it has these items; it has not if they were replaced after decoding."""
        return _metadata(memoryview(self.metadata_header), memoryview(self.metadata))[0] == metadata


@value(frozen=True, slots=True)
class Message:
    """One OpenIGTLink message.

    Attributes:
        type: type name, such as ``"TRANSFORM"``.
        device_name: name of the stream, at most 20 bytes of UTF-8.
        content: the decoded body; ``Raw`` for types without a codec.
        ticks: tick word of the sender's time stamp; 0 = unset.
        header_version: 1 or 2, and 3 of a message that deviates.  Version 1 carries neither id nor metadata.
        message_id: sender's id of the message (version 2).
        metadata: pairs in wire order (version 2).
        layout: for messages received: oddities around the content, so that they are encoded as received.
    """

    type: str
    device_name: str
    content: Body
    ticks: int = 0
    header_version: int = 1
    message_id: int = 0
    metadata: tuple[Item, ...] = field(default=())
    layout: MetadataLayout | None = None

    @property
    def deviation(self) -> str:
        """How a received message deviates from the protocol, a key of ``deviations.READ``; "": it does not."""
        return self.layout.deviation if self.layout else ""


def decode(data: Buffer, *, check_crc: bool = True, reading: int = 0) -> Message:
    """The message in ``data``: exactly one, whole, header and body.

    Args:
        data: header and body.
        check_crc: whether a wrong CRC is an error.
        reading: which messages that deviate from the protocol are read, by these rules: 0 none, ``READING`` all whose
            meaning is certain.  Such a message has a ``deviation``, and is encoded as it was received.

    Raises:
        TruncatedMessage: fewer bytes than header or fields announce.
        ChecksumMismatch: the CRC of the body is wrong (only with ``check_crc``).
        MalformedBody: header version, length or value that the protocol forbids.
    """
    view = memoryview(data)
    header = Header.unpack(view)
    body = view[HEADER_SIZE:]
    deviates = header.version not in HEADER_VERSIONS
    if deviates and not (reading and header.version == _NEXT_VERSION):
        raise _unknown_version(header, body)
    if body.nbytes != header.body_size:
        error = TruncatedMessage if body.nbytes < header.body_size else MalformedBody
        raise error(f"{visible(header.type)} body", counted(body.nbytes, "byte"), counted(header.body_size, "byte"))
    if check_crc and (wrong := _checksum_mismatch(header, body)):
        raise wrong
    try:
        return _decoded(header, body)
    except (MalformedBody, TruncatedMessage) as error:
        if reading and (message := _bare(header, body)):
            return message
        if deviates:
            raise _unknown_version(header, body) from None
        raise explained(error, header, body, _content(header, body)) from None


#: What some programs write for protocol version 3.
_NEXT_VERSION = 3


def _unknown_version(header: Header, body: memoryview) -> WireError:
    return explained(MalformedBody("header, version", header.version, "1 or 2"), header, body, body)


def _bare(header: Header, body: memoryview) -> Message | None:
    """The message of a body that is a content alone, without an extended header; None if that is not certain.

    It is certain if the first bytes cannot be an extended header, not even one with wrong sizes behind its own, and the
    body is, to the last byte, a content of a type that has one.
    """
    codec = BODIES.get(visible(header.type))
    if header.version == 1 or codec is None or body[:2] == _OWN_SIZE:
        return None
    # any bytes fit a query without fields, and all types but queries have a content
    if codec is EmptyQuery if body.nbytes else split_query(header.type) is None:
        return None
    try:
        ExtendedHeader.unpack(body)
    except WireError:
        try:
            content = read_content(header.type, body)
            if not isinstance(content, codec) or join(content.pack()) != body:
                return None
        except WireError:
            return None
        layout = MetadataLayout(b"", b"", b"", BARE)
        return Message(header.type, header.device_name, content, header.ticks, header.version, layout=layout)
    return None


def _content(header: Header, body: memoryview) -> memoryview:
    """The content of a body; all of it if its extended header is not valid."""
    if header.version == 1:
        return body
    try:
        return ExtendedHeader.unpack(body).split(body)[0]
    except WireError:
        return body


def _decoded(header: Header, body: memoryview) -> Message:
    if header.version == 1:
        return Message(header.type, header.device_name, read_content(header.type, body), header.ticks)
    extended = ExtendedHeader.unpack(body)
    content, head, data = extended.split(body)
    items, items_end = _metadata(head, data)
    extension = body[_EXTENDED.size : extended.ext_header_size]
    tight = head.nbytes == _COUNT.size + len(items) * _ITEM.size and items_end == data.nbytes <= MAX_METADATA_SENT
    deviation = "" if header.version in HEADER_VERSIONS else VERSION_3
    return Message(
        header.type,
        header.device_name,
        read_content(header.type, content),
        header.ticks,
        header.version,
        extended.message_id,
        items,
        None
        if tight and not extension and not deviation
        else MetadataLayout(bytes(extension), bytes(head), bytes(data), deviation),
    )


def metadata_of(data: Buffer) -> tuple[Item, ...]:
    """The metadata of a whole message, without its content; () in header version 1.  Raises what `decode` raises."""
    view = memoryview(data)
    header = Header.unpack(view)
    if header.version == 1:
        return ()
    body = view[HEADER_SIZE:]
    try:
        _, head, items = ExtendedHeader.unpack(body).split(body)
    except WireError:
        if _bare(header, body):
            return ()
        raise
    return _metadata(head, items)[0]


@value(frozen=True, slots=True)
class ExtendedHeader:
    """The extended header of version 2: sizes in bytes and the message id.

    Attributes:
        ext_header_size: of this header; 12 or more, what follows is skipped.
        metadata_header_size, metadata_size: of what stands at the end of the body.
        message_id: sender's id of the message.
    """

    LAYOUT: ClassVar[Rows] = (
        Field("ext_header_size", "u16"),
        Field("metadata_header_size", "u16"),
        Field("metadata_size", "u32"),
        Field("message_id", "u32"),
    )

    ext_header_size: int
    metadata_header_size: int
    metadata_size: int
    message_id: int

    @classmethod
    def unpack(cls, body: memoryview) -> ExtendedHeader:
        """From the start of a body; every size is checked against the body."""
        if body.nbytes < _EXTENDED.size:
            raise TruncatedMessage("extended header", counted(body.nbytes, "byte"), f"{_EXTENDED.size} bytes")
        extended = cls(*_EXTENDED.unpack_from(body))
        if extended.ext_header_size < _EXTENDED.size:
            raise MalformedBody(
                "extended header, offset 0", f"size {extended.ext_header_size}", f"at least {_EXTENDED.size}"
            )
        total = extended.ext_header_size + extended.metadata_header_size + extended.metadata_size
        if total > body.nbytes:
            raise MalformedBody(
                "extended header",
                f"sizes of {counted(total, 'byte')}",
                f"at most the body, {counted(body.nbytes, 'byte')}",
            )
        if extended.metadata_size > MAX_METADATA_ACCEPTED:
            raise MalformedBody(
                "extended header, offset 4",
                counted(extended.metadata_size, "byte"),
                f"at most {MAX_METADATA_ACCEPTED}",
            )
        return extended

    def split(self, body: memoryview) -> tuple[memoryview, memoryview, memoryview]:
        """Content, metadata header and metadata of the body that this extended header begins."""
        # the library finds the metadata from the end of the body, so do we
        data_at = body.nbytes - self.metadata_size
        head_at = data_at - self.metadata_header_size
        return body[self.ext_header_size : head_at], body[head_at:data_at], body[data_at:]


_EXTENDED = compile_struct(ExtendedHeader.LAYOUT)
EXTENDED_SIZE = _EXTENDED.size
#: How an extended header begins: with its own size.
_OWN_SIZE = struct.pack(">H", EXTENDED_SIZE)
#: Offset of the message id in a body of version 2.
MESSAGE_ID_AT = offset_of(ExtendedHeader.LAYOUT, "message_id")

#: Metadata header and metadata.
METADATA_LAYOUT: Rows = (
    Field("count", "u16", 1, "number of items"),
    Field("key_size", "u16", 1, "bytes", per="item"),
    Field("encoding", "u16", 1, "IANA MIBenum of the value: 3 US-ASCII, 106 UTF-8", per="item"),
    Field("value_size", "u32", 1, "bytes", per="item"),
    Field("key", "char", "key_size", per="item"),
    Field("value", "char", "value_size", per="item"),
)
_COUNT = compile_struct(METADATA_LAYOUT)
_ITEM = compile_struct(METADATA_LAYOUT, "item")


def _metadata(head: memoryview, data: memoryview) -> tuple[tuple[Item, ...], int]:
    """The items, and how much of ``data`` they take."""
    if head.nbytes == 0 and data.nbytes == 0:
        return (), 0
    if head.nbytes < _COUNT.size:
        raise TruncatedMessage("metadata header", counted(head.nbytes, "byte"), f"at least {_COUNT.size}")
    (count,) = _COUNT.unpack_from(head)
    if head.nbytes < _COUNT.size + count * _ITEM.size:
        raise MalformedBody(
            "metadata header",
            f"{counted(count, 'item')} in {counted(head.nbytes, 'byte')}",
            f"{_ITEM.size} bytes an item",
        )
    _check_count(count)
    items = []
    offset = 0
    for index in range(count):
        key_size, encoding, value_size = _ITEM.unpack_from(head, _COUNT.size + index * _ITEM.size)
        end = offset + key_size + value_size
        if end > data.nbytes:
            raise MalformedBody(
                f"metadata item {index}",
                f"key and value up to byte {end}",
                f"at most {counted(data.nbytes, 'byte')} of metadata",
            )
        value_at = offset + key_size
        key = bytes(data[offset:value_at]).decode("utf-8", "surrogateescape")
        items.append(Item(key, bytes(data[value_at:end]), encoding))
        offset = end
    return tuple(items), offset


def _check_count(count: int) -> None:
    if count > MAX_ITEMS:
        raise MalformedBody("metadata header", counted(count, "item"), f"at most {MAX_ITEMS}")


def encode(message: Message) -> list[Buffer]:
    """The message as buffers to be sent one after the other.

    The first buffer holds the header and all small fields in front of the payload; payload arrays follow as
    they are, without a copy.

    Raises:
        MalformedBody: a name, size or value that does not fit the format.
    """
    try:
        return _encode(message)
    except struct.error as error:
        found = f"a number outside its field ({error})"
        raise MalformedBody(f"{visible(message.type)}, encoding", found, "what the layout holds") from None


def _encode(message: Message) -> list[Buffer]:
    if message.header_version not in HEADER_VERSIONS and not message.deviation:
        raise MalformedBody("header, version", message.header_version, "1 or 2")
    parts = message.content.pack()
    if message.header_version == 1 or (message.deviation == BARE and not message.metadata):
        front, back = b"", b""
    else:
        layout = message.layout
        if layout is None or layout.deviation == BARE or not layout.holds(message.metadata):
            layout = MetadataLayout(b"", *_pack_metadata(message.metadata))
        extended_size = _EXTENDED.size + len(layout.extension)
        head, metadata = layout.metadata_header, layout.metadata
        front = _EXTENDED.pack(extended_size, len(head), len(metadata), message.message_id) + layout.extension
        back = head + metadata
    crc = crc64(front) if front else 0
    size = len(front) + len(back)
    for part in parts:
        crc = crc64(part, crc)
        size += memoryview(part).nbytes
    if back:
        crc = crc64(back, crc)
    header = Header(message.header_version, message.type, message.device_name, message.ticks, size, crc).pack()
    if parts and isinstance(parts[0], bytes):
        buffers: list[Buffer] = [header + front + parts[0], *parts[1:]]
    else:
        buffers = [header + front, *parts]
    if back:
        buffers.append(back)
    return buffers


def _pack_metadata(items: Sequence[Item]) -> tuple[bytes, bytes]:
    """Metadata header and metadata."""
    _check_count(len(items))
    head = [_COUNT.pack(len(items))]
    data: list[bytes] = []
    for item in items:
        key = item.key.encode("utf-8", "surrogateescape")
        if len(key) > 0xFFFF:
            raise MalformedBody("metadata key", counted(len(key), "byte"), "at most 65535 bytes")
        head.append(_ITEM.pack(len(key), item.encoding, len(item.value)))
        data += (key, item.value)
    packed = b"".join(data)
    if len(packed) > MAX_METADATA_SENT:
        raise MalformedBody("metadata", counted(len(packed), "byte"), f"at most {MAX_METADATA_SENT} bytes")
    return b"".join(head), packed


def describe(data: Buffer) -> dict[str, Any]:
    """A message as JSON values, with the keys of the reference corpus; never raises for what the body holds.

    An error is shown under ``"error"``, as what was found and what was expected: a body that cannot be
    decoded, which has no ``"content"``, or a wrong CRC, whose content may be anything.
    Raises TruncatedMessage where not even the header is whole.
    """
    view = memoryview(data)
    header = Header.unpack(view)
    body = view[HEADER_SIZE:]
    fraction = header.ticks & 0xFFFFFFFF
    shown: dict[str, Any] = {
        "header_version": header.version,
        "type": visible(header.type),
        "device_name": visible(header.device_name),
        "timestamp": {"sec": header.ticks >> 32, "frac": fraction, "nanosec": fraction_to_ns(fraction)},
        "body_size": header.body_size,
        "crc": f"{header.crc:016x}",
    }
    wrong = _checksum_mismatch(header, body)
    shown["crc_ok"] = wrong is None and body.nbytes == header.body_size
    errors: list[WireError] = [wrong] if wrong else []
    try:
        if header.version > 1:
            with suppress(MalformedBody, TruncatedMessage):  # that of ``decode`` also has what is known of the sender
                extended = ExtendedHeader.unpack(body)
                shown["ext"] = {
                    "ext_header_size": extended.ext_header_size,
                    "metadata_header_size": extended.metadata_header_size,
                    "metadata_size": extended.metadata_size,
                    "message_id": extended.message_id,
                }
                shown["content_size"] = extended.split(body)[0].nbytes
        else:
            shown["content_size"] = body.nbytes
        message = decode(view, check_crc=False, reading=READING)
        if message.deviation:
            shown["deviation"] = READ[message.deviation]
            shown["content_size"] = sum(memoryview(part).nbytes for part in message.content.pack())
        if header.version > 1:
            shown["metadata"] = [
                {"key": visible(item.key), "encoding": item.encoding, "value": item.text} for item in message.metadata
            ]
        shown["content"] = describe_content(message.content)
    except (MalformedBody, TruncatedMessage) as error:
        errors.append(error)
    if errors:
        text = "; ".join(map(str, errors))  # of a wrong CRC first: it explains the other
        first = errors[0]
        facts = {"place": first.place, "found": str(first.found), "expected": str(first.expected)}
        shown["error"] = {"code": first.code, "text": text, **facts}
    return shown


def _checksum_mismatch(header: Header, body: memoryview) -> ChecksumMismatch | None:
    """The error for a whole body whose CRC is wrong: found in the header, expected for the body that arrived."""
    if body.nbytes != header.body_size or (crc := crc64(body)) == header.crc:
        return None
    place = f"{visible(header.type)} header, CRC-64 of the body"
    return ChecksumMismatch(place, f"{header.crc:016x}", f"{crc:016x}")
