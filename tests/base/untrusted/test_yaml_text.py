"""YAML of others: values as the library reads them, and documents that would cost too much."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted.yaml_text import parse_yaml
from tests.tables import table
from tests.timing import quick

GOOD = """\
rosbag2:   # what rosbag2 writes
  version: 5
  names: ["a", b, 'c d']
  empty: ~
  qos: "- history: 3\\n  depth: 0"
  text: |
    two
    lines
  list:
    - name: /x
      count: 3
    - {name: /y, count: 4}
"""
HOSTILE = {
    "billion laughs": "a0: &a [x]\n" + "".join(f"a{i}: &a [{', '.join(['*a'] * 9)}]\n" for i in range(9)),
    "an alias of itself": "a: &a {b: *a}",
    "merge": "a: &a {x: 1}\nb: {<<: *a}",
    "a tag": "a: !!python/object/apply:os.system ['true']",
    "a tag of our own": "a: !foo bar",
    "brackets": "[" * 100_000,
    "braces": "{a: " * 5_000,
    "lists": "- " * 100_000,
    "keys": "? " * 100_000,
    "indents": "".join(" " * i + "a:\n" for i in range(900)),
    "a list as key": "? [a, b]\n: c\n",
    "much text": "a: " + "x" * 600_000,
    "many nodes": "[" + "x," * 250_000 + "]",
    "control characters": "a: \x00\x01",
    "unclosed": "a: [",
    "unquoted": 'a: "',
    "percent": "%YAML 9.9\n--- a",
    "a tab": "a:\n\t- b",
}  # fmt: skip


def test_values_stay_texts() -> None:
    assert parse_yaml(GOOD, "x.yaml") == {
        "rosbag2": {
            "version": "5",
            "names": ["a", "b", "c d"],
            "empty": "~",
            "qos": "- history: 3\n  depth: 0",
            "text": "two\nlines\n",
            "list": [{"name": "/x", "count": "3"}, {"name": "/y", "count": "4"}],
        }
    }
    assert parse_yaml("", "x.yaml") is None
    assert parse_yaml("only a string", "x.yaml") == "only a string"


@table("text", HOSTILE.values(), ids=HOSTILE)
def test_hostile_documents_are_refused_at_once(text: str) -> None:
    with quick(), pytest.raises(DamagedRecording, match=r"^x\.yaml: ") as found:
        parse_yaml(text, "x.yaml")
    assert len(str(found.value)) < 300


def test_what_is_above_the_limits_says_so() -> None:
    with pytest.raises(LimitExceeded, match=r"x\.yaml: found 65, expected at most 64 \(--limit depth=64\)"):
        parse_yaml("[" * 70 + "]" * 70, "x.yaml")
    with pytest.raises(LimitExceeded, match=r"x\.yaml: line 65: found 65, expected at most 64 \(--limit depth=64\)"):
        parse_yaml("".join(" " * i + "a:\n" for i in range(70)), "x.yaml")
    with pytest.raises(LimitExceeded, match="--limit document=524288"):
        parse_yaml(HOSTILE["much text"], "x.yaml")
