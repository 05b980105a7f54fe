"""Old recordings: one step for each version of ``docs/session-log.md`` that is no longer the current one.

A reader gives entries and session metadata as the current version has them.  What an older version had otherwise,
its step puts right; steps are applied one after the other, so that each knows two versions only.  To change the
format: raise ``layout.FORMAT_VERSION``, add the step from the version before, keep a file of that version as a test
(``tests/sessionfile/old``) and add a line to the table of versions in the document.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from igtl_gateway.errors import UnsupportedRecording
from igtl_gateway.session.entry import Entry
from igtl_gateway.sessionfile import layout


@dataclass(frozen=True, slots=True)
class Step:
    """From one version to the next.

    Attributes:
        session: the session metadata of the next version.
        entries: the entries of the next version; they may be more or fewer.
    """

    session: Callable[[dict[str, str]], dict[str, str]]
    entries: Callable[[Iterator[Entry]], Iterator[Entry]]


#: Version → the step to the next one.
STEPS: Mapping[int, Step] = {}


def session(
    version: int, given: dict[str, str], *, to: int = layout.FORMAT_VERSION, steps: Mapping[int, Step] = STEPS
) -> dict[str, str]:
    """Session metadata of a file of ``version``, as version ``to`` has it.  Raises UnsupportedRecording."""
    for step in _path(version, to, steps):
        given = step.session(given)
    return given


def entries(
    version: int, given: Iterator[Entry], *, to: int = layout.FORMAT_VERSION, steps: Mapping[int, Step] = STEPS
) -> Iterator[Entry]:
    """Entries of a file of ``version``, as version ``to`` has them.  Raises UnsupportedRecording, at once."""
    for step in _path(version, to, steps):
        given = step.entries(given)
    return given


def _path(version: int, to: int, steps: Mapping[int, Step]) -> list[Step]:
    """The steps between two versions, in order."""
    missing = [number for number in range(version, to) if number not in steps]
    if missing or version > to:
        raise UnsupportedRecording(f"found format version {version}, expected {min(steps, default=to)} to {to}")
    return [steps[number] for number in range(version, to)]
