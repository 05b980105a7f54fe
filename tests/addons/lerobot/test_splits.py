"""Splits follow demonstrations: no demonstration is in two of them, and none is in no split."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.lerobot.splits import Group, assigned, divided, group_of, ranges_of, splits_of
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import main
from tests.addons.lerobot.sessions import Sent, arm, write_session

RANGES = {"train": "0:2", "val": "2:3", "test": "3:4"}


@pytest.mark.parametrize(
    ("owners", "expected"),
    [
        ([0, 1, 2, 3], {"train": "0:2", "val": "2:3", "test": "3:4"}),
        ([0, 0, 1, 2, 3], {"train": "0:3", "val": "3:4", "test": "4:5"}),  # a gap in the first one
        ([0, 1, 1, 1, 2, 2, 3], {"train": "0:4", "val": "4:6", "test": "6:7"}),
        ([1, 2, 3], {"train": "0:1", "val": "1:2", "test": "2:3"}),  # the first one has no frame
    ],
)
def test_all_episodes_of_a_demonstration_are_in_its_split(owners: list[int], expected: dict[str, str]) -> None:
    assert splits_of(RANGES, 4, owners) == expected


def test_without_splits_all_is_for_training() -> None:
    assert splits_of(None, 2, [0, 0, 1]) == splits_of({}, 2, [0, 0, 1]) == {"train": "0:3"}


@pytest.mark.parametrize(
    ("ranges", "owners", "text"),
    [
        ({"train": "0:3"}, [0, 1, 2, 3], "splits: found 1 of 4 demonstrations in no split, the first is 3"),
        ({"train": "1:4"}, [0, 0, 1, 2, 3], "in no split, the first is 0"),
        ({"train": "0:3", "val": "2:4"}, [0, 1, 2, 3], "splits.val: found demonstration 2, which is in train"),
        ({"train": "0:4", "val": "0:1"}, [0, 1, 2, 3], "splits.val: found demonstration 0, which is in train"),
        ({"train": "0:5"}, [0, 1, 2, 3], "splits.train: found '0:5', expected a range within 0:4, the demonstrations"),
        ({"train": "2:2"}, [0, 1, 2, 3], "splits.train: found '2:2'"),
        ({"train": "0:3", "val": "3:4"}, [0, 1, 2], "splits.val: found no frame in demonstrations 3:4"),
    ],
)
def test_what_is_refused(ranges: dict[str, str], owners: list[int], text: str) -> None:
    with pytest.raises(ConfigError) as error:
        splits_of(ranges, 4, owners)
    assert text in str(error.value)


def test_what_is_divided() -> None:
    assert divided([0, 0, 1, 2, 2, 2]) == {0: [0, 1], 2: [3, 4, 5]}


SHARES = {"train": 0.8, "val": 0.2}


@pytest.mark.parametrize(
    ("splits", "frames", "expected"),
    [
        (None, {"a": 9, "b": 1}, {"a": "train", "b": "train"}),
        (SHARES, {name: 10 for name in "abcdefghij"}, {n: "val" if n in "ch" else "train" for n in "abcdefghij"}),
        (SHARES, {"a": 10, "b": 10}, {"a": "train", "b": "val"}),  # none stays empty
        (SHARES, {"a": 1, "b": 1000, "c": 1}, {"a": "train", "b": "train", "c": "val"}),
        ({"train": ("P0*",), "val": ("P10", "P11")}, {"P01": 1, "P10": 5}, {"P01": "train", "P10": "val"}),
    ],
)
def test_groups_get_splits(splits: Any, frames: dict[str, int], expected: dict[str, str]) -> None:
    groups = [Group(*each) for each in frames.items()]
    assert assigned(splits, groups) == expected
    # those that have a split keep it, whatever comes
    kept = [Group(each.name, each.frames, expected[each.name]) for each in groups]
    more = assigned(splits, [*kept, Group("P02", 7)])
    assert {name: more[name] for name in expected} == expected and more["P02"] in (splits or {"train": 1})


def test_patients_are_a_part_of_the_path() -> None:
    assert group_of("/data/b\udcff.mcap", "") == "b\\udcff"  # bytes that are not UTF-8
    assert group_of("/data/P01/run.mcap", "") == "run" and group_of("/data/P01/run.mcap", "{patient}/*") == "P01"
    assert group_of("/data/P01_2026_a.mcap", "{patient}_*") == "P01"
    assert group_of("/data/2026_P01.mcap", "*_{patient}") == "P01"
    with pytest.raises(ConfigError, match="expected a name like"):
        group_of("/data/run.mcap", "{patient}_*")
    assert ranges_of(["train", "train", "val", "train"]) == {"train": "0:2,3:4", "val": "2:3"}


RECIPE = """\
[dataset]
fps = 20
task = "sew"
measure_lags = false
[episodes]
by = "ranges"
range = [{start = 0, end = 2}, {start = 2, end = 4}, {start = 4, end = 6}]
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ArmToBase"
[[feature]]
name = "action"
next_of = "observation.state"
[splits]
"""


def test_a_gap_does_not_move_the_splits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A camera that stops for half a second in the first demonstration: it stays in train, with both parts."""
    messages: list[Sent] = [
        (0.02 * n, "TRANSFORM/ArmToBase", arm(0.02 * n, 0)) for n in range(300) if not 0.8 < 0.02 * n < 1.3
    ]
    path, recipe, root = write_session(tmp_path / "s.mcap", messages), tmp_path / "r.toml", tmp_path / "set"
    words = ["export", str(path), "--to", "lerobot", "--recipe", str(recipe), "-o", str(root)]
    recipe.write_text(RECIPE + 'train = "0:1"\nval = "1:2"\ntest = "2:3"', "utf-8")
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "note: demonstration 0 has a gap above a tolerance, or is too long: episodes 0 to 1" in out
    assert "splits: train has the episodes 0:2, val has the episodes 2:3, test has the episodes 3:4" in out
    info = json.loads((root / "meta" / "info.json").read_text("utf-8"))
    assert info["splits"] == {"train": "0:2", "val": "2:3", "test": "3:4"} and info["total_episodes"] == 4
    card = (root / "meta" / "SYNCHRONIZATION.md").read_text("utf-8")
    assert "demonstration 0 has a gap, or is too long: episodes 0 to 1" in card and "split val: episodes 2:3" in card
    assert main([*words[:4], "--check", str(root)]) == 0
    capsys.readouterr()
    for splits, text in (
        ('train = "0:1"\nval = "1:2"', "1 of 3 demonstrations in no split, the first is 2"),
        ('train = "0:2"\nval = "1:3"', "splits.val: found demonstration 1, which is in train"),
    ):
        recipe.write_text(RECIPE + splits, "utf-8")
        assert main([*words[:-1], str(tmp_path / "other")]) == 2
        assert text in capsys.readouterr().err and not (tmp_path / "other").exists()


def test_ranges_keep_the_order_of_the_recipe_and_what_has_no_frame_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second range comes first in time, and the arm is still in the third one, and nothing named that."""
    messages: list[Sent] = [(0.02 * n, "TRANSFORM/ArmToBase", arm(0.02 * n, 0)) for n in range(200)]
    path, recipe, root = write_session(tmp_path / "s.mcap", messages), tmp_path / "r.toml", tmp_path / "set"
    ranges = "{start = 2, end = 4}, {start = 0.5, end = 2}, {start = 4.5, end = 6}"
    given = RECIPE.replace("{start = 0, end = 2}, {start = 2, end = 4}, {start = 4, end = 6}", ranges)
    recipe.write_text(given + 'val = "0:1"\ntrain = "1:3"', "utf-8")
    words = ["export", str(path), "--to", "lerobot", "--recipe", str(recipe), "-o", str(root)]
    assert main(words) == 0
    assert "note: demonstrations without a frame: 2, of 3" in capsys.readouterr().out
    info = json.loads((root / "meta" / "info.json").read_text("utf-8"))
    assert info["splits"] == {"val": "0:1", "train": "1:2"}
    lines = (root / "meta" / "episodes.jsonl").read_text("utf-8").splitlines()
    assert [json.loads(line)["length"] for line in lines] == [39, 29]
    assert "* demonstrations without a frame: 2" in (root / "meta" / "SYNCHRONIZATION.md").read_text("utf-8")
    assert main([*words[:4], "--check", str(root)]) == 0
