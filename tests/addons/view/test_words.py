"""Words: at their topic, and as a line of the session's log."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.convert import igtl_msgs
from igtl_gateway.convert.common_msgs import Log
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header, String
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests import exchanges

from .conftest import Draw, without_time

HEADER = Header()


def test_a_text_is_a_document_and_a_line(draw: Draw) -> None:
    drawn = draw(String("stitch 3\nof 11"))
    assert drawn.one("topic")["TextDocument:text"] == ["stitch 3\nof 11"]
    assert drawn.log() == ["/topic: stitch 3 of 11"]


def test_a_long_text_is_whole_in_its_document_and_short_in_the_log(draw: Draw) -> None:
    drawn = draw(String("word " * 1000))
    assert drawn.one("topic")["TextDocument:text"] == ["word " * 1000]
    (line,) = drawn.log()
    assert len(line) < 400


@pytest.mark.parametrize(("level", "shown"), [(0, "INFO"), (1, "WARN"), (2, "ERROR"), (3, "WARN"), (9, "WARN")])
def test_a_status_has_its_level(level: int, shown: str, draw: Draw) -> None:
    drawn = draw(DiagnosticStatus(level, "Robot", "not ready"))
    (row,) = drawn.rows("session/log")
    assert (row["TextLog:level"], without_time(row["TextLog:text"][0])) == ([shown], "/topic: Robot not ready")


@pytest.mark.parametrize(("level", "shown"), [(10, "INFO"), (20, "INFO"), (30, "WARN"), (40, "ERROR"), (50, "ERROR")])
def test_what_nodes_log_is_in_the_log(level: int, shown: str, draw: Draw) -> None:
    drawn = draw(Log(0, level, "talker", "Publishing"))
    (row,) = drawn.rows("session/log")
    assert (row["TextLog:level"], without_time(row["TextLog:text"][0])) == ([shown], "/topic: talker: Publishing")


def test_a_reply_that_failed_is_a_warning(draw: Draw) -> None:
    drawn = draw(
        igtl_msgs.CommandReply(HEADER, "Robot", 7, "Move", igtl_msgs.CommandReply.TIMEOUT, "no answer"),
        igtl_msgs.CommandReply(HEADER, "Robot", 8, "Move", igtl_msgs.CommandReply.SUCCESS, content="<ok/>"),
    )
    assert [row["TextLog:level"] for row in drawn.rows("session/log")] == [["WARN"], ["INFO"]]
    assert "reply to 7 'Move': no reply in time no answer" in drawn.log()[0]


def test_lists_name_what_is_in_them(draw: Draw) -> None:
    image = igtl_msgs.ImageMeta("T1", "Head", "MR", "Jane Doe", "123", 0, (256, 256, 180), 5)
    drawn = draw(igtl_msgs.ImageMetaList(HEADER, (image,)))
    (document,) = drawn.one("topic")["TextDocument:text"]
    assert "T1 (Head) 256 x 256 x 180" in document
    assert "Jane" not in document  # a picture that is shown around names no patient


def test_services_and_actions_are_lines(draw: Draw, tmp_path: Path) -> None:
    """A call step by step, and the states of goals; an aborted one is a warning."""
    with SessionFile.open(exchanges.write(tmp_path / "a.mcap")) as file:
        drawn = draw(entries=file.entries())
    assert not drawn.view.counts.without_picture and not drawn.view.counts.refused
    rows = {row["TextLog:text"][0][13:]: row["TextLog:level"][0] for row in drawn.rows("session/log")}
    assert rows["/arm/enable/_service_event: server sends response 1"] == "INFO"
    assert rows["/fib/_action/feedback: goal 03030303 has feedback"] == "INFO"
    assert rows["/fib/_action/status: goal 03030303 goes on"] == "INFO"
    assert rows["/fib/_action/status: goal 09090909 aborted"] == "WARN"
