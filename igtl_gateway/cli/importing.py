"""Errors about a path that is not a recording: they name what it is, and the command that takes it."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from igtl_gateway.base.addons import is_present, part_of
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.quantities import count_text

#: Words of the errors about files and directories that this program has not recorded.
_NO_MCAP, _OTHERS, _FOLDER = "not an MCAP file", "of another program", "found a directory"
#: Verb of one recording → that of `cohort`, which takes many.
COHORT = {"info": "info", "doctor": "lint", "lint": "lint", "verify": "verify", "review": "review", "sync": "sync"}
#: Verbs that take folders, or read no recording.
_OF_FOLDERS = ("cohort", "decode", "keep", "page", "sync", "upload")
#: Files in and below a folder that are looked at.
_MOST = 10_000
#: Recordings that a command names.
_NAMED = 5
_EXPECTED = "expected a recording of igtl-gateway (MCAP)"


def import_hint(error: GatewayError, options: argparse.Namespace) -> str:
    """Return the text of an error, with what the file or folder is that it is about, and the command that takes it."""
    text = str(error)
    if getattr(options, "verb", "") == "import" or not is_present("exchange"):
        return text
    if folder := folder_hint(error, options):
        return folder
    for path in _paths(options):
        if f"{path}:" not in text or not os.path.exists(path) or path == getattr(options, "output", None):
            continue
        what = part_of("exchange", "formats:what_to_import")(path)
        if not what and _NO_MCAP in text and (other := part_of("exchange", "formats:what_is_foreign")(path)):
            return f"{path}: found {other}; {_EXPECTED}"
        if not what or (_is_mcap(path) and _OTHERS not in text):
            continue
        found = text
        if any(words in text for words in (_NO_MCAP, _FOLDER)):
            found = f"{path}: found {what}, {_EXPECTED}"
        return f"{found}; run: igtl-gateway import {shlex.quote(str(path))} -o session.mcap"
    return text


def folder_hint(error: GatewayError, options: argparse.Namespace) -> str:
    """Return what to print instead of an error about a folder with several recordings; "" for any other error.

    The error may be about the first of its files.
    """
    verb = getattr(options, "verb", "")
    if verb in _OF_FOLDERS:
        return ""
    for path in _paths(options):
        if not os.path.isdir(path) or path == getattr(options, "output", None):
            continue
        # the names of files do not begin with that of the folder "."
        if not (verb in COHORT or str(error).startswith((f"{path}:", f"{path}/"))):
            continue
        number = _recordings_in(path)
        if number > 1 and is_present("exchange") and not part_of("exchange", "formats:is_bag")(path):
            return f"{path}: {_several(number, path, verb)}"
    return ""


def _recordings_in(folder: Path) -> int:
    """Return the number of MCAP files among the first files in and below a folder."""
    files = (name for _, _, names in os.walk(folder) for name in names)
    return sum(name.endswith(".mcap") for name in islice(files, _MOST))


def _several(number: int, folder: Path, verb: str) -> str:
    """Return the words about a folder with several recordings, with the command that takes all of them."""
    many = f"found a directory with {count_text(number, 'recording')}, expected one of them"
    return f"{many}; {_of_all(verb, [str(folder)])}" if verb in COHORT and is_present("cohort") else many


def several_hint(verb: str, options: argparse.Namespace, further: Sequence[str]) -> str:
    """Return the command for the recordings that were given to a verb of one, for its error; "" without one."""
    if verb not in COHORT or not is_present("cohort") or not all(map(os.path.exists, further)):
        return ""
    first = [str(path) for path in _paths(options) if os.path.exists(path)][:1]
    return _of_all(verb, [*first, *further])


def _of_all(verb: str, sources: Sequence[str]) -> str:
    """Return the words that name the command for several recordings, for a verb that `COHORT` has."""
    words = " ".join(map(shlex.quote, sources)) if len(sources) <= _NAMED else "FILE ..."
    return f"of all of them: igtl-gateway cohort {COHORT[verb]} {words} -o study"


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
