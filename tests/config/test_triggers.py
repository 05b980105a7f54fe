"""Rules of the black box as text and as tables: what they mean, and what is refused with its place."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.triggers import KINDS, MAX_WINDOW_S, Trigger, text_of_table, trigger
from tests.tables import table


@table(
    ("text", "error"),
    [
        ("mrak=a", "kind: found 'mrak', expected one of guard, .*; did you mean 'mark'"),
        ("value=/a", "kind: found value, expected field with it, and below or above"),
        ("value,field=a,above=1", "pattern: found none, expected a glob of the topic with kind value"),
        ("mark=a,after=x", "after: found 'x', expected a number"),
        ("mark=a,after=nan", "after: found 'nan', expected a number"),
        ("mark=a,before=-1", "before: found -1, expected 0 to 3600 s"),
        ("mark=a,foo=1", "found 'foo=1' in 'mark=a,foo=1', expected one each of field=, before="),
        ("mark=a,after=1,after=2", "found 'after=2'"),
        ("mark=a,above=1", "kind: found mark with field, below or above, expected value with them"),
        ("value=/a,field=b,below=2,above=1", "below: found 2, expected less than above, 1"),
    ],
)
def test_a_wrong_rule(text: str, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        trigger(text)


@table(
    ("row", "error"),
    [
        ({}, "t: found no kind"),
        ({"kind": "mark", "bfore": 1}, "t.bfore: unknown setting, .*; did you mean 'before'"),
        ({"kind": "mark", "before": "1"}, "t.before: found '1', expected a number"),
        ({"kind": "mark", "pattern": 1}, "t.pattern: found 1, expected a string"),
        ({"kind": "note"}, "t.pattern: found none"),
        ("mark", r"t: found 'mark', expected a table \[\[trigger\]\]"),
    ],
)
def test_a_wrong_table(row: object, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        text_of_table(row, "t")


def test_a_table_is_its_text() -> None:
    row = {"kind": "value", "pattern": "/f", "field": "a.b", "above": 5, "before": 2.5}
    assert trigger(text_of_table(row, "t")) == Trigger("value", "/f", 2.5, field="a.b", above=5.0)
    assert trigger(text_of_table({"kind": "guard"}, "t")) == Trigger("guard")


@table(
    ("text", "rule"),
    [
        ("guard", Trigger("guard", "**")),
        (" mark = slip* , after = 5 ", Trigger("mark", "slip*", after_s=5.0)),
        ("operating_state", Trigger("operating_state", "/**/operating_state")),
        ("link_down=1.2.*,before=0,after=0", Trigger("link_down", "1.2.*", 0.0, 0.0)),
        ("value=/f,field=a[2].b,below=-1e3", Trigger("value", "/f", field="a[2].b", below=-1000.0)),
        ("note=bad_crc,after=3600", Trigger("note", "bad_crc", after_s=MAX_WINDOW_S)),
    ],
)
def test_what_a_text_means(text: str, rule: Trigger) -> None:
    assert trigger(text) == rule
    assert rule.after_s == 10.0 or "after" in text


@table(
    ("text", "error"),
    [
        ("", "kind: found '', expected one of guard, link_down"),
        ("note", "pattern: found none, expected a glob of the code with kind note"),
        ("note=bad_crd", "expected the code of a note, or a glob of codes; did you mean 'bad_crc'"),
        ("mark,after=3601", "after: found 3601, expected 0 to 3600 s"),
        ("mark,before=inf", "before: found 'inf', expected a number"),
        ("mark,pattern=a", "found 'pattern=a'"),
        ("mark,after", "found 'after' in 'mark,after'"),
        ("value=/a,above=1", "expected field with it"),
        ("value=/a,field=b", "and below or above"),
        ("value=/a,field=b,below=1,above=1", "below: found 1, expected less than above, 1"),
        ("status,field=b", "kind: found status with field"),
        ("status,below=0", "kind: found status with field, below or above"),
    ],
)
def test_more_wrong_rules(text: str, error: str) -> None:
    with pytest.raises(ConfigError) as raised:
        trigger(text)
    assert error in str(raised.value)


@table(
    ("row", "error"),
    [
        ({"kind": "mark", "after": True}, "t.after: found True, expected a number"),
        ({"kind": "mark", "pattern": "a,b"}, "t.pattern: found 'a,b', expected a string in quotes without a comma"),
        ({"kind": "mark", "before": 10**400}, "t.before: found 1000"),
        ({"kind": "mark", "after": float("nan")}, "t.after: found nan, expected a number"),
        (["mark"], "t: found ['mark'], expected a table [[trigger]]"),
    ],
)
def test_more_wrong_tables(row: object, error: str) -> None:
    with pytest.raises(ConfigError) as raised:
        text_of_table(row, "t")
    assert str(raised.value).startswith(error)


def test_a_rule_is_shown_without_its_usual_pattern() -> None:
    assert str(trigger("guard")) == "guard"
    assert str(trigger("guard=*/b")) == "guard */b"
    assert str(trigger("operating_state=/PSM1/operating_state")) == "operating_state /PSM1/operating_state"


def test_kinds_with_a_pattern_of_topics_are_recorded_therefore() -> None:
    assert {name: row.topics.format("/a*") for name, row in KINDS.items() if row.topics} == {
        "diagnostics": "/diagnostics",
        "operating_state": "/a*",
        "action_aborted": "/a*/_action/**",
        "value": "/a*",
    }
    assert {name for name, row in KINDS.items() if row.only_ros} == {"diagnostics", "action_aborted"}
    assert {name for name, row in KINDS.items() if not row.pattern} == {"value", "note"}
