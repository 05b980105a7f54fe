"""The error of a verb that reads recordings, about a file of another program: how it becomes a recording."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator
from pathlib import Path

from igtl_gateway.base.addons import is_present, part_of
from igtl_gateway.base.errors import GatewayError

#: Words of the errors about files and directories that this program has not recorded.
_NO_MCAP, _OTHERS, _FOLDER = "not an MCAP file", "of another program", "found a directory"
_EXPECTED = "expected a recording of igtl-gateway (MCAP)"


def import_hint(error: GatewayError, options: argparse.Namespace) -> str:
    """Return the text of an error, with the command that imports the file of another program that it is about."""
    text = str(error)
    if getattr(options, "verb", "") == "import" or not is_present("exchange"):
        return text
    for path in _paths(options):
        if f"{path}:" not in text or not path.exists():
            continue
        what = part_of("exchange", "formats:what_to_import")(path)
        if not what or (_is_mcap(path) and _OTHERS not in text):
            continue
        found = text
        if any(words in text for words in (_NO_MCAP, _FOLDER)):
            found = f"{path}: found {what}, {_EXPECTED}"
        return f"{found}; run: igtl-gateway import {shlex.quote(str(path))} -o session.mcap"
    return text


def _paths(options: argparse.Namespace) -> Iterator[Path]:
    """Yield the paths among the values of a command; parts of a merge are pairs of a name and a path."""
    for value in vars(options).values():
        for each in value if isinstance(value, list | tuple) else (value,):
            for one in each if isinstance(each, list | tuple) else (each,):
                if isinstance(one, Path):
                    yield one
                elif isinstance(one, str) and one:
                    yield Path(one.partition("=")[2] or one)


def _is_mcap(path: Path) -> bool:
    """Return whether a file begins as MCAP does, from any program."""
    from igtl_gateway.record.sessionfile.records import MAGIC  # here: no help needs it

    try:
        with path.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False
