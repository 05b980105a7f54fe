"""Many sessions, one data set: in any order the same bytes, one schema, splits that follow sessions or patients."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from igtl_gateway.addons.lerobot.export import distinct_names, export_sessions
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import main
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.sensor import Sensor, parse_unit
from tests.addons.lerobot.sessions import BEGIN_NS, Sent, arm, bars, pose_m, write_session
from tests.tables import table

ARM, VIEW, JOINTS, FORCE = "TRANSFORM/ArmToBase", "IMAGE/View", "/joint_states", "SENSOR/Force"
VERSIONS = ("v2.1", "v3.0")
NAMES = ("P01_a", "P01_b", "P02_a", "P03_a")
RECIPE = """\
[dataset]
fps = 10
task = "sew"
format = "{format}"
measure_lags = false
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ArmToBase"
[[feature]]
name = "observation.joints"
stream = "/joint_states"
fields = ["position"]
[[feature]]
name = "observation.force"
stream = "SENSOR/Force"
fields = ["values"]
[[feature]]
name = "observation.images.view"
stream = "IMAGE/View"
[[feature]]
name = "action"
next_of = "observation.state"
{more}
"""
NEWTON, MILLI = parse_unit("N"), parse_unit("mN")


def joints(at: float, names: tuple[str, ...]) -> Callable[[int], JointState]:
    """Joints whose positions follow from their names."""
    places = np.array([len(name) + at for name in names])
    return lambda stamp_ns: JointState(Header(stamp_ns, ""), names, places, np.array([]), np.array([]))


def messages(
    first: float,
    *,
    names: tuple[str, ...] = ("yaw", "pitch"),
    unit: int = NEWTON,
    columns: int = 64,
    step: float = 0.02,
) -> list[Sent]:
    """A second of an arm, joints, a force and pictures, which begins ``first`` s after the others."""
    found: list[Sent] = []
    for number in range(50):
        at = first + 0.02 * number
        found += [(at, ARM, arm(at, 0)), (at, JOINTS, joints(at, names))]
    for number in range(round(1 / step)):
        at = first + step * number
        found.append((at, FORCE, Sensor(np.array([at]), unit)))
    for number in range(10):
        at = first + 0.1 * number
        pixels = bars(number + round(first), columns=columns)
        found.append((at, VIEW, Image((columns, 48, 1), 3, pixels.tobytes())))
    return sorted(found, key=lambda each: each[0])


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four sessions of three patients; the joints of one come in another order."""
    folder = tmp_path_factory.mktemp("study")
    for number, name in enumerate(NAMES):
        order = ("pitch", "yaw") if number == 1 else ("yaw", "pitch")
        write_session(folder / f"{name}.mcap", messages(10.0 * number, names=order))
    return folder


def recipe_of(folder: Path, version: str, more: str = "") -> Path:
    path = folder / "recipe.toml"
    path.write_text(RECIPE.format(format=version, more=more), "utf-8")
    return path


def bytes_of(root: Path) -> dict[str, str]:
    """SHA-256 of each file."""
    files = (each for each in root.rglob("*") if each.is_file())
    return {str(each.relative_to(root)): hashlib.sha256(each.read_bytes()).hexdigest() for each in files}


def info_of(root: Path) -> Any:
    return json.loads((root / "meta" / "info.json").read_text("utf-8"))


def rows_of(root: Path) -> dict[str, Any]:
    """All rows of a set, in the order of their files."""
    files = sorted((root / "data").rglob("*.parquet"))
    tables = [parquet.read_table(each).to_pydict() for each in files]
    return {name: [row for each in tables for row in each[name]] for name in tables[0]}


@pytest.mark.parametrize("version", VERSIONS)
def test_any_order_of_sessions_gives_the_same_bytes(
    version: str, study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = '[splits]\npatient = "{patient}_*"\ntrain = ["P01", "P03"]\nval = ["P02"]'
    recipe, files = recipe_of(tmp_path, version, more), [study / f"{name}.mcap" for name in NAMES]
    export_sessions(files, recipe, tmp_path / "one")
    words = ["export", *map(str, files[::-1]), "--to", "lerobot", "--recipe", str(recipe)]
    assert main([*words, "-o", str(tmp_path / "two")]) == 0
    out = capsys.readouterr().out
    assert bytes_of(tmp_path / "one") == bytes_of(tmp_path / "two")
    assert "36 frames in 4 episodes of 4 sessions" in out
    root = tmp_path / "one"
    assert info_of(root)["splits"] == {"train": "0:3", "val": "3:4"} and info_of(root)["total_episodes"] == 4
    listed = json.loads((root / "meta" / "sessions.json").read_text("utf-8"))
    assert [each["name"] for each in listed["sessions"]] == [f"{NAMES[at]}.mcap" for at in (0, 1, 3, 2)]
    rows = rows_of(root)
    assert rows["index"] == list(range(36)) and rows["episode_index"] == [at // 9 for at in range(36)]
    for index, session in enumerate((0, 1, 3, 2)):
        for frame in range(9):
            at, row = 10 * session + 0.1 * frame, 9 * index + frame
            assert np.allclose(rows["observation.state"][row][:3], pose_m(at, 0)[:3, 3], atol=1e-5)
            assert np.allclose(rows["observation.joints"][row], [3 + at, 5 + at], atol=1e-5), (session, frame)
            assert rows["observation.force"][row] == pytest.approx(at, abs=1e-5)
    assert main([*words[: len(files) + 1], "--to", "lerobot", "--check", str(root)]) == 0
    assert "36 frames in 4 episodes, 0 findings" in capsys.readouterr().out
    if version == "v3.0":  # statistics as of one pass over all values
        stats = json.loads((root / "meta" / "stats.json").read_text("utf-8"))
        for name in ("observation.state", "action", "index", "timestamp", "observation.force"):
            every = np.array(rows[name], np.float32 if name not in ("index",) else np.int64).astype(np.float64)
            every = every.reshape(36, -1)
            for key, expected in (
                ("mean", every.mean(axis=0)),
                ("std", every.std(axis=0)),
                ("q01", np.quantile(every, 0.01, axis=0)),
                ("q99", np.quantile(every, 0.99, axis=0)),
            ):
                assert stats[name][key] == expected.tolist(), (name, key)
        assert stats["observation.images.view"]["count"] == [36]


def test_a_changed_value_of_any_session_is_found(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, root = recipe_of(tmp_path, "v3.0"), tmp_path / "set"
    files = [study / f"{name}.mcap" for name in NAMES[:2]]
    export_sessions(files, recipe, root)
    path = root / "data" / "chunk-000" / "file-001.parquet"
    rows = parquet.read_table(path)
    force = rows["observation.force"].to_pylist()
    force[3] += 1.0
    changed = rows.set_column(rows.schema.get_field_index("observation.force"), rows.schema.field("observation.force"),
                              [np.array(force, np.float32)])  # fmt: skip
    parquet.write_table(changed, path)
    words = ["export", *map(str, files), "--to", "lerobot", "--check", str(root)]
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "P01_b.mcap: episode 1: observation.force: frame 3" in out and "found another SHA-256" in out
    assert main([words[0], *words[2:]]) == 1  # one recording: the other session is not compared, which a note states
    assert "note: no recording given for 1 of 2 sessions: not compared" in capsys.readouterr().out
    assert main(["export", str(study / "P03_a.mcap"), *words[3:]]) == 1
    assert "found a recording that meta/sessions.json does not list" in capsys.readouterr().out


DIFFERENT: list[tuple[dict[str, Any], str]] = [
    (
        {"names": ("yaw", "roll")},
        "names: found no pitch.position and roll.position, expected yaw.position, pitch.position as in a.mcap",
    ),
    ({"names": ("yaw", "pitch", "roll")}, "names: found roll.position, expected"),
    ({"unit": MILLI}, "units: found"),
    ({"columns": 72}, "pictures: found 72 × 48 pixels, expected 64 × 48"),
    ({"step": 0.04}, "rate: found 25 Hz, expected about 50 Hz as in the others"),
    ({"stamped": False}, "clock: found gateway, expected source"),
]


@table(("change", "text"), DIFFERENT)
def test_what_differs_is_named_and_nothing_is_written(change: Mapping[str, Any], text: str) -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        wrong: dict[str, Any] = {key: value for key, value in change.items() if key != "stamped"}
        files = [write_session(folder / f"{each}.mcap", messages(10.0 * at)) for at, each in ((0, "a"), (2, "c"))]
        b = write_session(folder / "b.mcap", messages(10.0, **wrong), stamped="stamped" not in change)
        files.append(b)
        with pytest.raises(ConfigError) as error:
            export_sessions(files, recipe_of(folder, "v3.0"), folder / "set")
        assert str(error.value).startswith("1 of 3 sessions do not fit: b.mcap: ") and text in str(error.value)
        assert not (folder / "set").exists()


def test_sessions_that_cannot_be_in_one_set(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = (study / f"{name}.mcap" for name in NAMES[:2])
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(one.read_bytes())
    without = write_session(tmp_path / "none.mcap", [each for each in messages(0.0) if each[1] != FORCE])
    words = ["--to", "lerobot", "--recipe", str(recipe_of(tmp_path, "v3.0")), "-o", str(tmp_path / "set")]

    def text_of(*files: Path, more: str = "") -> str:
        recipe_of(tmp_path, "v3.0", more)
        assert main(["export", *map(str, files), *words]) == 2 and not (tmp_path / "set").exists()
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        return err

    assert "expected each session once" in text_of(one, two, copy)
    assert f"found {one} twice, expected each session once" in text_of(one, one)
    assert "1 of 2 sessions do not fit: none.mcap: feature[2].stream" in text_of(one, without)
    assert "a range of demonstrations, with 2 sessions" in text_of(one, two, more='[splits]\ntrain = "0:2"')
    assert "expected it in one split" in text_of(one, two, more='[splits]\ntrain = ["P01_a"]\nval = ["P02"]')
    assert "no session or patient of this name" in text_of(one, two, more='[splits]\ntrain = ["*"]\nval = ["P9"]')
    patients = '[splits]\npatient = "{patient}_*"\ntrain = 0.5\nval = 0.5'
    assert "found 1 session or patient for 2 splits" in text_of(one, two, more=patients)
    other = write_session(tmp_path / "x.mcap", messages(30.0))
    assert "found the session 'x', expected a name like '{patient}_*'" in text_of(one, other, more=patients)
    assert main(["export", str(one), str(tmp_path / "no.mcap"), *words]) == 1
    assert "1 of 2 sessions do not fit: no.mcap: No such file" in capsys.readouterr().err
    assert main(["export", str(one), str(two), "--to", "csv", "-o", str(tmp_path / "csv")]) == 2
    assert "found 2 recordings, expected one" in capsys.readouterr().err


def test_sessions_of_one_name(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [tmp_path / patient / "run.mcap" for patient in ("Müller", "P02")]
    for file, name in zip(files, NAMES, strict=False):
        file.parent.mkdir()
        file.write_bytes((study / f"{name}.mcap").read_bytes())
    recipe = recipe_of(tmp_path, "v3.0", '[splits]\npatient = "{patient}/*"\ntrain = 0.5\nval = 0.5')
    words = ["--to", "lerobot", "--recipe", str(recipe), "-o", str(tmp_path / "set")]
    assert main(["export", *map(str, files), *words]) == 0
    assert re.search(r"Müller/run.mcap +train.*\n *P02/run.mcap +val", capsys.readouterr().out)
    text = (tmp_path / "set" / "meta" / "SYNCHRONIZATION.md").read_text("utf-8")
    assert re.findall("# Synchronization of (.*)", text) == ["Müller/run.mcap", "P02/run.mcap"]
    assert main(["export", "--to", "lerobot", "--trace", str(tmp_path / "set"), "--frame", "9"]) == 0
    assert "of P02/run.mcap, split val" in capsys.readouterr().out
    files[1].write_bytes(b"")
    recipe_of(tmp_path, "v3.0")
    assert main(["export", *map(str, files), *words[:-1], str(tmp_path / "other")]) == 1
    assert "1 of 2 sessions do not fit: P02/run.mcap: the file is empty" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["/d/P01/a.mcap", "/d/P02/b.mcap"], ["a.mcap", "b.mcap"]),
        (["/d/P01/a.mcap", "/d/P02/a.mcap", "/d/P02/b.mcap"], ["P01/a.mcap", "P02/a.mcap", "P02/b.mcap"]),
        (["/1/P/a.mcap", "/2/P/a.mcap", "/2/P/a.mcap"], ["1/P/a.mcap", "2/P/a.mcap", "2/P/a.mcap"]),
        (["/a.mcap", "/d/a.mcap"], ["/a.mcap", "d/a.mcap"]),
    ],
)
def test_names_have_the_folders_in_which_they_differ(paths: list[str], names: list[str]) -> None:
    assert distinct_names(paths) == names


def test_a_recipe_of_demonstrations_still_serves_one_session(study: Path, tmp_path: Path) -> None:
    recipe = recipe_of(tmp_path, "v3.0", '[splits]\nval = "0:1"')
    export_sessions([study / f"{NAMES[0]}.mcap"], recipe, tmp_path / "set")
    assert info_of(tmp_path / "set")["splits"] == {"val": "0:1"}
    assert BEGIN_NS <= json.loads((tmp_path / "set" / "meta" / "sessions.json").read_text())["sessions"][0]["start_ns"]
