"""The golden recordings of fixtures/, made again by the commands that fixtures/README.md names.

``make fixtures`` writes them again; ``--check`` compares the output of the commands with the committed files, record by
record, before compression: the files themselves are equal if zstandard has the version of ``constraints.txt``.  A file
states the version that wrote it.  It is made again as by that version, so that a new version alone changes no file; one
whose content changes gets the present version.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from igtl_gateway.base.version import __version__
from igtl_gateway.cli import main as igtl_gateway
from igtl_gateway.record.sessionfile import writer
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway_lab.cli import simulate_run

ROOT = Path(__file__).parents[1]
FIXTURES = ROOT / "fixtures"
_COMMAND = re.compile(r"^ {4}((?:\w+=\S+ )*)igtl-gateway (.* -o fixtures/(\S+)\.mcap .*)$", re.MULTILINE)
#: The modules that write the version into a recording.
_STATING = (writer, simulate_run)
#: The content of a recording; all other records contain positions in the file.
_CONTENT = (Header, Schema, Channel, Message, Metadata, Attachment)


@dataclass(frozen=True)
class Recipe:
    """How a recording is made: words of the command line, and its environment."""

    name: str
    words: tuple[str, ...]
    environment: tuple[tuple[str, str], ...]


def recipes() -> list[Recipe]:
    """The commands of fixtures/README.md."""
    found = _COMMAND.findall((FIXTURES / "README.md").read_text())
    return [
        Recipe(name, tuple(shlex.split(words)), tuple(tuple(word.split("=", 1)) for word in variables.split()))
        for variables, words, name in found
    ]


def made_by(path: Path) -> str:
    """The version of igtl-gateway that a recording states."""
    with SessionFile.open(path) as file:
        return file.session["igtl_gateway_version"]


@contextlib.contextmanager
def as_version(version: str) -> Iterator[None]:
    """Have the commands state a version."""
    before = [module.__version__ for module in _STATING]
    try:
        for module in _STATING:
            vars(module)["__version__"] = version
        yield
    finally:
        for module, present in zip(_STATING, before, strict=True):
            vars(module)["__version__"] = present


def make(recipe: Recipe, folder: Path, version: str = __version__) -> Path:
    """Run a command with another folder for ``fixtures``, as by a version.

    Raises SystemExit with its output, if it fails.
    """
    with as_version(version):
        return _make(recipe, folder)


def _make(recipe: Recipe, folder: Path) -> Path:
    path = folder / f"{recipe.name}.mcap"
    words = [word.replace(f"fixtures/{recipe.name}.mcap", str(path)) for word in recipe.words]
    before = dict(os.environ)
    os.environ.update(recipe.environment)
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            code = igtl_gateway(words)
    finally:
        os.environ.clear()
        os.environ.update(before)
    if code:
        raise SystemExit(f"tools/fixtures.py: {' '.join(recipe.words)} ended with {code}: {said.getvalue()}")
    return path


def difference(committed: Path, made: Path) -> str:
    """The first record that differs, or ``""``."""
    one, other = _records(committed), _records(made)
    for number, old in enumerate(one):
        new = next(other, None)
        if old != new:
            return f"record {number}: {_shown(repr(old), repr(new))}"
    new = next(other, None)
    return f"behind the last record: {_shown('', repr(new))}" if new else ""


def packs_alike() -> bool:
    """Whether zstandard has the version that the committed files are packed by."""
    pins = (ROOT / "constraints.txt").read_text()
    return f"zstandard=={version('zstandard')}\n" in pins


def _records(path: Path) -> Iterator[Any]:
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=False).records:
            if isinstance(record, _CONTENT):
                yield record


def _shown(old: str, new: str) -> str:
    """Both strings, starting shortly before their first difference."""
    same = next((at for at, (a, b) in enumerate(zip(old, new, strict=False)) if a != b), min(len(old), len(new)))
    kind, start = new.partition("(")[0], max(0, same - 60)
    return f"{kind}: was …{old[start : same + 60]}…, is now …{new[start : same + 60]}…"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="only these")
    parser.add_argument("--check", action="store_true", help="compare only; exit code 1 if something differs")
    options = parser.parse_args()
    differing = False
    for recipe in recipes():
        if options.names and recipe.name not in options.names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            committed = FIXTURES / f"{recipe.name}.mcap"
            made = make(recipe, Path(folder), made_by(committed))
            found = difference(committed, made)
            if found and not options.check:
                made = make(recipe, Path(folder))
            equal = not found and made.read_bytes() == committed.read_bytes()
            if not options.check and not equal:
                committed.write_bytes(made.read_bytes())
        differing |= bool(found)
        said = found or ("equal" if equal else "equal content, packed otherwise")
        print(f"{recipe.name}: {said if options.check or equal else f'renewed ({said})'}", flush=True)
    if differing and options.check:
        sys.exit("To renew: make fixtures")


if __name__ == "__main__":
    main()
