"""Names near to a word: streams that a glob may mean."""

from __future__ import annotations

import pytest

from igtl_gateway.base.near import near_streams, unmatched, without_match
from tests.tables import table

STREAMS = [
    "TRANSFORM/ToolToBase",
    "TRANSFORM/ProbeToTracker",
    "IMAGE/Image",
    "/tool",
    "/joint_states",
    "/igtl/in/A/image",
]


@table(
    "glob, near",
    [
        ("TRANSFORM/TolToBase", ["TRANSFORM/ToolToBase"]),
        ("ToolToBas", ["TRANSFORM/ToolToBase"]),
        ("transform/tooltobase", ["TRANSFORM/ToolToBase"]),
        ("Probe", ["TRANSFORM/ProbeToTracker"]),
        ("/tol", ["/tool"]),
        ("/robot/joint_states", ["/joint_states"]),
        ("joint_states", []),  # no topic: it has no "/"
        ("Unlike", []),
        ("*", []),
        ("/", []),
    ],
)
def test_the_streams_that_a_glob_may_mean(glob: str, near: list[str]) -> None:
    assert near_streams(glob, STREAMS) == near


@table(
    "globs, without",
    [
        (["TRANSFORM/*", "Image"], []),
        (["/tol", "/tool"], ["/tol"]),
        (["in/A/image"], ["in/A/image"]),  # no device of a topic
        (["**"], []),
    ],
)
def test_globs_without_a_stream(globs: list[str], without: list[str]) -> None:
    assert without_match(globs, STREAMS) == without


@pytest.mark.parametrize(
    ("glob", "text"), [("/tol", "matches no topic; did you mean '/tool'?"), ("Q", "matches no topic")]
)
def test_the_sentence(glob: str, text: str) -> None:
    assert unmatched(glob, STREAMS, "topic") == text
