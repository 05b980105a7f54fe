"""COMMAND and its reply: strings in every encoding, ids, and success wherever peers write it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.convert import commands
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import Command, CommandReply, MetadataItem
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire import command as wire
from igtl_gateway.wire.text import CODECS
from tests.tables import table
from tests.timing import quick

XML = '<Command Name="Start" Text="é"/>'
SUCCESS, FAIL = CommandReply.SUCCESS, CommandReply.FAIL


def items(**pairs: str) -> tuple[MetadataItem, ...]:
    return tuple(MetadataItem(key, 3, value) for key, value in pairs.items())


def to_ros(**pairs: str) -> ToRosContext:
    return ToRosContext("Server", 7, "base", "", metadata=items(**pairs), link=4)


def sent(outgoing: ConvertedMessage) -> wire.Command:
    assert isinstance(outgoing.content, wire.Command)
    return wire.Command.unpack(memoryview(join(outgoing.content.pack())))


def reply(text: str = "", **pairs: str) -> CommandReply:
    return commands.reply_to_ros(wire.Command.of(5, "Start", text), to_ros(**pairs))


def test_a_command_there_and_back() -> None:
    content = wire.Command.of(2**32 - 1, "Start", XML)
    message = commands.command_to_ros(content, to_ros(User="me"))
    assert message == Command(
        Header(7, "base"), "Server", 2**32 - 1, "Start", 106, XML, items(User="me"), link=4, timeout=0.0
    )
    outgoing = commands.command_to_igtl(Command.unpack(message.pack()), ToIgtlContext())
    assert sent(outgoing) == content
    assert (outgoing.stamp_ns, outgoing.frame_id, outgoing.metadata) == (7, "base", items(User="me"))
    assert (outgoing.igtl_type, outgoing.device_name, outgoing.link) == ("COMMAND", "Server", 4)


def command(**changes: Any) -> Command:
    return replace(Command(Header(), "", 1, "Start", 0, XML), **changes)


@pytest.mark.parametrize(("text", "encoding"), [("plain", 3), ("", 3), ("é", 106), ("\udcff", 106)])
def test_without_an_encoding_the_text_decides(text: str, encoding: int) -> None:
    to = ToIgtlContext()
    content = sent(commands.command_to_igtl(command(content=text), to))
    assert (content.data, content.encoding, to.warnings) == (text.encode("utf-8", "surrogateescape"), encoding, [])


@table("encoding", sorted(CODECS.keys() - {3, 1015}))
@table("text", ["plain", "1 < 2"])
def test_every_encoding_that_we_read_we_write(encoding: int, text: str) -> None:
    to = ToIgtlContext()
    content = sent(commands.command_to_igtl(command(content=text, encoding=encoding), to))
    assert (content.encoding, content.text, to.warnings) == (encoding, text, [])
    assert commands.command_to_ros(content, to_ros()).content == text


def test_latin_1_is_not_utf_8() -> None:
    assert sent(commands.command_to_igtl(command(content="é", encoding=4), ToIgtlContext())).data == b"\xe9"


@pytest.mark.parametrize(("text", "encoding"), [("é", 3), ("中", 4), ("x", 9999), ("x", 1015)])
def test_an_encoding_that_does_not_do_becomes_utf_8_and_is_told(text: str, encoding: int) -> None:
    to = ToIgtlContext()
    content = sent(commands.command_to_igtl(command(content=text, encoding=encoding), to))
    assert (content.data, content.text) == (text.encode(), text)
    assert content.encoding == (3 if text.isascii() else 106)
    assert [code for code, _ in to.warnings] == ["encoding_changed"]


@pytest.mark.parametrize(
    ("name", "kept", "cut"),
    [("x" * 127, "x" * 127, False), ("x" * 128, "x" * 127, True), ("é" * 64, "é" * 63, True), ("a\x00b", "a", True)],
)
def test_long_names_are_cut_and_it_is_told(name: str, kept: str, cut: bool) -> None:
    for message, convert in (
        (command(name=name), commands.command_to_igtl),
        (CommandReply(Header(), "", 1, name, SUCCESS), commands.reply_to_igtl),
    ):
        to = ToIgtlContext()
        assert sent(convert(message, to)).name == kept  # type: ignore[arg-type]
        assert [code for code, _ in to.warnings] == ["text_cut"] * cut


def test_what_stands_behind_a_nul_is_no_text() -> None:
    message = commands.command_to_ros(wire.Command(1, "Start\x00junk", b"text\x00junk"), to_ros())
    assert (message.name, message.content) == ("Start", "text")


# -- replies ----------------------------------------------------------------------------------------------------------


@table(
    ("status", "expected"),
    [
        *(("SUCCESS", SUCCESS), ("TRUE", SUCCESS), ("OK", SUCCESS), ("ok ", SUCCESS)),
        *(("FAIL", FAIL), ("FALSE", FAIL), ("ERROR", FAIL), ("fail", FAIL)),
    ],
)
def test_status_in_the_metadata(status: str, expected: int) -> None:
    message = reply('<CommandReply Status="FAIL"/>', Status=status, ErrorMessage="why")
    assert (message.status, message.error_message) == (expected, "why" if expected == FAIL else "")
    assert message.metadata == items(Status=status, ErrorMessage="why")


def test_a_status_that_nobody_knows_is_no_success() -> None:
    to = to_ros(Status="PARTLY")
    assert commands.reply_to_ros(wire.Command.of(5, "Start", ""), to).status == FAIL
    assert [code for code, _ in to.warnings] == ["unknown_status"]


@pytest.mark.parametrize(
    ("pairs", "why"),
    [
        ({"Message": "m", "Error": "e", "ErrorMessage": "em"}, "em"),
        ({"Message": "m", "Error": "e"}, "e"),
        ({"Message": "m", "ErrorMessage": ""}, "m"),
        ({}, ""),
    ],
)
def test_why_a_command_failed(pairs: dict[str, str], why: str) -> None:
    assert reply(Status="FAIL", **pairs).error_message == why


@table(
    ("text", "status", "why"),
    [
        ("", SUCCESS, ""),
        ("Status=FAIL", SUCCESS, ""),
        ('<CommandReply Name="a" Status="SUCCESS" Message="done" />', SUCCESS, ""),
        ('<CommandReply Name="a" Status="FAIL" Message="no &lt;file&gt; &quot;a&apos;" />', FAIL, "no <file> \"a'"),
        (" <?xml version='1.0'?>\n<CommandReply\n Status = 'FAIL'\n Message='a > b'></CommandReply>", FAIL, "a > b"),
        ('<CommandReplyX Status="FAIL"/>', SUCCESS, ""),
        ('<Other><CommandReply Status="FAIL"/></Other>', SUCCESS, ""),
        ('<CommandReply Note="Status=&quot;FAIL&quot;" Status="SUCCESS"/>', SUCCESS, ""),
        ('<CommandReply Status="FAIL"', SUCCESS, ""),
    ],
)
def test_status_in_the_xml_of_plus(text: str, status: int, why: str) -> None:
    message = reply(text)
    assert (message.status, message.error_message, message.content) == (status, why, text)


def test_a_reply_much_longer_than_the_library_writes_is_not_searched() -> None:
    def padded(size: int) -> str:
        start, end = '<CommandReply Status="FAIL" Message="', '"/>'
        return start + "x" * (size - len(start) - len(end)) + end

    assert reply(padded(1 << 20)).status == FAIL
    assert reply(padded((1 << 20) + 1)).status == SUCCESS


@pytest.mark.parametrize(
    "text",
    [
        "<CommandReply " * 100_000,
        "<CommandReply" + " " * 1_000_000,
        '<CommandReply a="' * 100_000,
        "<CommandReply" + " a=''" * 200_000,
        " " * 1_000_000 + "<?xml" * 100_000,
        "<CommandReply " + "a" * 1_000_000,
    ],
)
def test_no_text_takes_long_to_read(text: str) -> None:
    """Anything but linear time would take minutes."""
    with quick():
        assert reply(text).status == SUCCESS


def test_a_success_there_and_back() -> None:
    content = wire.Command.of(5, "Start", XML)
    message = commands.reply_to_ros(content, to_ros(Result="42"))
    assert message.link == 4
    assert (message.id, message.name, message.device_name, message.content) == (5, "Start", "Server", XML)
    outgoing = commands.reply_to_igtl(CommandReply.unpack(message.pack()), ToIgtlContext())
    assert sent(outgoing) == content
    assert (outgoing.igtl_type, outgoing.device_name, outgoing.link) == ("RTS_COMMAND", "Server", 4)
    assert outgoing.metadata == (*items(Result="42"), MetadataItem("Status", 0, "SUCCESS"))


@pytest.mark.parametrize("status", [FAIL, CommandReply.TIMEOUT, CommandReply.NO_PEER, 0])
def test_what_is_no_success_is_a_failure_with_its_reason(status: int) -> None:
    """The result replaces the message's own items under these keys, so that a reply never contradicts itself."""
    pairs = items(Status="SUCCESS", Result="42", ErrorMessage="none")
    message = CommandReply(Header(7, "base"), "Server", 5, "Start", status, "no file", metadata=pairs)
    outgoing = commands.reply_to_igtl(message, ToIgtlContext())
    ours = (MetadataItem("Status", 0, "FAIL"), MetadataItem("ErrorMessage", 0, "no file"))
    assert outgoing.metadata == (*items(Result="42"), *ours)
    back = commands.reply_to_ros(sent(outgoing), replace(to_ros(), metadata=outgoing.metadata))
    assert (back.status, back.error_message) == (FAIL, "no file")


@pytest.mark.parametrize(
    "text, reason",
    [
        ('<CommandReply Name="A" Status="FAIL" Error="No ChannelId." Message=""></CommandReply>', "No ChannelId."),
        ('<CommandReply Name="A" Status="FAIL" Error="No "x" <y>" Message=""></CommandReply>', 'No "x" <y>'),
        ('<CommandReply Name="A" Status="FAIL" Error="" Message="not "x""></CommandReply>', 'not "x"'),
        ('<CommandReply Status="FAIL" Message="busy" />', "busy"),
    ],
)
def test_a_reply_of_plus_with_quotation_marks_is_read(text: str, reason: str) -> None:
    assert commands.reply_result(text, ()) == (CommandReply.FAIL, reason, "")
    success = '<CommandReply Name="A" Status="SUCCESS" Message="file "x""></CommandReply>'
    assert commands.reply_result(success, ()) == (CommandReply.SUCCESS, "", "")
