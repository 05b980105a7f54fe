"""The rules for messages of OpenIGTLink: one function for each class of contents."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from igtl_gateway.addon import WireError
from igtl_gateway.addon.igtl import (
    BODIES,
    HEADER_VERSIONS,
    Bind,
    BindChild,
    Capability,
    ColorTable,
    Command,
    Elements,
    EmptyQuery,
    GetBind,
    Image,
    Item,
    Message,
    NdArray,
    PolyData,
    Position,
    QueryReply,
    Raw,
    Sensor,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
    Status,
    String,
    Transform,
    Video,
    cut_text,
    decode_text,
    encode,
    read_content,
    sorted_items,
    visible,
)
from igtl_gateway.addon.igtl import COMMAND_NAME_WIDTH as NAME_WIDTH
from igtl_gateway.addon.messages import (
    CHILD_FRAME_ITEM,
    FRAME_ITEM,
    NAME_ITEM,
    OUR_ITEMS,
    STAMP_ITEM,
    restore_metadata,
    short_device_name,
)
from igtl_gateway.addon.reading import Buffer, join
from igtl_gateway.addon.settings import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.addons.deidentify.context import Context, Removed

#: Modalities of DICOM that stay in IMGMETA.
_MODALITIES = frozenset("CT MR US XA RF CR DX MG NM PT OT ES OP OCT SM XC SEG IVUS RTIMAGE".split())
_STATUS_NAME, _BYTES = 20, (2, 3)
_TYPES_OF_NAMES = frozenset({"name", "device_name", "owner"})


class MessageCleaner:
    """Changes messages of OpenIGTLink by the rules of a context.

    Args:
        context: the rules.
        acceptance: which bytes the session accepted as messages; others are removed.
    """

    def __init__(self, context: Context, acceptance: Acceptance = DEFAULT_ACCEPTANCE) -> None:
        self._context, self._acceptance = context, acceptance

    def clean(self, data: Buffer, stream: str) -> bytes:
        """Return the message without identity.  Raises Removed."""
        try:
            message = self._acceptance.message(data)
            return join(encode(self._message(message, stream)))
        except WireError:
            raise Removed("damaged") from None

    def content(self, type_name: str, data: Buffer, stream: str) -> bytes:
        """Return a content without identity, of a message or of a child of BIND.  Raises Removed."""
        try:
            body = read_content(type_name, memoryview(data))
            return join(self._content(type_name, body, stream).pack())
        except WireError:
            raise Removed("damaged") from None

    def _message(self, message: Message, stream: str) -> Message:
        context = self._context
        type_name = visible(message.type)
        name = context.names.name(restore_metadata(message).device_name)
        content = self._content(type_name, message.content, stream)
        if message.layout or type_name != message.type:
            context.report.add("padding")
        return replace(
            message,
            type=type_name,
            device_name=short_device_name(name),
            content=content,
            header_version=min(message.header_version, HEADER_VERSIONS[-1]),
            ticks=context.times.ticks(message.ticks),
            metadata=self._metadata(message, name),
            layout=None,
        )

    def _metadata(self, message: Message, name: str) -> tuple[Item, ...]:
        context, restored = self._context, restore_metadata(message)
        items = [item for item in message.metadata if item.key not in OUR_ITEMS and context.keeps_key(item.key)]
        context.report.add("metadata", sum(item.key not in OUR_ITEMS for item in message.metadata) - len(items))
        if short_device_name(name) != name:
            items.append(Item.of(NAME_ITEM, name))
        if restored.stamp_ns:
            items.append(Item.of(STAMP_ITEM, str(context.times.ns(restored.stamp_ns))))
        for key, frame in ((FRAME_ITEM, restored.frame_id), (CHILD_FRAME_ITEM, restored.child_frame_id)):
            if frame:
                items.append(Item.of(key, context.names.name(frame)))
        return sorted_items(items)

    def _content(self, type_name: str, content: Any, stream: str) -> Any:
        rule = MessageCleaner._elements if isinstance(content, Elements) else _RULES.get(type(content))
        if type_name not in BODIES or rule is None:  # no rule: its text is not known
            if not self._context.keeps_type(type_name):
                raise Removed("type")
            self._context.report.add("kept type")
            return content
        return rule(self, content, stream)

    def _elements(self, content: Elements, stream: str) -> Elements:
        new = content.elements.copy()
        for name in content.DTYPE.names or ():
            if name == "reserved":
                new[name] = 0
            elif name == "ticks":
                new[name] = [self._context.times.ticks(int(each)) for each in content.elements[name]]
            elif content.DTYPE[name].kind == "S":
                width = content.DTYPE[name].itemsize
                texts = [self._field(name, visible(decode_text(each)), stream) for each in content.elements[name]]
                new[name] = [cut_text(each, width).encode("utf-8", "surrogateescape") for each in texts]
        return replace(content, elements=new)

    def _field(self, name: str, text: str, stream: str) -> str:
        """Return the new text of a field of an element."""
        if name in _TYPES_OF_NAMES:
            return self._context.names.name(text)
        if name == "patient_name":
            return self._context.patient_name(text)
        if name == "patient_id":
            return self._context.patient_id(text)
        return text if name == "modality" and text in _MODALITIES else self._context.text(text, stream)

    def _string(self, content: String, stream: str) -> String:
        new = self._context.text(content.text, stream)
        return content if new == content.text else content.of(new)

    def _status(self, content: Status, stream: str) -> Status:
        name, text = (self._context.text(visible(each), stream) for each in (content.error_name, content.message))
        return replace(content, error_name=cut_text(name, _STATUS_NAME), message=text)

    def _command(self, content: Command, stream: str) -> Command:
        name = cut_text(self._context.names.name(visible(content.name)), NAME_WIDTH)
        new = self._context.text(content.text, stream)
        if new == content.text:
            return replace(content, name=name)
        return Command.of(content.command_id, name, new)

    def _image(self, content: Image, stream: str) -> Image:
        columns, rows, _ = content.dimensions
        left, top, _ = content.subvol_offset
        pixels = self._context.pixels.plain(content.array, stream, (rows, columns), (top, left))
        return content if pixels is None else replace(content, pixels=pixels)

    def _video(self, content: Video, stream: str) -> Video:
        data = self._context.pixels.video(content.codec, bytes(content.data), stream, is_key=content.is_key_frame)
        if data is None:
            raise Removed("pixels")
        return replace(content, data=data)

    def _ndarray(self, content: NdArray, _: str) -> NdArray:
        if content.scalar_type in _BYTES and not self._context.keeps_type("NDARRAY"):
            raise Removed("bytes")
        return content

    def _polydata(self, content: PolyData, _: str) -> PolyData:
        named = [replace(each, name=self._context.names.name(visible(each.name))) for each in content.attributes]
        return replace(content, attributes=tuple(named), name_padding=0)

    def _capability(self, content: Capability, _: str) -> Capability:
        known = tuple(visible(each) for each in content.types if visible(each) in BODIES)
        self._context.report.add("type", len(content.types) - len(known))
        return Capability(known)

    def _bind(self, content: Bind, stream: str) -> Bind:
        children = []
        for child in content.children:
            kind = visible(child.type)
            try:
                data = self.content(kind, child.content, stream)
            except Removed as removed:
                self._context.report.add(removed.rule)
                continue
            children.append(BindChild(kind, self._context.names.name(visible(child.name)), data))
        return Bind(tuple(children))

    def _wanted(self, content: Any, _: str) -> Any:
        wanted = [(visible(kind), self._context.names.name(name)) for kind, name in content.children]
        return replace(content, children=tuple(each for each in wanted if each[0] in BODIES), kept=None)

    def _tracking(self, content: StartTracking, _: str) -> StartTracking:
        return replace(content, coordinate_name=self._context.names.name(visible(content.coordinate_name)))


_Rule = Callable[[MessageCleaner, Any, str], Any]


def _keep(_: MessageCleaner, content: Any, __: str) -> Any:
    """Return a content that has numbers only."""
    return content


#: Class of contents → its rule; lists of elements have one of their own.  A message of any other class is removed.
_RULES: dict[type, _Rule] = {
    **dict.fromkeys((Raw, Transform, Position, Sensor, ColorTable, StartPolyData, QueryReply), _keep),
    String: MessageCleaner._string,
    BODIES["CLIENTINFO"]: MessageCleaner._string,
    Status: MessageCleaner._status,
    Command: MessageCleaner._command,
    Image: MessageCleaner._image,
    Video: MessageCleaner._video,
    NdArray: MessageCleaner._ndarray,
    PolyData: MessageCleaner._polydata,
    Capability: MessageCleaner._capability,
    Bind: MessageCleaner._bind,
    GetBind: MessageCleaner._wanted,
    StartBind: MessageCleaner._wanted,
    StartTracking: MessageCleaner._tracking,
    StartVideo: lambda _, content, __: replace(content, trailing=b""),
    EmptyQuery: lambda _, __, ___: EmptyQuery(),
}
