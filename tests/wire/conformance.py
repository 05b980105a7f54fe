"""Every message of other implementations through the command line, and what came of it as a table.

Strategy: each file goes through ``igtl-gateway decode -o`` as a user would have it done.  What it prints is
compared with the JSON beside the file (for the C library's vectors: with the values that its tests assert), what it
writes with the file.  The counts by type and header version are the conformance table.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.base.stamp import fraction_to_ns
from igtl_gateway.cli import decode
from igtl_gateway.wire.header import HEADER_VERSIONS
from tests.files import write_anew
from tests.wire.vectors import Vector, vectors

CORPUS = Path(__file__).parents[1] / "data" / "corpus"

#: In the JSON of the corpus, but about the library that wrote it.
_LIBRARY = "lib"


@dataclass(frozen=True, slots=True)
class Case:
    """A file of messages and what they mean.

    Attributes:
        name: where it is from.
        data: the messages, one after the other.
        expected: per message what ``decode`` must print; of dictionaries the keys that are there.
        whole: whether it must print nothing else.
    """

    name: str
    data: bytes
    expected: tuple[dict[str, Any], ...]
    whole: bool


@dataclass(frozen=True, slots=True)
class Result:
    """The result of one message.

    Attributes:
        case: name of the file.
        type, header_version: as expected.
        decoded: printed with the values expected.
        reencoded: written as it was.
    """

    case: str
    type: str
    header_version: int
    decoded: bool
    reencoded: bool


def cases() -> list[Case]:
    """The corpus with our own files, and the vectors."""
    return [_corpus(path) for path in sorted(CORPUS.glob("*.bin"))] + [_vector(vector) for vector in vectors()]


def _corpus(path: Path) -> Case:
    rows = json.loads(path.with_suffix(".json").read_text("utf-8"))
    expected = tuple({key: row[key] for key in row if not key.startswith(_LIBRARY)} for row in rows)
    return Case(f"{path.parent.name}/{path.stem}", path.read_bytes(), expected, True)


def _vector(vector: Vector) -> Case:
    expected = {key: vector.facts[key] for key in ("type", "header_version", "device_name")}
    content = _as_we_say(vector.facts["expected"])
    return Case(f"vectors/{vector.name}", vector.data, ({**expected, "crc_ok": True, "content": content},), False)


#: Keys of the vectors that repeat another key, in words or in other units.
_OTHER_WORDS = frozenset({"spacing_set", "unit_text"})


def _as_we_say(value: Any) -> Any:
    """What the C library's tests assert, in the words of the corpus."""
    if isinstance(value, list):
        return [_as_we_say(one) for one in value]
    if not isinstance(value, dict):
        return value
    said = {key: _as_we_say(one) for key, one in value.items() if key not in _OTHER_WORDS}
    if "timestamp_raw" in said:  # a tick word below one second
        said["timestamp"] = {"sec": 0, "nanosec": fraction_to_ns(said.pop("timestamp_raw"))}
    return said


def holds(expected: Any, shown: Any) -> bool:
    """Whether ``shown`` has every value of ``expected``; keys may be more."""
    if isinstance(expected, dict) and isinstance(shown, dict):
        return all(key in shown and holds(value, shown[key]) for key, value in expected.items())
    if isinstance(expected, list) and isinstance(shown, list):
        return len(expected) == len(shown) and all(map(holds, expected, shown))
    return bool(expected == shown)


def run(case: Case, folder: Path) -> list[Result]:
    """One file through the command line, which writes into ``folder``."""
    source, target = folder / "in.igtl", folder / "out.igtl"
    write_anew(source, case.data)
    target.unlink(missing_ok=True)
    parser = argparse.ArgumentParser()
    decode.add_arguments(parser)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        decode.runner()(parser.parse_args([str(source), "-o", str(target)]))
    shown = [json.loads(line) for line in printed.getvalue().splitlines()]
    written = target.read_bytes()
    results = []
    for index, want in enumerate(case.expected):
        told = shown[index] if index < len(shown) else {}
        decoded = told == want if case.whole else holds(want, told)
        at = told.get("offset", 0)
        end = at + 58 + told.get("body_size", 0)
        same = "content" in told and written[at:end] == case.data[at:end] and len(shown) == len(case.expected)
        results.append(Result(case.name, want["type"], want["header_version"], decoded, same))
    return results


def results(chosen: Iterable[Case] | None = None) -> list[Result]:
    """Every message of every file."""
    with tempfile.TemporaryDirectory() as folder:
        return [one for case in (cases() if chosen is None else chosen) for one in run(case, Path(folder))]


def table(rows: Sequence[Result]) -> str:
    """Markdown: one row per type; per header version messages decoded and re-encoded, of how many."""
    versions = list(HEADER_VERSIONS)
    lines = ["| Type | " + " | ".join(f"v{n} decoded | v{n} re-encoded | v{n} messages" for n in versions) + " |"]
    lines.append("|---|" + "---:|" * (3 * len(versions)))
    for kind in sorted({row.type for row in rows}):
        lines.append(_line(f"`{kind}`", [row for row in rows if row.type == kind]))
    lines.append(_line("all", rows))
    return "\n".join(lines)


def _line(label: str, rows: Sequence[Result]) -> str:
    cells = [label]
    for version in HEADER_VERSIONS:
        of_version = [row for row in rows if row.header_version == version]
        counts = (sum(row.decoded for row in of_version), sum(row.reencoded for row in of_version), len(of_version))
        cells += [str(count) if of_version else "–" for count in counts]
    return "| " + " | ".join(cells) + " |"
