"""Lines and tables that fit into the columns of a terminal."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.cli.layout import table, wrapped
from igtl_gateway.cli.terminal import columns, print_line

WORDS = st.text("abc.,", min_size=1, max_size=18)


@given(st.lists(WORDS, min_size=1, max_size=40), st.integers(0, 12), st.integers(40, 120))
def test_a_line_keeps_its_words_and_its_width(words: list[str], indent: int, room: int) -> None:
    line = " " * indent + " ".join(words)
    lines = wrapped(line, room)
    assert all(len(each) <= room for each in lines)
    assert " ".join(lines).split() == words
    assert lines[0].startswith(" " * indent) and all(each.startswith(" " * (indent + 1)) for each in lines[1:])


def test_what_follows_a_key_or_a_mark_stands_below_it() -> None:
    assert wrapped("  units     mm in OpenIGTLink, m in ROS; base frame 'base'", 40) == [
        "  units     mm in OpenIGTLink, m in ROS;",
        "            base frame 'base'",
    ]
    assert wrapped("? the stamps of the stream are those of another session", 40) == [
        "? the stamps of the stream are those of",
        "  another session",
    ]


def test_paths_numbers_and_commands_stay_together() -> None:
    path = "/data/" + "x" * 60
    assert wrapped(f"found {path}, expected another", 40) == [
        f"found {path},"[:5],
        f"    {path},",
        "    expected another",
    ]
    assert wrapped("the messages arrive up to a mean of 12.5 ms late", 40) == [
        "the messages arrive up to a mean of", "    12.5 ms late",
    ]  # fmt: skip
    assert wrapped("the index is damaged; run: igtl-gateway recover out.mcap", 50) == [
        "the index is damaged; run:", "    igtl-gateway recover out.mcap",
    ]  # fmt: skip


def test_a_command_that_does_not_fit_goes_on_behind_a_backslash() -> None:
    words = "igtl-gateway replay out.mcap --to igtl --connect 127.0.0.1:18944 --streams 'TRANSFORM/*'"
    lines = wrapped(f"run: {words}", 60)
    assert all(len(each) <= 60 for each in lines) and all(each.endswith(" \\") for each in lines[1:-1])
    assert " ".join(each.strip().removesuffix("\\").strip() for each in lines) == f"run: {words}"


def test_columns_without_room_stand_below() -> None:
    rows = [("stream", "messages", "note"), ("/igtl/in/Probe/image", "12", "sensor_msgs/msg/Image, recorded in parts")]
    wide = table(rows, 0, left=1, indent="", widest=72, text=True)
    assert [len(line.split("  ")) >= 3 for line in wide] == [True, True]
    narrow = table(rows, 40, left=1, indent="", widest=72, text=True)
    assert all(len(line) <= 40 for line in narrow) and narrow[2].startswith("    sensor_msgs")
    long_name = table([("a", "n"), ("/x" * 30, "1"), ("/y", "2")], 40, left=1, indent="", widest=72)
    assert long_name[1] == "/x" * 30 and long_name[2].strip() == "1" and long_name[3].split() == ["/y", "2"]


@pytest.mark.parametrize(("stated", "report", "log"), [("", 80, 0), ("60", 60, 60), ("7", 40, 40), ("wide", 80, 0)])
def test_the_columns_of_a_pipe(
    stated: str, report: int, log: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", stated)
    assert (columns(), columns(log=True)) == (report, log)
    print_line("word " * 100, log=True)
    print_line("word " * 100, error=True)
    told = capsys.readouterr()
    for text in (told.out, told.err):
        assert (max(map(len, text.splitlines())) <= log) if log else len(text.splitlines()) == 1
