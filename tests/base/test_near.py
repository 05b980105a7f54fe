"""Names near to a word: streams that a glob may mean."""

from __future__ import annotations

import pytest

from igtl_gateway.base.near import near_names, near_streams, one_of, streams_expected, unmatched, without_match
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


@table(
    "word, near",
    [
        ("nrd", ["nrrd"]),
        ("NRRD", ["nrrd"]),
        ("quet", ["parquet"]),
        ("lerobt", ["lerobot"]),
        ("zz", []),
        ("", []),
    ],
)
def test_the_names_that_a_word_may_mean(word: str, near: list[str]) -> None:
    assert near_names(word, ["csv", "nrrd", "parquet", "lerobot", "vtk"]) == near


def test_names_that_are_much_less_like_it_are_left_out() -> None:
    assert near_names("/star/clod", ["/star/cloud", "/star/tool", "/star/plan"]) == ["/star/cloud"]


def test_what_is_expected_in_place_of_a_wrong_name() -> None:
    assert one_of("b12", ["a1", "b1", "c1"]) == "one of a1, b1, c1; did you mean 'b1'?"
    assert one_of("x", ["a1", "b1", "c1"], 2) == "one of a1, b1 and 1 more"
    assert one_of("x", []) == "one of none"
    listed = "expected a recorded stream: igtl-gateway info 'a b.mcap' lists them"
    assert streams_expected(["/tol"], STREAMS, "a b.mcap") == f"{listed}; did you mean '/tool'?"
    assert streams_expected(["Q"], STREAMS, "a b.mcap") == listed
