"""One setting as a row: its names, its type and range, what a word means, and settings without effect."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.setting import Setting, by_name, changed, check_effect, grouped, unknown
from tests.tables import table

COUNT = Setting("max_clients", 8, "how many", least=1, most=100, metavar="N")
TIME = Setting("stall_s", 5.0, "how long", least=0, open_ends=True, unit="s")
SHARE = Setting("share", 0.5, "how much", least=0, most=1, open_ends=True)
FLAG = Setting("watch", False, "whether", option="--no-watch")
WORD = Setting("mode", "a", "which", choices=("a", "b", ""))
LIST = Setting("deny_in", (), "what")
MAYBE = Setting("age_s", None, "how old", kind=float, least=0)


def even(text: str) -> object:
    if len(text) % 2:
        raise ConfigError(f"found {text!r}, expected an even number of characters")
    return text


READ = Setting("pairs", ("ab",), "which", reads=even)


@table(
    ("row", "value", "found"),
    [
        (COUNT, 1, 1), (COUNT, 100, 100), (TIME, 1e-300, 1e-300), (TIME, 7, 7.0), (SHARE, 0.999, 0.999),
        (FLAG, True, True), (WORD, "b", "b"), (WORD, "", ""), (LIST, [], ()), (LIST, ["a", ""], ("a", "")),
        (LIST, ("a",), ("a",)), (MAYBE, None, None), (MAYBE, 0, 0.0), (READ, ["ab", "cdef"], ("ab", "cdef")),
        (READ, [], ()),
    ],
)  # fmt: skip
def test_values_that_fit(row: Setting, value: object, found: object) -> None:
    assert row.check(value) == found and type(row.check(value)) is type(found)


@table(
    ("row", "value", "text"),
    [
        (COUNT, 0, "found 0, expected 1 to 100"),
        (COUNT, 101, "found 101, expected 1 to 100"),
        (COUNT, True, "found True, expected an integer"),
        (COUNT, 1.0, "found 1.0, expected an integer"),
        (COUNT, None, "found None, expected an integer"),
        (TIME, 0.0, "found 0, expected more than 0"),
        (TIME, math.inf, "found inf, expected more than 0"),
        (TIME, math.nan, "found nan, expected more than 0"),
        (TIME, 1 << 63, f"found {1 << 63}, expected a number"),
        (TIME, "5", "found '5', expected a number"),
        (SHARE, 1.0, "found 1, expected more than 0 and less than 1"),
        (MAYBE, -0.5, "found -0.5, expected 0 or more"),
        (FLAG, 1, "found 1, expected true or false"),
        (FLAG, "true", "found 'true', expected true or false"),
        (WORD, "c", "found 'c', expected one of a, b"),
        (WORD, None, "found None, expected a string in quotes"),
        (LIST, "a", 'found \'a\', expected strings such as ["a", "b"]'),
        (LIST, ["a", 1], "found ['a', 1], expected strings such as"),
        (READ, ["ab", "abc"], "found 'abc', expected an even number of characters"),
    ],
)
def test_values_that_do_not(row: Setting, value: object, text: str) -> None:
    with pytest.raises(ConfigError) as error:
        row.check(value)
    assert str(error.value).startswith(text)


@table(
    ("row", "text"),
    [
        (COUNT, "1 to 100"), (TIME, "more than 0"), (SHARE, "more than 0 and less than 1"), (MAYBE, "0 or more"),
        (FLAG, ""), (Setting("a", 1, "b", least=0.001, most=31_536_000), "0.001 to 31536000"),
    ],
)  # fmt: skip
def test_ranges_for_people(row: Setting, text: str) -> None:
    assert row.range_text == text


def test_names_of_options() -> None:
    assert (COUNT.flag, COUNT.usage) == ("--max-clients", "--max-clients N")
    assert (FLAG.flag, FLAG.usage) == ("--no-watch", "--no-watch")
    assert Setting("a", 1, "b", option="").flag == ""
    assert WORD.usual == ("a", "b") and LIST.is_list and not WORD.is_list
    assert (MAYBE.type, LIST.type, COUNT.type) == (float, tuple, int)


@table(
    ("row", "word", "value"),
    [
        (COUNT, "7", 7), (TIME, "7", 7.0), (TIME, "1e3", 1000.0), (WORD, "b", "b"), (LIST, "x", "x"),
        (READ, "ab", "ab"), (MAYBE, "2.5", 2.5),
    ],
)  # fmt: skip
def test_words_of_the_command_line(row: Setting, word: str, value: object) -> None:
    assert row.parse(word) == value and type(row.parse(word)) is type(value)


@table(
    ("row", "word", "text"),
    [
        (COUNT, "7.5", "found 7.5, expected an integer"),
        (COUNT, "seven", "found 'seven', expected an integer"),
        (COUNT, "", "found '', expected an integer"),
        (TIME, "nan", "found nan, expected more than 0"),
        (WORD, "c", "found 'c', expected one of a, b"),
        (READ, "abc", "expected an even number of characters"),
    ],
)
def test_words_that_mean_nothing(row: Setting, word: str, text: str) -> None:
    with pytest.raises(ConfigError) as error:
        row.parse(word)
    assert text in str(error.value)


@given(st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.lists(st.text() | st.integers()))
def test_any_value_is_of_the_type_or_refused_in_one_line(value: Any) -> None:
    for row in (COUNT, TIME, SHARE, FLAG, WORD, LIST, MAYBE):
        try:
            found = row.check(value)
        except ConfigError as error:
            assert str(error).startswith("found ") and ", expected " in str(error)
        else:
            assert type(found) is row.type or (row is MAYBE and found is None)


def test_unknown_names() -> None:
    assert unknown("deny_inn", ["deny_in", "watch"]) == (
        "unknown setting, expected one of deny_in, watch; did you mean 'deny_in'?"
    )
    assert unknown("x", ["deny_in", "watch"]) == "unknown setting, expected one of deny_in, watch"


def test_tables() -> None:
    rows = by_name(grouped("peers", COUNT, WORD))
    assert list(rows) == ["max_clients", "mode"] and {row.group for row in rows.values()} == {"peers"}
    assert COUNT.group == ""
    assert changed(rows, {"max_clients": 8, "mode": "b"}) == ["mode"]


NEEDY = by_name(
    (
        Setting("record", "", "where", metavar="FILE"),
        Setting("compression", "lz4", "how", needs=("record",)),
        Setting("fsync", 0.0, "when", needs=("record",)),
        Setting("tf", False, "whether", needs=("ROS",)),
        Setting("hidden", 1, "what", option="", needs=("record",)),
    )
)


def effect(*names: str, **values: object) -> str:
    """Why settings have no effect; "" if all have one."""
    given_ = {name: row.default for name, row in NEEDY.items()} | values
    try:
        check_effect(NEEDY, given_, names, {"ROS": bool(values.get("ros"))}, {"ROS": "found no ROS"})
    except ConfigError as error:
        return str(error)
    return ""


def test_settings_without_what_they_need_have_no_effect() -> None:
    assert effect("compression") == "--compression: found no --record FILE, expected it: the option has no effect here"
    assert effect("compression", "fsync", "compression").startswith("--compression and --fsync: found no --record FILE")
    assert effect("hidden").startswith("hidden: found no --record FILE")
    assert effect("tf") == "--tf: found no ROS: the option has no effect here"
    assert effect("tf", ros=True) == effect("compression", "fsync", record="a.mcap") == ""
    assert effect("record") == effect() == effect("other") == ""
