"""Names as entity paths, and trees of frames."""

from __future__ import annotations

import pytest

from igtl_gateway.addons.view.contents import EntityKind, SessionContents, ShownTopic, path_of


@pytest.mark.parametrize(
    ("topic", "path"),
    [
        ("/star/cloud", "star/cloud"),
        ("TRANSFORM/ToolToBase", "TRANSFORM/ToolToBase"),
        ("/a b/ü#", "a_b/__"),
        ("STATUS/", "STATUS"),
        ("//", "unnamed"),
    ],
)
def test_paths_need_no_escapes(topic: str, path: str) -> None:
    assert path_of(topic) == path


def test_frames_that_go_in_a_circle_have_a_root_all_the_same() -> None:
    seen = SessionContents(parents={"a": "b", "b": "a", "c": "a"})
    assert seen.root_of("c") in {"a", "b"}


def test_the_tree_with_the_most_to_see_comes_first() -> None:
    seen = SessionContents(
        "world",
        {
            "/pose": ShownTopic("pose", "/pose", "t", EntityKind.POSE, "tracker", count=1),
            "/cloud": ShownTopic("cloud", "/cloud", "t", EntityKind.CLOUD, "camera", count=1),
            "/text": ShownTopic("text", "/text", "t", EntityKind.TEXT, "nowhere", count=1),
        },
        {"camera": "base"},
    )
    assert {root: [shown.path for shown in tree] for root, tree in seen.trees().items()} == {
        "base": ["cloud"],
        "tracker": ["pose"],
    }
    assert seen.root == "base"
    seen.frames = {"camera": "frames/camera", "probe": "frames/probe"}
    assert seen.frames_of("base") == ["frames/camera"]
