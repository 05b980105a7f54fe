"""Wrong recipes: one line with place, value found and value expected."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.base.errors import ConfigError
from tests.tables import table

GOOD = {
    "dataset": 'fps = 30\ntask = "sew"',
    "episodes": 'by = "whole"',
    "feature]": 'name = "observation.state"\nstream = "a"',
    "feature] ": 'name = "action"\nnext_of = "observation.state"',
}


def text_of(**changes: str) -> str:
    tables = GOOD | {
        name.replace("feature2", "feature] ").replace("feature1", "feature]"): text for name, text in changes.items()
    }
    return "\n".join(
        f"[[feature]]\n{text}" if name.startswith("feature") else f"[{name}]\n{text}" for name, text in tables.items()
    )


def test_a_good_one(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    path.write_text(text_of(), "utf-8")
    recipe = read_recipe(path)
    assert recipe.names == ["observation.state", "action"] and recipe.has_next


@table(
    ("changes", "text"),
    [
        ({"dataset": 'task = "a"'}, "dataset: found no fps, expected an integer from 1 to 1000"),
        ({"dataset": 'fps = 29.97\ntask = "a"'}, "dataset.fps: found 29.97, expected an integer"),
        ({"dataset": 'fps = true\ntask = "a"'}, "dataset.fps: found True"),
        ({"dataset": 'fps = 0\ntask = "a"'}, "dataset.fps: found 0"),
        ({"dataset": "fps = 30\ntask = 3"}, "dataset.task: found 3, expected a string"),
        ({"dataset": 'fps = 30\ntask = "a\\nb"'}, "dataset.task: found"),
        ({"dataset": 'fps = 30\ntask = "a"\nformat = "v4"'}, "dataset.format: found 'v4', expected one of v2.1, v3.0"),
        ({"dataset": 'fps = 30\ntask = "a"\nfsp = 3'}, "dataset.fsp: unknown key, expected one of fps"),
        ({"data": "a = 1"}, "data: unknown table, expected one of dataset"),
        ({"feature1": 'name = "observation/state"\nstream = "a"'}, "feature[0].name: found 'observation/state'"),
        ({"feature1": 'name = "timestamp"\nstream = "a"'}, "feature[0].name: found 'timestamp'"),
        ({"feature1": 'name = "observation.x"\nstream = "a"'}, "found no feature observation.state"),
        ({"feature1": 'name = "observation.state"'}, "feature[0] (observation.state): found no stream"),
        ({"feature1": GOOD["feature]"] + "\ntolerance_ms = 0"}, "feature[0].tolerance_ms: found 0, expected a number"),
        ({"feature1": GOOD["feature]"] + "\ntolerance_ms = nan"}, "feature[0].tolerance_ms: found nan"),
        (
            {"feature1": GOOD["feature]"] + '\nrule = "cubic"'},
            "feature[0].rule: found 'cubic', expected one of nearest",
        ),
        ({"feature1": GOOD["feature]"] + '\nrule = "none"\ntolerance_ms = 50'}, 'tolerance_ms with rule = "none"'),
        ({"feature1": GOOD["feature]"] + '\nrule = "none"\nfill = "hold"'}, 'tolerance_ms with rule = "none"'),
        (
            {
                "feature1": GOOD["feature]"]
                + '\n[[feature]]\nname = "observation.images.a"\nstream = "a"\nnative = true'
            },
            "feature[1] (observation.images.a).native: found it for a picture",
        ),
        ({"feature1": GOOD["feature]"] + '\nlag = "measured"'}, 'expected lag = "measured" with against'),
        (
            {"feature1": GOOD["feature]"] + "\nwindow = [3, 1]"},
            "feature[0].window: found [3, 1], expected two increasing",
        ),
        ({"feature1": GOOD["feature]"] + "\nfields = [1]"}, "feature[0].fields: found [1], expected names of columns"),
        ({"feature2": 'name = "action"\nnext_of = "action"'}, "feature[1] (action).next_of: found 'action'"),
        ({"feature2": 'name = "action"\nnext_of = "observation.state"\nfps = 3'}, "feature[1].fps: unknown key"),
        ({"episodes": 'by = "markers"'}, "episodes.stream: found '', expected one for markers"),
        ({"episodes": 'by = "ranges"'}, "episodes.range: found 0 ranges"),
        (
            {"episodes": 'by = "ranges"\nrange = [{start = 2, end = 1}]'},
            "episodes.range[0].end: found 1, expected more",
        ),
        ({"episodes": 'by = "ranges"\nrange = [{start = 2}]'}, "episodes.range[0]: found no end, expected a number"),
        (
            {"episodes": 'by = "ranges"\nrange = [{start = 2, end = 4}, {start = 1, end = 2.5}]'},
            "episodes.range[0].start: found 2, expected 2.5 or more: no frame is in two demonstrations",
        ),
        ({"splits": 'train = "all"'}, "splits.train: found 'all', expected a share"),
        ({"splits": "train = 3"}, "splits.train: found 3, expected a share"),
        ({"card": "license = []"}, "card.license: found [], expected a string"),
        ({"dataset": "fps = "}, "is not valid TOML"),
    ],
)
def test_wrong_ones(changes: dict[str, str], text: str, tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    path.write_text(text_of(**changes), "utf-8")
    with pytest.raises(ConfigError) as error:
        read_recipe(path)
    said = str(error.value)
    assert text in said and said.startswith(str(path)) and "\n" not in said
