"""LeRobot: its loader reads sets of ``export``, and ``--check`` reads sets that its own functions wrote and edited.

    python -m tools.judges.lerobot --python PYTHON [--validator FILE]

The Python has LeRobot 0.3.3, 0.4.4 or 0.6; the file is the validator of Open-H, which needs 0.3.3.
Writes docs/evidence/real-programs/lerobot-VERSION.jsonl; exit code 1 if anything differs.

Strategy: ``programs/lerobot_sets.py`` runs in that Python.  The numbers of a frame have to be those of the tables, its
pictures those of the videos within three of 255.  A set of LeRobot has no finding, except for what it lost itself:
these findings are listed here, and each is a row that differs.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import parquet

from igtl_gateway.addon.reading import open_recording
from igtl_gateway.addons.lerobot.checking_videos import by_file, pictures_of
from igtl_gateway.addons.lerobot.comparing import check
from igtl_gateway.addons.lerobot.drafting import draft
from igtl_gateway.addons.lerobot.export import export_sessions
from igtl_gateway.addons.lerobot.reading import read_data_set
from tests.addons.lerobot.sessions import write_session
from tests.addons.lerobot.test_assembling import NAMES, RECIPE, messages
from tools.judges import results
from tools.judges.results import BOTH, CANNOT, DIFFERS, EXACT, FAILS, ROOT, Row

PROGRAM = Path(__file__).parent / "programs" / "lerobot_sets.py"
FIXTURES = ("star", "ultrasound", "crtk")
#: Largest difference of a picture, of 0 to 1: decoders convert colours in different ways.
CLOSE = 3 / 255
#: Two episodes of each session, of which those of one patient are held out.
EPISODES = """
[splits]
train = ["P01*", "P02*"]
val = ["P03*"]
[episodes]
by = "ranges"
[[episodes.range]]
start = 0
end = 0.42
[[episodes.range]]
start = 0.42
end = 1
"""
#: Part of a finding → what it is about.
NUMBERS, TOTALS, TASKS = "stats of index, episode_index", "meta/stats.json: episode_index, index", "task_index"
NEW, HELD_OUT, GONE, NO_TASK = "of no session", "held-out episodes", "found no episode 1 of P01_a.mcap", "found no task"
SUMS, SQUARES = "SHA", ": std: found"
TOLD = {
    NUMBERS: "statistics of episodes are those of other numbers",
    TOTALS: "statistics of the set are those of other numbers",
    TASKS: "statistics of tasks are those of other numbers",
    NEW: "episodes of no session",
    HELD_OUT: "held-out episodes are training data",
    GONE: "an episode is gone",
    NO_TASK: "episodes have no tasks",
    SUMS: "files changed",
    SQUARES: "the deviation of pictures is wrong, mostly 0",
}
#: Set of LeRobot → what it lost; other sets have no finding.
LOST: dict[str, set[str]] = {
    "merged": {TOTALS},
    "merged numbers": {TOTALS},
    "merged pictures": {TOTALS},
    "aggregated": {TOTALS},
    "deleted": {NUMBERS, TOTALS},
    "split/val": {NUMBERS, TOTALS},
    "other tasks": {TASKS},
    "pictures to videos": {NO_TASK},
    "deleted, then resumed": {NUMBERS, TOTALS},
    "export resumed": {NEW, HELD_OUT, SUMS},
    "export deleted": {NUMBERS, TOTALS},
    "export split/val": {NUMBERS, TOTALS},
    "export merged": {TOTALS},
    "export with other tasks": {SUMS, TASKS},
    "export deleted, beside our files": {GONE, HELD_OUT, SUMS, NUMBERS, TOTALS},
    "export merged, beside our files": {NEW, HELD_OUT, SUMS, TOTALS},
}
#: Set → what it may have lost: the order of the tasks is that of a set of Python.
PERHAPS: dict[str, set[str]] = {"last deleted": {TASKS}}
#: Version → what it lost besides: 0.4 squares the bytes of pictures as bytes, and its merge keeps all numbers.
BESIDES: dict[str, set[str]] = {"0.4": {SQUARES, NUMBERS, TASKS}}


# --- sets of the gateway ----------------------------------------------------------------------------------------------


def exported(folder: Path) -> None:
    """Sets of the fixtures and of four sessions, in both formats."""
    paths = [write_session(folder / f"{name}.mcap", messages(10.0 * number)) for number, name in enumerate(NAMES)]
    for version in ("v2.1", "v3.0"):
        recipe = folder / "recipe.toml"
        recipe.write_text(RECIPE.format(format=version, more=EPISODES), "utf-8")
        export_sessions(paths, recipe, folder / version)
        for name in FIXTURES:
            path = ROOT / "fixtures" / f"{name}.mcap"
            with open_recording(path) as recording:
                text = draft(recording).text
            recipe.write_text(re.sub(r'format = "v[0-9.]+"', f'format = "{version}"', text), "utf-8")
            export_sessions([path], recipe, folder / f"{name}-{version}")


def read(python: Path, root: Path) -> Row:
    """The frames of a set as the loader of LeRobot gives them."""
    what = f"reads {root.name}: numbers, strings, pictures, tasks"
    told = run(python, "read", str(root))
    if told.returncode:
        return Row(what, BOTH, FAILS, 1, last_line(told.stderr))
    head, *frames = json_lines(told.stdout)
    found = read_data_set(root)
    rows = [row for path in sorted((root / "data").rglob("*.parquet")) for row in parquet.read_table(path).to_pylist()]
    if (head["episodes"], head["frames"], len(frames)) != (len(found.episodes), len(rows), len(rows)):
        return Row(what, BOTH, FAILS, 1, f"{head} of {len(rows)} frames")
    pictures = dict(pictures_by_frame(root))
    for number, (frame, row) in enumerate(zip(frames, rows, strict=True)):
        for name, value in row.items():
            if np.any(np.asarray(frame[name]) != np.asarray(value)):
                return Row(what, BOTH, FAILS, 1, f"frame {number}: {name}: {frame[name]}, expected {value}")
        for name in found.videos:
            wanted = parts_of(pictures[name, number])
            if np.abs(np.asarray(frame[name]) - wanted).max() > CLOSE:
                return Row(what, BOTH, FAILS, 1, f"frame {number}: {name} is another picture")
        if frame["task"] != found.tasks[row["task_index"]]:
            return Row(what, BOTH, FAILS, 1, f"frame {number}: task {frame['task']}")
    return Row(what, BOTH, EXACT, len(frames) * (len(rows[0]) + len(found.videos)))


def pictures_by_frame(root: Path) -> Iterator[tuple[tuple[str, int], Any]]:
    """Feature and number of the frame in the set, and its picture."""
    found = read_data_set(root)
    firsts = np.cumsum([0, *(each.length for each in found.episodes)])
    for name in found.videos:
        for path, parts in by_file(found, name).items():
            for episode, frame, picture in pictures_of(found, name, path, parts):
                yield (name, int(firsts[episode.index]) + frame), picture


def parts_of(picture: Any) -> Any:
    """The mean of each channel in 16 parts, of 0 to 1."""
    rows, columns = (size // 4 for size in picture.shape[:2])
    parts = (picture[: 4 * rows, : 4 * columns] / 255).reshape(4, rows, 4, columns, -1)
    return parts.mean(axis=(1, 3)).transpose(2, 0, 1)


# --- sets of LeRobot --------------------------------------------------------------------------------------------------


def written(python: Path, folder: Path, ours: Path, besides: set[str]) -> Iterator[Row]:
    """The check of each set that LeRobot makes."""
    told = run(python, "write", str(folder), str(ours))
    for line in json_lines(told.stdout):
        name = line["set"]
        if "error" in line:
            yield Row(f"makes {name}", BOTH, CANNOT, 1, line["error"].replace(f"{folder}/", "")[:160])
            continue
        for part in [folder / name, folder / name / "train", folder / name / "val"]:
            if (part / "meta" / "info.json").exists():
                yield judged(str(part.relative_to(folder)), check(part, []).findings, besides)
    if told.returncode:
        yield Row("makes sets", BOTH, FAILS, 1, last_line(told.stderr))


def judged(name: str, findings: Sequence[str], besides: set[str]) -> Row:
    """A set has what it must have lost, and nothing but this and what its version loses besides."""
    found = {next((part for part in TOLD if part in each), each) for each in findings}
    expected = LOST.get(name, set())
    if not expected <= found or found - expected - besides - PERHAPS.get(name, set()):
        missing = ", ".join(TOLD[part] for part in expected - found)
        return Row(f"check of {name}", BOTH, FAILS, 1, f"found {'; '.join(findings)[:300]}, not {missing or 'this'}")
    if not found:
        return Row(f"check of {name}", BOTH, EXACT)
    told = ", ".join(text for part, text in TOLD.items() if part in found)
    return Row(f"check of {name}", BOTH, DIFFERS, 1, f"found: {told}; LeRobot's fault")


# --- Open-H -----------------------------------------------------------------------------------------------------------


def validated(python: Path, script: Path, root: Path) -> Row:
    told = called(python, str(script), str(root))
    errors = [each for each in told.stdout.splitlines() if "[ERROR]" in each]
    if told.returncode or errors:
        return Row(
            f"Open-H's validator on {root.name}", BOTH, FAILS, 1, "; ".join(errors)[:300] or last_line(told.stderr)
        )
    return Row(f"Open-H's validator on {root.name}", BOTH, EXACT)


def run(python: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return called(python, str(PROGRAM), *words)


def called(python: Path, *words: str) -> subprocess.CompletedProcess[str]:
    alone = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "PYTHONHASHSEED": "0"}
    return subprocess.run([str(python), *words], capture_output=True, text=True, env=alone, check=False)


def json_lines(text: str) -> list[Any]:
    """What the program prints; LeRobot prints other lines, too."""
    return [json.loads(each) for each in text.splitlines() if each.startswith("{")]


def last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no output"])[-1][:300]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", type=Path, required=True, help="with LeRobot")
    parser.add_argument("--validator", type=Path, help="Open-H's validate_formatting.py")
    options = parser.parse_args()
    code = "from importlib.metadata import version; print(version('lerobot'))"
    version = subprocess.run(
        [str(options.python), "-c", code], capture_output=True, text=True, check=True
    ).stdout.strip()
    short = ".".join(version.split(".")[:2])
    form = "v2.1" if version.startswith("0.3.") else "v3.0"
    with tempfile.TemporaryDirectory() as name:
        ours, theirs = Path(name) / "ours", Path(name) / "theirs"
        ours.mkdir()
        theirs.mkdir()
        exported(ours)
        sets = [ours / form, *(ours / f"{each}-{form}" for each in FIXTURES)]
        rows = [read(options.python, each) for each in sets]
        rows += written(options.python, theirs, ours, BESIDES.get(short, set()))
        judged_by_it = [each for each in sets if options.validator and (each / "videos").exists()]
        rows += [validated(options.python, options.validator, each) for each in judged_by_it]
    return results.write(f"lerobot-{short}", f"LeRobot {short}", version, "loader and tools", rows)


if __name__ == "__main__":
    sys.exit(main())
