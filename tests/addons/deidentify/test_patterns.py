"""Patterns of a profile: as those of ``re``, and bounded in time."""

from __future__ import annotations

import re

import pytest

from igtl_gateway.addons.deidentify import patterns
from igtl_gateway.addons.deidentify.profile import TextRule
from igtl_gateway.base.errors import ConfigError
from tests.timing import at_once


@pytest.fixture(autouse=True)
def _ended() -> object:
    yield
    patterns.close()


@pytest.mark.parametrize("text", ["", "Anna Meier, Bo Li", "\udcff\0\n\r\u2028Anna Meier\n", "ä" * 100_000])
def test_the_new_text_is_that_of_python(text: str) -> None:
    for pattern, by in (("[A-Z][a-z]+ [A-Z][a-z]+", r"\1\g<0>"), (r"\s", ""), ("$", "x"), ("(?i)ANNA", "\udcff\n")):
        expected = by.join(re.split(pattern, text))
        assert TextRule("**", "pattern", by, pattern).apply(text) == expected


def test_a_pattern_that_does_not_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patterns, "MOST_S", 0.3)
    with at_once(), pytest.raises(ConfigError, match=r"pattern '\(a\+\)\+\$': found text of 61 characters"):
        patterns.replaced("(a+)+$", "", "a" * 60 + "!")
    monkeypatch.undo()
    assert patterns.replaced("a", "b", "aa") == "bb"  # the next one has a new process


def test_a_process_that_was_killed_is_named_and_replaced() -> None:
    assert patterns.replaced("a", "b", "a") == "b"
    patterns._processes[0].kill()
    patterns._processes[0].wait()
    with pytest.raises(Exception, match="found an end of the process"):
        patterns.replaced("a", "b", "a")
    assert patterns.replaced("a", "b", "a") == "b"
