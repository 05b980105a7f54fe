"""``--append``: a set grows, whatever happens; what was in it stays, and the old set is whole until the new one is."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from igtl_gateway.addons.lerobot import appending, assembling, export
from igtl_gateway.addons.lerobot.appending import append_sessions
from igtl_gateway.addons.lerobot.comparing import check
from igtl_gateway.addons.lerobot.export import export_sessions
from igtl_gateway.base.systems.files import lock, open_plain
from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile import replaced_folder
from tests.addons.lerobot.sessions import write_session
from tests.addons.lerobot.test_assembling import bytes_of, info_of, messages, recipe_of, rows_of
from tests.places import ROOT
from tests.tables import table

SPLITS = '[splits]\npatient = "{patient}_*"\ntrain = 0.5\nval = 0.5'
#: Sessions of the set, and those that come.
OLD, NEW = ("P01_a", "P02_a"), ("P02_b", "P03_a", "P04_a")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five sessions of four patients and a set of two of them in each format; joints of a new one in another order."""
    folder = tmp_path_factory.mktemp("study")
    for number, name in enumerate((*OLD, *NEW)):
        order = ("pitch", "yaw") if name == "P03_a" else ("yaw", "pitch")
        write_session(folder / f"{name}.mcap", messages(10.0 * number, names=order))
    for version in ("v2.1", "v3.0"):
        export_sessions(files_of(folder, OLD), recipe_of(folder, version, SPLITS), folder / version)
    return folder


def files_of(study: Path, names: tuple[str, ...]) -> list[Path]:
    return [study / f"{name}.mcap" for name in names]


def copy_of(study: Path, folder: Path, version: str = "v3.0") -> Path:
    root = folder / "set"
    shutil.copytree(study / version, root)
    return root


@pytest.mark.slow
@pytest.mark.parametrize("version", [pytest.param("v2.1", marks=pytest.mark.long), "v3.0"])
def test_a_set_grows(version: str, study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, new = copy_of(study, tmp_path, version), files_of(study, NEW)
    (root / "notes.txt").write_text("of the user")
    info = info_of(root)
    (root / "meta" / "info.json").write_text(json.dumps(info | {"made_for": [1]}))
    before, inode = bytes_of(root), (root / "data/chunk-000").stat().st_ino
    append_sessions(new[::-1], None, root)
    assert (
        bytes_of(root).items()
        >= {
            name: digest for name, digest in before.items() if name.startswith(("data", "videos", "notes", "meta/prov"))
        }.items()
        and (root / "data/chunk-000").stat().st_ino != inode
    )
    assert os.listdir(tmp_path) == ["set"]
    again = copy_of(study, tmp_path / "2", version)
    (again / "notes.txt").write_text("of the user")
    (again / "meta" / "info.json").write_text(json.dumps(info | {"made_for": [1]}))
    words = ["export", *map(str, new), "--to", "lerobot", "--append", "-o", str(again)]
    assert main(words) == 0
    assert bytes_of(root) == bytes_of(again)
    out = capsys.readouterr().out
    assert "45 frames in 5 episodes of 5 sessions, of which 27 frames in 3 episodes were appended" in out
    found = info_of(root)
    assert found["made_for"] == [1] and found["total_frames"] == 45
    # the patient of P02_b keeps its split, and the others have half of the frames each
    assert found["splits"] == {"train": "0:1,2:4", "val": "1:2,4:5"} or found["splits"] == {
        "train": "0:1,2:3",
        "val": "1:2,3:5",
    }
    listed = json.loads((root / "meta" / "sessions.json").read_text())["sessions"]
    of_group = {each["group"]: each["split"] for each in listed}
    assert all(of_group[each["group"]] == each["split"] for each in listed) and len(of_group) == 4
    rows = rows_of(root)
    assert rows["index"] == list(range(45)) and rows["episode_index"] == [at // 9 for at in range(45)]
    start = {f"{name}.mcap": 10.0 * number for number, name in enumerate((*OLD, *NEW))}
    for number, each in enumerate(listed):
        for frame in range(9):
            at = start[each["name"]] + 0.1 * frame
            assert np.allclose(rows["observation.joints"][9 * number + frame], [3 + at, 5 + at], atol=1e-5)
    checked = check(root, files_of(study, (*NEW, *OLD)))
    assert checked.findings == [] and checked.notes == []
    if version == "v3.0":  # as of one pass over all values
        stats = json.loads((root / "meta" / "stats.json").read_text())
        force = np.array(rows["observation.force"], np.float32).astype(np.float64)
        assert stats["observation.force"]["q99"] == [np.quantile(force, 0.99)]
        assert stats["observation.force"]["mean"] == [force.mean()] and stats["action"]["count"] == [45]
        assert stats["observation.images.view"]["count"] == [45]


def test_an_edited_card_stays_and_modes_do(study: Path, tmp_path: Path) -> None:
    root = copy_of(study, tmp_path)
    (root / "meta" / "README.md").write_text("my own text about synchronization")
    for path in (root, *root.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    append_sessions(files_of(study, NEW[:1]), None, root)
    assert (root / "meta" / "README.md").read_text() == "my own text about synchronization"
    modes = {path.stat().st_mode & 0o777 for path in (root, *root.rglob("*"))}
    assert modes == {0o755, 0o644} and root.stat().st_mode & 0o777 == 0o755


def test_no_links(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, other = copy_of(study, tmp_path), copy_of(study, tmp_path / "2")

    def refuse(*_: Any) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    append_sessions(files_of(study, NEW[:1]), None, other)
    monkeypatch.setattr(os, "link", refuse)
    append_sessions(files_of(study, NEW[:1]), None, root)
    assert bytes_of(root) == bytes_of(other)


#: Where a program fails: function, number of the call.
FAULTS: list[tuple[Any, str, int]] = [
    (appending, "make_folder", 2),
    (appending, "_link", 0),
    (export, "make_folder", 0),
    (assembling, "write_json", 0),
    (assembling, "write_table", 1),
    (assembling, "write_checksums", 0),
    (replaced_folder, "sync_file", 0),
    (replaced_folder, "exchange", 0),
]


@table(("module", "name", "number"), FAULTS, gate=lambda module, name, number: name in ("_link", "exchange"))
def test_a_full_disk_at_any_step_changes_nothing(
    module: Any, name: str, number: int, study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    root, before = copy_of(study, tmp_path), bytes_of(study / "v3.0")
    calls, real = iter(range(99)), getattr(module, name)

    def full(*given: Any, **more: Any) -> Any:
        if next(calls) == number:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*given, **more)

    monkeypatch.setattr(module, name, full)
    words = ["export", str(study / "P03_a.mcap"), "--to", "lerobot", "--append", "-o", str(root)]
    assert main(words) == 1
    assert capsys.readouterr().err == f"igtl-gateway export: cannot write to {root}: No space left on device\n"
    assert bytes_of(root) == before and os.listdir(tmp_path) == ["set"]


def more_sessions(study: Path, tmp_path: Path) -> dict[str, Path]:
    wrong: dict[str, dict[str, Any]] = {"few.mcap": {"names": ("yaw",)}, "wide.mcap": {"columns": 72}}
    return {name: write_session(tmp_path / name, messages(90.0, **each)) for name, each in wrong.items()}


def test_sessions_that_do_not_fit(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, before = copy_of(study, tmp_path), bytes_of(study / "v3.0")
    own = (study / "v3.0" / "meta" / "recipe.toml").read_text()
    good = study / "P03_a.mcap"
    wrong = more_sessions(study, tmp_path)

    def error(*files: Path, recipe: str = "", out: Path = root) -> str:
        words = ["export", *map(str, files), "--to", "lerobot", "--append", "-o", str(out)]
        if recipe:
            (tmp_path / "r.toml").write_text(recipe)
            words += ["--recipe", str(tmp_path / "r.toml")]
        assert main(words) in (1, 2)
        text = capsys.readouterr().err
        assert text.count("\n") == 1 and bytes_of(root) == before
        return text

    plain = own.replace('patient = "{patient}_*"\n', "")
    assert "already: P01_a.mcap; expected others" in error(good, study / "P01_a.mcap")
    (renamed := tmp_path / "P01_z.mcap").write_bytes((study / "P01_a.mcap").read_bytes())
    assert "already: P01_z.mcap, there as P01_a.mcap; expected others" in error(renamed)
    (broken := tmp_path / "broken").symlink_to("nowhere")
    assert f" export: {tmp_path / 'nowhere'}: No such folder" in error(good, out=broken)
    assert "meta/recipe.toml: few.mcap: feature[1] (observation.joints" in error(wrong["few.mcap"], recipe="")
    assert "1 of 2 sessions do not fit: wide.mcap: feature[3]" in error(good, wrong["wide.mcap"])
    assert "r.toml: dataset.fps: found 20, expected 10 as in" in error(good, recipe=own.replace("fps = 10", "fps = 20"))
    assert "r.toml: feature[2]: found another row" in error(
        good, recipe=own.replace('fields = ["values"]', 'fields = ["values"]\nlag_ms = 5')
    )
    assert "r.toml: splits.patient: found '', expected '{patient}_*' as in" in error(good, recipe=plain)
    names = own.replace("train = 0.5", 'train = ["P02"]').replace("val = 0.5", 'val = ["P0[13]"]')
    assert "found 'P02' in train, expected it in val as in the data set" in error(good, recipe=names)
    ranges = plain.replace("train = 0.5", 'train = "0:1"').replace("val = 0.5", 'val = "1:2"')
    assert "a range of demonstrations of one session, expected shares or names" in error(good, recipe=ranges)
    assert f"{root}t: No such folder; did you mean" in error(good, out=root.with_name("sett"))
    handle = open_plain(tmp_path / ".set.igtl-gateway-lock", os.O_RDWR | os.O_CREAT)
    lock(handle)
    assert f"{root}: another program is writing to it" in error(good)
    os.close(handle)


def test_names_of_a_new_recipe_are_those_of_the_new_sessions(study: Path, tmp_path: Path) -> None:
    root, recipe = copy_of(study, tmp_path), tmp_path / "r.toml"
    own = (root / "meta" / "recipe.toml").read_text()
    names = own.replace("train = 0.5", 'train = ["P01"]').replace("val = 0.5", 'val = ["P02", "P03"]')
    recipe.write_text(names)
    append_sessions(files_of(study, ("P03_a",)), recipe, root)
    assert info_of(root)["splits"] == {"train": "0:1", "val": "1:3"}
    assert (root / "meta" / "recipe.toml").read_text() == names
    assert check(root, files_of(study, (*OLD, "P03_a"))).findings == []


def half(root: Path, name: str) -> None:
    (root / name).unlink()


def changed_info(root: Path, **change: Any) -> None:
    path = root / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))


def changed_sessions(root: Path, change: Callable[[Any], Any]) -> None:
    path = root / "meta" / "sessions.json"
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


VIDEO = "videos/observation.images.view/chunk-000/file-001.mp4"
HALF: list[tuple[Callable[[Path], Any], str]] = [
    (lambda root: half(root, VIDEO), f"found no {VIDEO}, which SHA256SUMS has"),
    (lambda root: half(root, "meta/SHA256SUMS"), "SHA256SUMS: No such file"),
    (lambda root: half(root, "meta/info.json"), "found no meta/info.json in it, expected a data set"),
    (lambda root: half(root, "meta/recipe.toml"), "found no meta/recipe.toml"),
    (lambda root: half(root, "meta/sessions.json"), "found meta/recipe.toml without meta/sessions.json"),
    (lambda root: (root / "data" / "more.parquet").touch(), "found data/more.parquet, which SHA256SUMS lacks"),
    (lambda root: (root / "link").symlink_to("meta"), "link: found a link"),
    (lambda root: changed_info(root, total_episodes=3), "expected each episode once"),
    (lambda root: changed_info(root, total_frames=30), "meta/sessions.json: found other episodes than in info.json"),
    (lambda root: changed_info(root, splits={"train": "0:2"}), "found P02_a.mcap not in val"),
    (lambda root: changed_info(root, splits={"train": "0:2", "val": "1:2"}), "expected each episode once"),
    (lambda root: changed_info(root, total_tasks=1 << 60), "found other tasks than info.json"),
    (lambda root: changed_info(root, total_episodes=1 << 60), "episodes"),
    (lambda root: changed_sessions(root, lambda value: value["rows"].pop()), "rows: found other rows"),
    (lambda root: changed_sessions(root, lambda value: value["sessions"].pop()), "found other episodes than"),
    (lambda root: parquet.write_table(parquet.read_table(root / "data/chunk-000/file-000.parquet").slice(1),
                                      root / "data/chunk-000/file-000.parquet"), "found 26 frames, expected 27"),
]  # fmt: skip


@table(("damage", "text"), HALF)
def test_a_set_that_is_not_whole_is_refused(
    damage: Callable[[Path], Any], text: str, study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = copy_of(study, tmp_path)
    damage(root)
    before = bytes_of(root)
    words = ["export", str(study / "P03_a.mcap"), "--to", "lerobot", "--append", "-o", str(root)]
    assert main(words) in (1, 2)
    err = capsys.readouterr().err
    assert text in err and err.count("\n") == 1, err
    assert bytes_of(root) == before and os.listdir(tmp_path) == ["set"]


#: What a set of LeRobot itself has in ``meta``.
THEIRS = {"v2.1": ("info.json", "tasks.jsonl", "episodes.jsonl", "episodes_stats.jsonl"),
          "v3.0": ("info.json", "tasks.parquet", "stats.json", "episodes")}  # fmt: skip


def foreign(study: Path, folder: Path, version: str) -> Path:
    """The set as another program writes it: other columns about episodes, keys that are not known, and no splits."""
    root = copy_of(study, folder, version)
    for path in (root / "meta").iterdir():
        if path.name not in THEIRS[version]:
            path.unlink()
    info = info_of(root)
    info["features"]["observation.joints"]["names"] = {"motors": info["features"]["observation.joints"]["names"]}
    info["features"]["observation.images.view"]["info"] |= {"video.crf": 30}
    changed_info(root, splits={"train": "0:2"}, features=info["features"], made_for=[1])
    if version == "v3.0":
        for path in (root / "meta" / "episodes").rglob("*.parquet"):
            rows = parquet.read_table(path)
            wanted = [name for name in rows.schema.names if not name.endswith(("q10", "q90"))]
            parquet.write_table(rows.select(wanted[::-1]).append_column("mood", [["good"] * rows.num_rows]), path)
    return root


@pytest.mark.slow
@pytest.mark.parametrize("version", [pytest.param("v2.1", marks=pytest.mark.long), "v3.0"])
def test_a_set_of_another_program_grows(version: str, study: Path, tmp_path: Path) -> None:
    root, recipe, before = foreign(study, tmp_path, version), study / version / "meta" / "recipe.toml", bytes_of(study)
    append_sessions(files_of(study, NEW[1:2]), recipe, root)  # joints in another order, alone
    append_sessions(files_of(study, (NEW[0], NEW[2])), None, root)
    assert bytes_of(study) == before
    info, listed = info_of(root), json.loads((root / "meta" / "sessions.json").read_text())
    assert info["made_for"] == [1] and info["total_frames"] == 45 and listed["others"] == 2
    assert info["splits"] == {"train": "0:2,3:4", "val": "2:3,4:5"}  # the frames that were there count, too
    assert rows_of(root)["index"] == list(range(45))
    checked = check(root, files_of(study, NEW))
    assert checked.findings == []
    assert checked.notes == ["2 episodes of another program: not compared, no recording is known"]
    if version == "v3.0":
        files = sorted((root / "meta" / "episodes").rglob("*.parquet"))
        schemas = [parquet.read_schema(each) for each in files]
        assert all(each.equals(schemas[0]) for each in schemas) and "mood" in schemas[0].names and len(schemas) > 2
        stats, force = (
            json.loads((root / "meta" / "stats.json").read_text()),
            np.array(rows_of(root)["observation.force"]),
        )
        assert stats["observation.force"]["q01"] == [np.quantile(force, 0.01)]
        other = json.loads((copy_of(study, tmp_path / "own") / "meta" / "stats.json").read_text())
        assert stats["observation.images.view"]["count"] == [45] and other["observation.images.view"]["count"] == [18]


def other_rows(root: Path, **change: Any) -> None:
    info = info_of(root)
    changed_info(root, features=info["features"] | change)


FOREIGN: list[tuple[Callable[[Path], Any], str]] = [
    (lambda root: changed_info(root, fps=20), "dataset.fps: found 10, expected 20 as in"),
    (lambda root: changed_info(root, robot_type="so100"), "robot_type: found 'unknown', expected 'so100' as in"),
    (lambda root: changed_info(root, chunks_size=500), "chunks_size: found 500, expected 1000"),
    (lambda root: other_rows(root, reward={"dtype": "float32", "shape": [1], "names": None}),
     "reward: found it in the data set and not in the recipe"),
    (lambda root: other_rows(root, action={"dtype": "float64", "shape": [7], "names": None}),
     'action: dtype: found "float32", expected "float64"'),
    (lambda root: other_rows(root, action={"dtype": "float32", "shape": [7], "names": list("abcdefg")}),
     'action: names: found ["x", "y"'),
    (lambda root: half(root, "meta/stats.json"), "stats.json: No such file"),
    (lambda root: (root / "data" / "chunk-000" / "file-002.parquet").touch(), "found a file of no episode"),
    (lambda root: half(root, VIDEO), "expected a whole set"),
    (lambda root: (root / "meta" / "stats.json").write_text("{}"), "found no mean, std and count of pictures"),
]  # fmt: skip


@table(("damage", "text"), FOREIGN, gate=lambda damage, text: "chunks" in text or "reward" in text)
def test_what_does_not_fit_a_set_of_another_program(
    damage: Callable[[Path], Any], text: str, study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = foreign(study, tmp_path, "v3.0")
    damage(root)
    before, recipe = bytes_of(root), str(study / "v3.0" / "meta" / "recipe.toml")
    words = ["export", str(study / "P03_a.mcap"), "--to", "lerobot", "--append", "-o", str(root), "--recipe", recipe]
    assert main(words) in (1, 2)
    err = capsys.readouterr().err
    assert text in err and err.count("\n") == 1 and "import" not in err, err
    assert bytes_of(root) == before and os.listdir(tmp_path) == ["set"]


@pytest.mark.slow
@pytest.mark.long
def test_a_program_that_is_killed_at_any_step_leaves_the_old_set(study: Path, tmp_path: Path) -> None:
    """Each step is a call of the system; after the exchange it is the new set, which a killed program leaves, too."""
    root, files = copy_of(study, tmp_path), files_of(study, NEW[:1])
    whole = copy_of(study, tmp_path / "whole")
    append_sessions(files, None, whole)
    old, new = bytes_of(root), bytes_of(whole)
    words = [sys.executable, "-m", "tests.addons.lerobot.append_and_die", str(tmp_path), *map(str, files)]
    seen, step, kills = set[str](), 1, 0
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as program:
        assert program.stdin is not None and program.stdout is not None
        while True:
            program.stdin.write(f"{step}\n")
            program.stdin.flush()
            ended = int(program.stdout.readline())
            found = bytes_of(root)
            assert found in (old, new), step
            assert check(root, ()).findings == []
            if not ended:
                break
            assert ended == 9
            kills += 1
            seen.add("old" if found == old else "new")
            if found == new:  # the next one would find its sessions there
                shutil.rmtree(root)
                shutil.copytree(study / "v3.0", root)
            step += 5
    assert found == new and os.listdir(tmp_path / "set") and seen == {"old", "new"} and kills >= 20
    left = set(os.listdir(tmp_path)) - {"set", "whole"}
    assert not left, left
