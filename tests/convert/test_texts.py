"""STRING and STATUS: strings in every encoding, codes and levels, limits."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import texts
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import DiagnosticStatus
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.wire.text import CODES, Status, String
from tests.tables import table

TO = ToRosContext("Robot", 0, "", "")


@pytest.mark.parametrize(
    ("content", "text"),
    [(String(b"abc"), "abc"), (String("é".encode(), 106), "é"), (String(b"\xe9", 4), "é"), (String(b"\xff"), "\ufffd")],
)
def test_string_to_ros(content: String, text: str) -> None:
    assert texts.string_to_ros(content, TO) == RosString(text)


@pytest.mark.parametrize(("text", "encoding"), [("abc", 3), ("é", 106), ("", 3)])
def test_string_to_igtl(text: str, encoding: int) -> None:
    content = texts.string_to_igtl(RosString(text), ToIgtlContext()).content
    assert content == String(text.encode(), encoding)
    assert isinstance(content, String)
    assert texts.string_to_ros(content, TO).data == text


def test_the_longest_string() -> None:
    """The original silently lost a string of 70,000 bytes."""
    content = texts.string_to_igtl(RosString("x" * 65535), ToIgtlContext()).content
    assert sum(memoryview(part).nbytes for part in content.pack()) == 65539
    for text in ("x" * 65536, "é" * 32768):
        with pytest.raises(ConversionError, match="65535"):
            texts.string_to_igtl(RosString(text), ToIgtlContext())


@table(("code", "level"), [(1, 0), (6, 1), (13, 1), (14, 1), (15, 1), (19, 1), (0, 2), (2, 2), (65535, 2)])
def test_levels(code: int, level: int) -> None:
    message = texts.status_to_ros(Status(code), TO)
    assert message.level == level
    assert message.message == (CODES[code] if code < len(CODES) else "")
    assert message.name == "Robot"


def test_status_golden() -> None:
    message = texts.status_to_ros(Status(10, -5, "E\x00rest", "bad \udcff"), TO)
    values = (("code", "10"), ("subcode", "-5"), ("error_name", "E"))
    assert message == DiagnosticStatus(2, "Robot", "bad \ufffd", "", values)


@pytest.mark.parametrize(
    "status", [Status(1, 0, "", "fine"), Status(65535, -(2**63), "x" * 19, "é"), Status(0, 2**63 - 1)]
)
def test_status_there_and_back(status: Status) -> None:
    back = texts.status_to_igtl(texts.status_to_ros(status, TO), ToIgtlContext()).content
    assert isinstance(back, Status)
    assert (back.code, back.subcode, back.error_name) == (status.code, status.subcode, status.error_name)
    assert back.message == (status.message or (CODES[status.code] if status.code < len(CODES) else ""))
    assert back.nul_terminated


@pytest.mark.parametrize(("level", "code"), [(0, 1), (1, 13), (2, 2), (3, 7), (200, 2)])
def test_foreign_diagnostics(level: int, code: int) -> None:
    message = DiagnosticStatus(level, "driver", "text", "hw", (("temperature", "40"),))
    assert texts.status_to_igtl(message, ToIgtlContext()).content == Status(code, 0, "", "text")


@pytest.mark.parametrize(
    "value",
    [("code", "x"), ("code", "65536"), ("code", "-1"), ("subcode", str(2**63)), ("code", "9" * 5000), ("code", "")],
)
def test_values_that_are_no_codes(value: tuple[str, str]) -> None:
    with pytest.raises(ConversionError):
        texts.status_to_igtl(DiagnosticStatus(0, "", "", "", (value,)), ToIgtlContext())


def test_error_names_are_cut_to_what_readers_accept() -> None:
    message = DiagnosticStatus(0, "", "", "", (("error_name", "é" * 20),))
    to = ToIgtlContext()
    assert texts.status_to_igtl(message, to).content == Status(1, 0, "é" * 9)
    assert [code for code, _ in to.warnings] == ["text_cut"]
