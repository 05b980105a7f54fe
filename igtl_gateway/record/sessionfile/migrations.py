"""Old recordings: one step for each version of ``docs/reference/session-log.md`` that is no longer the current one.

A reader returns entries and session metadata in the form of the current version.  The step of an older version
converts them to the next one; steps are applied one after the other, so each knows two versions only.  To change the
entries: raise ``layout.FORMAT_VERSION``, add the step from the version before, keep a file of that version as a test
(``tests/record/sessionfile/old``) and add a line to the table of versions in the document.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.base.errors import UnsupportedRecording
from igtl_gateway.base.untrusted.shape import digits
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile import facts, layout


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


def read_session(path: Path, items: dict[str, str] | None) -> tuple[int, dict[str, str]]:
    """Format version and session metadata of a file; the metadata as the current version has them.

    Args:
        items: the recorded metadata; None: the file has none.

    Raises UnsupportedRecording for a version that is newer than this program or has no step, DamagedRecording.
    """
    if items is None:
        return layout.FORMAT_VERSION, {}
    text = items.get(layout.FORMAT_VERSION_KEY, "")
    digits(text, f"{path}: format version")
    if int(text) > max(layout.PRESENT_VERSIONS):
        raise UnsupportedRecording(
            f"{path}: found format version {text}, expected at most {max(layout.PRESENT_VERSIONS)}; "
            "read it with a newer igtl-gateway"
        )
    facts.check_session(items, str(path))
    try:
        return int(text), session(int(text), items)
    except UnsupportedRecording as error:
        raise UnsupportedRecording(f"{path}: {error}") from None


def session(
    version: int, given: dict[str, str], *, to: int = layout.FORMAT_VERSION, steps: Mapping[int, Step] = STEPS
) -> dict[str, str]:
    """Session metadata of a file of ``version``, as version ``to`` has them.  Raises UnsupportedRecording."""
    for step in _path(version, to, steps):
        given = step.session(given)
    return given


def entries(
    version: int, given: Iterator[Entry], *, to: int = layout.FORMAT_VERSION, steps: Mapping[int, Step] = STEPS
) -> Iterator[Entry]:
    """Entries of a file of ``version``, as version ``to`` has them.  Raises UnsupportedRecording, immediately."""
    for step in _path(version, to, steps):
        given = step.entries(given)
    return given


def _path(version: int, to: int, steps: Mapping[int, Step]) -> list[Step]:
    """The steps between two versions, in order."""
    if to == layout.FORMAT_VERSION and version in layout.PRESENT_VERSIONS:
        return []
    missing = [number for number in range(version, to) if number not in steps]
    if missing or version > to:
        raise UnsupportedRecording(f"found format version {version}, expected {min(steps, default=to)} to {to}")
    return [steps[number] for number in range(version, to)]
