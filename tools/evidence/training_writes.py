"""Data sets from a recording and by LeRobot's own recorder of the same frames, in turns.

    .venv/bin/python -m tools.evidence.training_writes --python PYTHON [--seconds 20] [--rounds 3]

PYTHON is of an environment with LeRobot.  A session as in `training_reads` (640 × 480, 30 Hz, a pose at 100 Hz) is
exported by the command: its time has all, from the start of Python and the reading of the recording on.  LeRobot gets
the pictures of a second in memory, as arrays or as JPEG that it decodes, and the 14 numbers of each frame of the
exported set; its time is without its imports.  It encodes while it records (``streaming``), or writes PNG first, its
default, with the four threads of its recorder.  The table has medians of the rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from pyarrow import parquet

from tools.evidence import training_writes_lerobot as child
from tools.evidence.training_reads import FPS, RECIPE, SIZE, STREAMS, bodies, pictures, write

FORMS = ("JPEG", "IMAGE, RGB")
#: The settings of our encoders, and the default of LeRobot.
H264 = {"vcodec": "h264", "crf": 18, "preset": "veryfast", "extra_options": {"bf": "0", "mbtree": "0"}}
AV1: dict[str, Any] = {"vcodec": "libsvtav1", "crf": 30, "preset": 10}
FILES, STREAMING = {"image_writer_threads": 4}, {"streaming_encoding": True}
#: Name → codec of the recipe, encoder and recorder of LeRobot.
WAYS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "H.264, streaming": ("h264", H264, STREAMING),
    "H.264, PNG first": ("h264", H264, FILES),
    "AV1, streaming": ("av1", AV1, STREAMING),
    "defaults: H.264; AV1, PNG first": ("h264", {}, FILES),
}
Times = tuple[float, float]


def exported(path: Path, recipe: Path, out: Path) -> Times:
    """Seconds and seconds of CPU of an export, the whole command."""
    begun, before = time.perf_counter(), os.times()
    words = ("export", str(path), "--to", "lerobot", "--recipe", str(recipe), "-o", str(out))
    subprocess.run([sys.executable, "-m", "igtl_gateway", *words], check=True, stdout=subprocess.DEVNULL)
    after = os.times()
    cpu = after.children_user - before.children_user + after.children_system - before.children_system
    return time.perf_counter() - begun, cpu


def columns(root: Path) -> dict[str, Any]:
    """State and action of all frames of a set, (frames, 7)."""
    table = parquet.read_table(next((root / "data").rglob("*.parquet")), columns=list(child.NAMES))
    return {name: np.stack(table[name].to_numpy(zero_copy_only=False)) for name in child.NAMES}


def recorded(python: str, job: Path, out: Path) -> Times:
    """The same of LeRobot, without its imports."""
    script = str(Path(child.__file__))
    done = subprocess.run([python, script, str(job), str(out)], check=True, stdout=subprocess.PIPE, text=True)
    seconds, cpu = json.loads(done.stdout.splitlines()[-1])
    return seconds, cpu


def measure(folder: Path, form: str, ways: Sequence[str], options: argparse.Namespace) -> list[str]:
    """Return the rows of a form of pictures."""
    path = folder / "s.mcap"
    write(path, form, options.seconds)
    recipes = {codec: folder / f"{codec}.toml" for codec in ("h264", "av1")}
    for codec, recipe in recipes.items():
        recipe.write_text(RECIPE.format(stream=STREAMS[form]).replace("fps = 30", f'fps = 30\ncodec = "{codec}"'))
    exported(path, recipes["h264"], folder / "first")
    numbers = columns(folder / "first")
    every = bodies(form) if form == "JPEG" else pictures()
    arrays = [np.frombuffer(each, np.uint8) if isinstance(each, bytes) else each for each in every]
    jobs: dict[str, Path] = {}
    for way in ways:
        _, encoder, recorder = WAYS[way]
        settings = {"fps": FPS, "pictures": len(arrays), "shape": (*SIZE, 3), "encoder": encoder, "recorder": recorder}
        jobs[way] = folder / f"{len(jobs)}.npz"
        named: dict[str, Any] = {f"picture{number}": each for number, each in enumerate(arrays)}
        np.savez(jobs[way], settings=json.dumps(settings), **named, **numbers)
    ours: dict[str, list[Times]] = {way: [] for way in ways}
    theirs: dict[str, list[Times]] = {way: [] for way in ways}
    for turn in range(options.rounds):
        for number, way in enumerate(ways):
            own, other = (folder / f"{who}{turn}-{number}" for who in ("own", "other"))
            ours[way].append(exported(path, recipes[WAYS[way][0]], own))
            theirs[way].append(recorded(options.python, jobs[way], other))
            for name, values in columns(other).items():
                assert np.array_equal(values, columns(own)[name])
    frames = len(numbers["action"])
    return [f"| {form} | {way} | {_row(ours[way], theirs[way])} | {frames} |" for way in ways]


def _row(ours: Sequence[Times], theirs: Sequence[Times]) -> str:
    own, other = ([median(each[at] for each in found) for at in (1, 0)] for found in (ours, theirs))
    ratios = [median(two[at] / one[at] for one, two in zip(ours, theirs, strict=True)) for at in (1, 0)]
    return f"{own[0]:.1f} | {other[0]:.1f} | {ratios[0]:.2f} | {own[1]:.1f} | {other[1]:.1f} | {ratios[1]:.2f}"


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", required=True, help="of an environment with LeRobot")
    parser.add_argument("--seconds", type=int, default=20, help="of each session")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--forms", nargs="+", choices=FORMS, default=list(FORMS))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    options = parser.parse_args()
    print("| pictures | set | export, s of CPU | LeRobot, s of CPU | ratio | export, s | LeRobot, s | ratio | frames |")
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|")
    for form in options.forms:
        with tempfile.TemporaryDirectory() as folder:
            print("\n".join(measure(Path(folder), form, options.ways, options)), flush=True)


if __name__ == "__main__":
    main()
