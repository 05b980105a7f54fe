"""Globs: equal to a regular expression on every pattern, and linear where that one backtracks."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.deidentify.configuration import _BRACES
from igtl_gateway.addons.review.messages import _END
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.globs import MAX_LENGTH, matches
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.convert.names import frames_of
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.tables import table

#: Few characters, so that most pieces of a pattern occur in a name, among them those with a meaning in either language.
_NAMES = st.text("ab/.*?\n[\\", max_size=12)
_GLOBS = st.lists(st.sampled_from(["*", "**", "***", "?", "a", "b", "/", ".", "\n", "[", "\\", "ab"]), max_size=8).map(
    "".join
)


def _expected(glob: str, name: str) -> bool:
    """The same with a regular expression, which may take exponential time."""
    parts = (re.escape(part).replace(r"\*", "[^/]*").replace(r"\?", "[^/]") for part in glob.split("**"))
    return re.compile(".*".join(parts), re.DOTALL).fullmatch(name) is not None


@given(_GLOBS, _NAMES)
def test_as_a_regular_expression(glob: str, name: str) -> None:
    assert matches(glob, name) is _expected(glob, name)


@given(_GLOBS, st.data())
def test_names_that_match(glob: str, data: st.DataObject) -> None:
    """Names made from the pattern, so that most of them match."""
    texts = {"**": "ab/", "*": "ab", "?": "ab"}
    pieces = [
        data.draw(st.text(texts[word], min_size=word == "?", max_size=1 if word == "?" else 4))
        if word in texts
        else word
        for word in re.split(r"(\*\*|\*|\?)", glob)
    ]
    name = "".join(pieces)
    assert matches(glob, name)
    assert _expected(glob, name)
    assert matches(glob, name + "b") is _expected(glob, name + "b")


@table(
    ("glob", "name", "fits"),
    [
        ("/" + "*a" * 60 + "*b", "/" + "a" * 250, False),
        ("/" + "*a" * 60 + "*b", "/" + "a" * 250 + "b", True),
        ("**a" * 60 + "**b", "/a" * 250, False),
        ("/**" + "*a?" * 100 + "/b", "/" + "a" * 1000, False),
        ("/**" + "*a?" * 100 + "/b", "/" + "a" * 1000 + "/b", True),
        ("*" * 999 + "b", "a" * 1000, False),
        ("*a**" * 200 + "b", "a/" * 500, False),
        ("*a?" * 300 + "b", "a" * 1000, False),
    ],
)
def test_patterns_that_backtrack(glob: str, name: str, fits: bool) -> None:
    """A regular expression takes longer than any test for the names that do not fit."""
    assert matches(glob, name) is fits


def test_the_time_of_a_match_is_bounded() -> None:
    """Twice the length is at most four times the work, counted as comparisons of characters."""

    class Name(str):
        steps = 0

        def __iter__(self) -> Iterator[str]:
            for character in super().__iter__():
                Name.steps += 1
                yield character

    for count in (100, 200, 400):
        assert not matches("*a" * count + "b", Name("a" * 2 * count))
        assert Name.steps == 2 * count
        Name.steps = 0


def test_long_names_and_globs() -> None:
    long = "/" + "a" * MAX_LENGTH
    assert matches(long, long)
    assert matches("**", long)
    assert not matches("/*", long)
    assert matches(long + "*", long + "*")
    assert not matches("*" * 2 * MAX_LENGTH, "/a")


@pytest.mark.parametrize(
    ("settings", "place"),
    [
        ({"to_igtl": [{"topic": "/*" + "a" * 2000}]}, "to_igtl[0].topic"),
        ({"to_ros": [{}, {"device": "*" * 2000}]}, "to_ros[1].device"),
        ({"to_ros": [{"type": "?" * 2000}]}, "to_ros[0].type"),
        ({"peers": [{"at": "1" * 2000, "profile": "plus"}]}, "peers[0].at"),
        ({"crtk": [{"arms": "/" + "a" * 2000}]}, "crtk[0].arms"),
        ({"deny_in": ["A" * 2000]}, "deny_in"),
        ({"allow_out": ["A" * 2000]}, "allow_out"),
    ],
)
def test_configurations_name_the_place_of_a_long_glob(settings: dict[str, object], place: str) -> None:
    with pytest.raises(ConfigError, match=rf"^{re.escape(place)}.*: found a glob of 2,00[0-9] characters"):
        Config.from_dict(settings)


_FRAMES = re.compile(r"^([A-Za-z0-9_]+?)To([A-Z0-9][A-Za-z0-9_]*)$")


@given(st.lists(st.sampled_from(["To", "A", "b", "T", "o", "_", "-", "\n", "0"]), max_size=8).map("".join))
def test_frames_as_a_regular_expression(name: str) -> None:
    found = _FRAMES.match(name)
    assert frames_of(name, "base") == ((found[2], found[1]) if found else ("base", name or "unnamed"))


@pytest.mark.parametrize(
    "search",
    [
        lambda: frames_of("ToA" * 300_000 + "-", "base"),
        lambda: _END.sub("", " " * 300_000 + "probe" + " " * 300_000 + "x"),
        lambda: _BRACES.split("{" * 300_000),
    ],
)
def test_searches_in_foreign_text_take_a_pass(search: Callable[[], object]) -> None:
    """An expression that is quadratic takes longer than any test here; the deadline of the test run ends it."""
    assert search()


@pytest.mark.parametrize("verb", ["verify", "slice", "deidentify", "sync"])
def test_a_recorded_configuration_with_a_glob_that_backtracks(verb: str, tmp_path: Path) -> None:
    """Topics of the recording decide the route by this glob; the deadline of the test run ends the old search."""
    config = Config(to_igtl=(ToIgtlRow(topic="/" + "*a" * 40 + "*b"),))
    path, out = tmp_path / "session.mcap", tmp_path / "out.mcap"
    text = b"\0\1\0\0" + b"\x03\0\0\0ab\0\0"
    writer = SessionWriter(path, {"config": json.dumps(config.to_dict())})
    for number in range(1, 4):
        entry = Entry(number, 10**18 + number, Kind.ROS_IN, "/" + "a" * 200, "std_msgs/msg/String", payload=(text,))
        writer.write(entry)
    writer.close({})
    words = {"slice": ["-o", str(out)], "deidentify": ["-o", str(out)]}
    assert main([verb, str(path), *words.get(verb, [])]) == (1 if verb == "sync" else 0)
