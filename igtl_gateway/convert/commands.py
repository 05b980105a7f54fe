"""COMMAND ⇄ igtl_msgs/Command, RTS_COMMAND ⇄ igtl_msgs/CommandReply.

The protocol gives the reply no field for success: OpenIGTLinkIO says it in the metadata (``Status``,
``ErrorMessage``), PLUS there or in its XML (``<CommandReply Name= Status= Message= />``).  We read both and
write the metadata.
"""

from __future__ import annotations

import re

from igtl_gateway.convert.columns import fit_texts
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import Command, CommandReply, Items, MetadataItem
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire import command as wire
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.text import CODECS, mib_of

_REPLY_TYPE = "RTS_COMMAND"
#: Of 128: a name that fills its field runs into the next one in C++ readers.
_NAME_BYTES = wire.NAME_WIDTH - 1

STATUS, ERROR_MESSAGE = "Status", "ErrorMessage"
#: Where peers write why a command failed, the first that is there counts.
_MESSAGE_KEYS = (ERROR_MESSAGE, "Error", "Message")
_STATUS_OF = {
    "SUCCESS": CommandReply.SUCCESS,
    "TRUE": CommandReply.SUCCESS,
    "OK": CommandReply.SUCCESS,
    "FAIL": CommandReply.FAIL,
    "FALSE": CommandReply.FAIL,
    "ERROR": CommandReply.FAIL,
}
_TOLD_STATUS = {CommandReply.SUCCESS: "SUCCESS"}

#: PLUS's reply: one element, at the very start (so that a search cannot be made to take long).
_PLUS_REPLY = re.compile(r"""\s*(?:<\?xml[^>]*>\s*)?<CommandReply((?:\s+[\w:.-]+\s*=\s*(?:"[^"]*"|'[^']*'))*)\s*/?>""")
#: How many characters are searched for it: sixteen times as many as PLUS's library can write, in 0.2 s.
_MAX_XML = 1 << 20
_ATTRIBUTE = re.compile(r"""([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")

#: Encodings that we write.  "UTF-16" without an order means another one on every machine; UTF-8 takes its place.
_WRITTEN = {mib: codec for mib, codec in CODECS.items() if codec != "utf-16"}


def command_to_ros(content: wire.Command, to: ToRosContext) -> Command:
    """The text in its named encoding; what stands behind a NUL is left out."""
    return Command(
        Header(to.stamp_ns, to.frame_id),
        to.device_name,
        content.command_id,
        visible(content.name),
        content.encoding,
        visible(content.text),
        to.metadata,
        to.link,
    )


def command_to_igtl(message: Command, to: ToIgtlContext) -> ConvertedMessage:
    """With the id as it is: 0 is for the gateway to replace.  The time-out stays here."""
    return _outgoing(message, message.metadata, "COMMAND", to)


def reply_to_ros(content: wire.Command, to: ToRosContext) -> CommandReply:
    """Success unless metadata or content say otherwise; a status that nobody knows is no success."""
    text = visible(content.text)
    attributes = _plus_reply_attributes(text)
    reply = _first(to.metadata, (STATUS,)) or attributes.get(STATUS, "")
    status = _STATUS_OF.get(reply.strip().upper(), CommandReply.FAIL if reply.strip() else CommandReply.SUCCESS)
    if reply.strip() and reply.strip().upper() not in _STATUS_OF:
        expected = ", ".join(_STATUS_OF)
        to.warnings.append(("unknown_status", f"found Status {reply!r} of a reply, expected one of {expected}: failed"))
    why = ""
    if status != CommandReply.SUCCESS:
        why = _first(to.metadata, _MESSAGE_KEYS) or attributes.get("Message", "")
    return CommandReply(
        Header(to.stamp_ns, to.frame_id),
        to.device_name,
        content.command_id,
        visible(content.name),
        status,
        why,
        content.encoding,
        text,
        to.metadata,
        to.link,
    )


def reply_to_igtl(message: CommandReply, to: ToIgtlContext) -> ConvertedMessage:
    """Status and error message as metadata; they replace what the message itself has under these keys."""
    reply = {STATUS: _TOLD_STATUS.get(message.status, "FAIL")}
    if message.status != CommandReply.SUCCESS:
        reply[ERROR_MESSAGE] = message.error_message
    others = tuple(item for item in message.metadata if item.key not in reply)
    ours = tuple(MetadataItem(key, 0, value) for key, value in reply.items())
    return _outgoing(message, others + ours, _REPLY_TYPE, to)


def _outgoing(message: Command | CommandReply, metadata: Items, igtl_type: str, to: ToIgtlContext) -> ConvertedMessage:
    (name,) = fit_texts((message.name,), _NAME_BYTES, "name of a command", to)
    data, encoding = _encoded(message.content, message.encoding, to)
    return ConvertedMessage(
        wire.Command(message.id, name, data, encoding),
        message.header.stamp_ns,
        message.header.frame_id,
        metadata=metadata,
        igtl_type=igtl_type,
        device_name=message.device_name,
        link=message.link,
    )


def _encoded(text: str, encoding: int, to: ToIgtlContext) -> tuple[bytes, int]:
    """The text in the wanted encoding (MIBenum, 0 = any), else in UTF-8; with the encoding that it got."""
    if encoding:
        try:
            return text.encode(_WRITTEN[encoding]), encoding
        except (KeyError, UnicodeEncodeError):
            to.warnings.append(("encoding_changed", f"text that is invalid in encoding {encoding} is sent as UTF-8"))
    return text.encode("utf-8", "surrogateescape"), mib_of(text)


def _first(metadata: Items, keys: tuple[str, ...]) -> str:
    """The value of the first of ``keys`` that has one, "" if none has."""
    values = {item.key: item.value for item in reversed(metadata)}
    return next((values[key] for key in keys if values.get(key)), "")


def _plus_reply_attributes(text: str) -> dict[str, str]:
    """Attributes of the ``<CommandReply …>`` that the text is; none of any other text."""
    match = _PLUS_REPLY.match(text, 0, _MAX_XML)
    if not match:
        return {}
    return {name: _unescaped(one or other) for name, one, other in _ATTRIBUTE.findall(match[1])}


#: The five entities of XML; & last, or it would make others.
_ENTITIES = (("&lt;", "<"), ("&gt;", ">"), ("&quot;", '"'), ("&apos;", "'"), ("&amp;", "&"))


def _unescaped(text: str) -> str:
    """An attribute's value.  (The library's function costs 28 ms of every start, for all that it imports.)"""
    for entity, letter in _ENTITIES:
        text = text.replace(entity, letter)
    return text
