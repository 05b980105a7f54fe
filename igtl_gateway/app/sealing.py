"""Seals of recordings: a file or all parts of a split one are checked, and old files are sealed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.app.sealed_folder import side_file_state, strange_file
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, UnsupportedRecording
from igtl_gateway.base.untrusted.files import is_same
from igtl_gateway.record.seal.keys import SigningKey, load_trusted
from igtl_gateway.record.seal.time_stamps import load_authorities
from igtl_gateway.record.sessionfile.added_marks import marks_files
from igtl_gateway.record.sessionfile.seal_check import CHANGED, CUT, SEALED, UNSEALED, UNTRUSTED, SealReport, check_seal
from igtl_gateway.record.sessionfile.seal_copy import seal_copy
from igtl_gateway.record.sessionfile.sealing import SealSeries
from igtl_gateway.record.sessionfile.side_file import SIDE_FILE
from igtl_gateway.record.sessionfile.stamped import stamped_copy
from igtl_gateway.record.sessionfile.whole_files import written

#: State of a recording that is sealed, but without an accepted time stamp, although one is asked for.
UNTIMED = "untimed"
#: Of several files, the state of the first of these that one has.
_WORST = (UNTRUSTED, CHANGED, UNSEALED, CUT, SEALED)


@dataclass(frozen=True, slots=True)
class SealVerification:
    """The result for a recording.

    Attributes:
        file: the file, or the directory of a split recording.
        state: ``sealed``, ``cut``, ``changed``, ``unsealed``, ``untrusted`` or ``untimed``.
        problem: what is wrong with the order of the parts, with other files of the directory, or with the time stamp;
            "" if nothing is.
        parts: the result for each file, in order.
        side_file: what is known of ``metadata.yaml`` of a split recording; "" otherwise.
        added: files with marks that were added later, which no seal covers.
    """

    file: Path
    state: str
    problem: str
    parts: tuple[SealReport, ...]
    side_file: str = ""
    added: tuple[Path, ...] = ()

    @property
    def good(self) -> bool:
        """Whether every byte is as it was sealed, and nothing is missing."""
        return self.state == SEALED

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON values, as ``igtl-gateway verify --seal --json`` prints it."""
        parts = [asdict(part) | {"file": str(part.file)} for part in self.parts]
        return {
            "file": str(self.file),
            "good": self.good,
            "state": self.state,
            "problem": self.problem,
            "parts": parts,
            "side_file": self.side_file,
            "not_sealed": [str(path) for path in self.added],
        }


def verify_seal(path: Path, trusted: Sequence[Path] = (), tsa: Sequence[Path] = ()) -> SealVerification:
    """Check the seals of a recording.

    Args:
        path: a file, or the directory of a split recording.
        trusted: files of trusted public keys; none: any key.
        tsa: files of certificates of time-stamp authorities, one of which has to confirm the (last) file; none: time
            stamps are not checked.

    Raises UnsupportedRecording, ConfigError for files without keys, LimitExceeded, Unavailable.
    """
    keys = load_trusted(trusted) if trusted else None
    authorities = load_authorities(tsa) if tsa else None
    folder = path.is_dir()
    parts = _parts(path) if folder else [path]
    reports = [check_seal(part, keys, authorities) for part in parts]
    state = next(each for each in _WORST if any(report.state == each for report in reports))
    problem = side_file = ""
    if folder and state in (SEALED, CUT):
        found, problem = _order_of(reports)
        state = found if problem else state
    if folder and state in (SEALED, CUT):
        side_file, wrong = side_file_state(path, parts, cut=state == CUT)
        if stranger := strange_file(path, parts):
            state, problem = CHANGED, stranger
        elif wrong and state == CUT:  # it may name parts that are missing
            side_file = wrong
        elif wrong:
            state, problem = CHANGED, f"{SIDE_FILE}: {wrong}"
    if tsa and state == SEALED and (problem := _time_problem(reports)):
        state = UNTIMED
    return SealVerification(path, state, problem, tuple(reports), side_file, tuple(marks_files(path)))


def stamp_recording(source: Path, reply: Path, output: Path, *, overwrite: bool = False) -> tuple[str, int]:
    """Write a copy of a sealed file with the reply of a time-stamp authority; return SHA-256 of the seal, and size.

    Raises ConfigError for a reply about something else, UnsupportedRecording for a file that is not sealed or has a
    time stamp, and as ``stamped_copy``.
    """
    if is_same(source, output):
        raise ConfigError(f"{output}: found the recording itself, expected another name for the one with a time stamp")
    report = check_seal(source)
    if report.state != SEALED:
        raise UnsupportedRecording(f"{source}: found a file in the state {report.state!r}, expected a sealed one")
    if report.time_stamp:
        raise UnsupportedRecording(f"{source}: found a time stamp already, expected a sealed file without one")
    digest = bytes.fromhex(report.last_seal)
    with written(output, overwrite=overwrite) as place:
        size = stamped_copy(source, report.end_of_seals, reply, digest, place)
    return report.last_seal, size


def seal_recording(source: Path, key: Path, output: Path, *, overwrite: bool = False) -> tuple[str, int]:
    """Write a sealed copy of a recording; return the identifier of the key, and the size.

    Raises ConfigError for a key that cannot be used, and as ``seal_copy``.
    """
    signing = SigningKey.load(key)
    if is_same(source, output):
        raise ConfigError(f"{output}: found the recording itself, expected another name for the sealed one")
    sealer = SealSeries(signing, SystemClock().utc_ns).next_file(output)
    with written(output, overwrite=overwrite) as place:
        return signing.id, seal_copy(source, place, sealer)


def _time_problem(reports: Sequence[SealReport]) -> str:
    """Return what is wrong with the time stamps: of the last file, whose seals refer to all others, and those given."""
    for report in reports:
        if report.time_stamp and report.time_stamp.problem:
            return f"{report.file.name}: {report.time_stamp.problem}"
    return "" if reports[-1].time_stamp else f"{reports[-1].file.name}: it has no time stamp"


def _parts(folder: Path) -> list[Path]:
    """Return the parts of a split recording by their numbers.  Raises UnsupportedRecording without any."""
    name = re.compile(r".*_([0-9]{1,9})\.mcap", re.DOTALL)
    numbered = [(int(found[1]), path) for path in folder.glob("*.mcap") if (found := name.fullmatch(path.name))]
    if not numbered:
        raise UnsupportedRecording(f"{folder}: found a directory without parts NAME_0.mcap, expected a split recording")
    return [path for _, path in sorted(numbered)]


def _order_of(reports: Sequence[SealReport]) -> tuple[str, str]:
    """Return the state and what is wrong with the order of the parts, by what their seals state."""
    before: SealReport | None = None
    for number, report in enumerate(reports):
        name = report.file.name
        if before and (report.recording, report.key) != (before.recording, before.key):
            return CHANGED, f"{name}: found a file of another recording or key"
        if report.part != number:
            return CHANGED, f"{name}: found part {report.part}, expected part {number}"
        if before and report.previous != before.last_seal:
            return CHANGED, f"{name}: it does not continue {before.file.name}"
        if before and before.last_part:
            return CHANGED, f"{name}: found a part behind the last part {before.file.name}"
        before = report
    if reports[-1].last_part is False:
        return CUT, f"{reports[-1].file.name}: it is not the last part: what follows it is missing"
    return SEALED, ""
