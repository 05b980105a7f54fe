"""COMMAND ⇄ igtl_msgs/Command, RTS_COMMAND ⇄ igtl_msgs/CommandReply.

The protocol defines no field for the success of a command.  OpenIGTLinkIO writes it to the metadata (``Status``,
``ErrorMessage``), PLUS to the metadata and to its XML (``<CommandReply Name= Status= Error= Message= />``), in header
version 1 to the XML only.  The gateway reads both forms and writes the metadata; a failure for a peer of header version
1, which has none, to the XML.
"""

from __future__ import annotations

import re
from dataclasses import replace

from igtl_gateway.convert.columns import fit_texts
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import Command, CommandReply, MetadataItem
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire import command as wire
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.text import CODECS, mib_of

_REPLY_TYPE = "RTS_COMMAND"
#: One byte less than the field: C++ readers read beyond the end of a name that fills it.
_NAME_BYTES = wire.NAME_WIDTH - 1

STATUS, ERROR_MESSAGE = "Status", "ErrorMessage"
#: Keys under which peers write the reason for a failure, in the order of preference.
_MESSAGE_KEYS = (ERROR_MESSAGE, "Error", "Message")
_STATUS_OF = {
    "SUCCESS": CommandReply.SUCCESS,
    "TRUE": CommandReply.SUCCESS,
    "OK": CommandReply.SUCCESS,
    "FAIL": CommandReply.FAIL,
    "FALSE": CommandReply.FAIL,
    "ERROR": CommandReply.FAIL,
}

#: PLUS's reply: one element at the start of the text, which bounds the time of the search.
_PLUS_REPLY = re.compile(r"""\s*(?:<\?xml[^>]*>\s*)?<CommandReply((?:\s+[\w:.-]+\s*=\s*(?:"[^"]*"|'[^']*'))*)\s*/?>""")
#: Number of characters that are searched, in 0.2 s: sixteen times as many as PLUS's library can write.
_MAX_XML = 1 << 20
#: End of a reply as PLUS writes it.
_UNESCAPED_END = '"></CommandReply>'
_ATTRIBUTE = re.compile(r"""([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")

#: Encodings that the gateway writes; not "UTF-16" without a byte order, which depends on the machine.
_WRITTEN = {mib: codec for mib, codec in CODECS.items() if codec != "utf-16"}


def command_to_ros(content: wire.Command, to: ToRosContext) -> Command:
    """Convert to Command, with the text decoded from its encoding and without bytes after a NUL."""
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
    """Convert to COMMAND with the given id; the gateway replaces an id of 0.  The timeout is not sent."""
    return _outgoing(message, message.metadata, "COMMAND", to)


def reply_to_ros(content: wire.Command, to: ToRosContext) -> CommandReply:
    """Convert to CommandReply: success if neither metadata nor content has a status.  Unknown statuses are failures."""
    text = visible(content.text)
    status, reason, unknown = reply_result(text, to.metadata)
    if unknown:
        expected = ", ".join(_STATUS_OF)
        warning = f"reply with Status {unknown!r}, expected one of {expected}: treated as failed"
        to.warnings.append(("unknown_status", warning))
    return CommandReply(
        Header(to.stamp_ns, to.frame_id),
        to.device_name,
        content.command_id,
        visible(content.name),
        status,
        reason,
        content.encoding,
        text,
        to.metadata,
        to.link,
    )


def reply_result(text: str, metadata: tuple[MetadataItem, ...]) -> tuple[int, str, str]:
    """Return status (as in CommandReply), reason of a failure, and the status as sent if it is unknown."""
    attributes = _plus_reply_attributes(text)
    found = _first(metadata, (STATUS,)) or attributes.get(STATUS, "")
    word = found.strip().upper()
    status = _STATUS_OF.get(word, CommandReply.FAIL if word else CommandReply.SUCCESS)
    reason = ""
    if status != CommandReply.SUCCESS:
        reasons = (attributes[key] for key in _MESSAGE_KEYS if attributes.get(key))
        reason = _first(metadata, _MESSAGE_KEYS) or next(reasons, "")
    return status, reason, found if word and word not in _STATUS_OF else ""


def reply_to_igtl(message: CommandReply, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to RTS_COMMAND, with status and error message as metadata that replaces items with the same keys."""
    result = {STATUS: "SUCCESS"}
    if message.status != CommandReply.SUCCESS:
        result = {STATUS: "FAIL", ERROR_MESSAGE: message.error_message}
    others = tuple(item for item in message.metadata if item.key not in result)
    ours = tuple(MetadataItem(key, 0, value) for key, value in result.items())
    return _outgoing(message, others + ours, _REPLY_TYPE, to)


def with_failure_in_text(message: CommandReply) -> CommandReply:
    """Return a reply for header version 1: a failure is in its content, with its reason and the content it had."""
    if message.status == CommandReply.SUCCESS or reply_result(message.content, ())[0] != CommandReply.SUCCESS:
        return message
    reason = ": ".join(text for text in (message.error_message, message.content) if text)
    return replace(message, content=failure_text(message.name, reason))


def failure_text(name: str, reason: str) -> str:
    """Return the content of a reply that reports a failure, as PLUS writes it."""
    from xml.sax.saxutils import quoteattr

    return f'<CommandReply Name={quoteattr(name)} Status="FAIL" Message={quoteattr(reason)} />'


def _outgoing(
    message: Command | CommandReply, metadata: tuple[MetadataItem, ...], igtl_type: str, to: ToIgtlContext
) -> ConvertedMessage:
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
    """Return the text in the given encoding (MIBenum, 0 = any) or in UTF-8, and the encoding used."""
    if encoding:
        try:
            return text.encode(_WRITTEN[encoding]), encoding
        except (KeyError, UnicodeEncodeError):
            to.warnings.append(("encoding_changed", f"text that is invalid in encoding {encoding} is sent as UTF-8"))
    return text.encode("utf-8", "surrogateescape"), mib_of(text)


def _first(metadata: tuple[MetadataItem, ...], keys: tuple[str, ...]) -> str:
    """Return the first value under ``keys`` that is not empty, or ""."""
    values = {item.key: item.value for item in reversed(metadata)}
    return next((values[key] for key in keys if values.get(key)), "")


def _plus_reply_attributes(text: str) -> dict[str, str]:
    """Return the attributes if the text is ``<CommandReply …>``, else none."""
    match = _PLUS_REPLY.match(text, 0, _MAX_XML)
    if not match:
        return _unescaped_attributes(text)
    return {name: _unescaped(one or other) for name, one, other in _ATTRIBUTE.findall(match[1])}


def _unescaped_attributes(text: str) -> dict[str, str]:
    """Return the attributes of a reply whose values contain quotation marks, which PLUS does not escape.

    It writes the attributes in one order: Name, Status, for a failure Error, Message.
    """
    if not text.startswith("<CommandReply ") or not text.rstrip().endswith(_UNESCAPED_END):
        return {}
    status, _, rest = text.rstrip().removesuffix(_UNESCAPED_END).partition(' Status="')[2].partition('"')
    found = {STATUS: status}
    if rest.startswith(' Error="'):
        found["Error"], separator, message = rest.removeprefix(' Error="').partition('" Message="')
        rest = f' Message="{message}' if separator else ""
    if rest.startswith(' Message="'):
        found["Message"] = rest.removeprefix(' Message="')
    return found


#: The five entities of XML; & must be last, because its replacement could form another entity.
_ENTITIES = (("&lt;", "<"), ("&gt;", ">"), ("&quot;", '"'), ("&apos;", "'"), ("&amp;", "&"))


def _unescaped(text: str) -> str:
    """Return the value of an attribute.  (Importing the standard library's function takes 28 ms at each start.)"""
    for entity, letter in _ENTITIES:
        text = text.replace(entity, letter)
    return text
