"""The latest task of each file and verb: which rows count, and that many rows take little memory."""

from __future__ import annotations

import random
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyarrow")

from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.base.untrusted import limits

MIB = 1 << 20


def written(folder: Path, parts: list[list[dict[str, Any]]]) -> Results:
    results = Results(folder)
    with results.locked():
        for rows in parts:
            results.add({"tasks": rows, "marks": [{"task": row["task"], "file": row["file"]} for row in rows]}, {})
    return results


def test_of_two_tasks_of_a_file_and_verb_the_later_one_counts(tmp_path: Path) -> None:
    chance = random.Random(1)
    verbs, names = ("info", "lint", None), ("a.mcap", "ä.mcap", None)  # None: not from us
    parts = [
        [
            {"task": f"{chance.getrandbits(32):08x}", "file": chance.choice(names), "verb": chance.choice(verbs)}
            for _ in range(chance.randrange(1, 9))
        ]
        for _ in range(6)
    ]
    latest = {(row["file"], row["verb"]): row["task"] for rows in parts for row in rows}
    results = written(tmp_path / "out", parts)
    for _ in range(2):
        tasks = results.read("tasks").to_pylist()
        assert {(row["file"], row["verb"]): row["task"] for row in tasks} == latest and len(tasks) == len(latest)
        assert set(results.read("marks")["task"].to_pylist()) == set(latest.values())
        assert {name: row["task"] for name, row in results.known("info", ["ä.mcap", "other"]).items()} == {
            name: task for (name, verb), task in latest.items() if (name, verb) == ("ä.mcap", "info")
        }
        with results.locked():
            results.compact()  # and the same in one part


def test_many_tasks_are_no_rows_of_python(tmp_path: Path) -> None:
    rows = [{"task": str(number), "file": f"{number}.mcap", "verb": "info"} for number in range(20_000)]
    results = written(tmp_path / "out", [rows])
    few = replace(limits.current_limits(), free=MIB)  # a file is read into a buffer of this size
    tracemalloc.start()
    try:
        with limits.limits_in_force(few), results.locked():
            assert list(results.known("info", ["7.mcap"])) == ["7.mcap"]
            results.compact()
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 4 * MIB, f"{most:,} bytes"
