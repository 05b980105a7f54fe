"""``igtl-gateway recover``: repair a damaged recording."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

from igtl_gateway.base.errors import (
    ConfigError,
    DamagedRecording,
    GatewayError,
    LimitExceeded,
    UnsupportedRecording,
)
from igtl_gateway.base.quantities import by_count, count_text, moment_text, size_text
from igtl_gateway.base.untrusted.files import is_same
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.cli.losses import NO_END
from igtl_gateway.cli.terminal import clear_live_line, is_terminal, live_line, print_json, print_line
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.added_marks import added_marks
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.recovery import Recovery, recover
from igtl_gateway.record.sessionfile.salvage import HAS_SESSION, Salvage
from igtl_gateway.record.sessionfile.salvage_report import Loss, SalvageReport
from igtl_gateway.record.sessionfile.side_file import SIDE_FILE, part_files, write_side_file
from igtl_gateway.record.sessionfile.whole_files import written, written_folder
from igtl_gateway.replay.recorded_marks import carry_marks

_NEVER = 1 << 64  # after every stamp
_STEP = 64 << 20  # bytes between two reports of the progress
_SHOWN = 20


def run(options: argparse.Namespace) -> int:
    source: Path = options.file
    if source.is_dir():
        return _run_parts(options)
    output: Path = options.output or source.with_suffix(".recovered.mcap")
    if is_same(output, source):
        raise ConfigError(f"{output}: found the damaged file, expected another name for the recovered one")
    with written(output, overwrite=options.overwrite) as place:
        found = _recover(source, place, options)
    facts = _facts(found, source, output)
    facts["notes"] += _carried(source, output, found.report.start_ns, found.report.end_ns)
    if options.json:
        print_json(facts)
    else:
        _print(facts, found.report)
    return 0 if found.report.whole else 1


def _run_parts(options: argparse.Namespace) -> int:
    """Recover all parts of a split recording, into a new directory and under the same names."""
    source: Path = options.file
    output: Path = options.output or source.with_name(f"{source.name}.recovered")
    if is_same(output, source):
        raise ConfigError(f"{output}: found the damaged recording, expected another name for the recovered one")
    if output.suffix == ".mcap" and not output.is_dir():
        raise ConfigError(f"{output}: found the name of a file, expected a directory for the parts of {source}")
    paths = _parts(source)
    if not paths:
        raise UnsupportedRecording(f"{source}: found a directory without .mcap files, expected a split recording")
    everything: list[tuple[dict[str, Any], SalvageReport | None]] = []
    recovered: list[Recovery] = []
    with written_folder(output, overwrite=options.overwrite) as folder:
        shared = _session(paths)
        number = -1
        for path in paths:
            number += 1
            place = folder / path.name
            try:
                part = _recover(path, place, options, {**shared, layout.PART_KEY: str(number)} if shared else {})
                number = _number(place, part, number)
            except (UnsupportedRecording, DamagedRecording) as error:
                if isinstance(error, LimitExceeded):
                    raise
                place.unlink(missing_ok=True)
                number -= 1
                everything.append(({"file": str(path), "whole": False, "why": str(error)}, None))
            else:
                recovered.append(part)
                everything.append((_facts(part, path, output / path.name), part.report))
        # in order of time, as they were recorded: part_10 comes before part_9 by name
        recovered.sort(key=lambda each: (each.part.start_ns or _NEVER, each.part.path.name))
        parts = [each.part for each in recovered]
        write_side_file(folder, parts)
    for facts, found in everything:
        if found:
            facts["notes"] += _carried(Path(facts["file"]), Path(facts["output"]), found.start_ns, found.end_ns)
    full = [part for part in parts if part.entries]
    carried = _carried(source, output, full[0].start_ns, full[-1].end_ns) if full else []
    has_end = not recovered or not recovered[-1].goes_on
    carried += [] if has_end else [f"the end of the recording is {NO_END}"]
    whole = has_end and all(facts["whole"] for facts, _ in everything)
    if options.json:
        rows = [facts for facts, _ in everything]
        print_json({"file": str(source), "output": str(output), "whole": whole, "parts": rows, "notes": carried})
        return 0 if whole else 1
    for facts, found in everything:
        if found is None:
            print_line(f"LOST {facts['why']}")
        else:
            _print(facts, found)
    print_line(f"{output / SIDE_FILE}: written", *(f"  note: {note}" for note in carried))
    return 0 if whole else 1


def _parts(folder: Path) -> list[Path]:
    """The files of a split recording, in the order of the numbers in their names; links only if there is nothing else.

    A folder or a FIFO with the name of a part is not one.
    """
    found = part_files(folder)
    found = [path for path in found if not path.is_symlink()] or found
    return sorted(found, key=lambda path: (len(path.name), path.name))


def _session(paths: Sequence[Path]) -> dict[str, str]:
    """The session metadata that all parts have, of the first part that has them; empty without one."""
    for path in paths:
        with suppress(GatewayError), Salvage.open(path) as file:
            if layout.PART_KEY in file.recorded_session:
                own = (layout.PART_KEY, layout.PREVIOUS_KEY)
                return {key: value for key, value in file.recorded_session.items() if key not in own}
    return {}


def _number(place: Path, part: Recovery, expected: int) -> int:
    """The number of a recovered part.  Raises DamagedRecording if there is nothing of a part in it."""
    with SessionFile.open(place) as file:
        number = whole_number(file.session.get(layout.PART_KEY))
    if not (part.part.entries or part.facts[HAS_SESSION]):
        raise DamagedRecording(f"{part.facts['from']}: found no entry and no session metadata in it")
    return expected if number is None else number


def _carried(source: Path, output: Path, start_ns: int, end_ns: int) -> list[str]:
    """Copy the marks that were added to a recording; return why that was not possible, if so."""
    try:
        if start_ns:
            marks = added_marks(source, start_ns, end_ns, parts=False)
            carry_marks(output, marks)
            if late := [mark.label for mark in marks if mark.time_ns > end_ns]:
                return [f"marks that were added behind the end are left out: {', '.join(late[:_SHOWN])}"]
    except GatewayError as error:
        return [f"marks that were added are left out: {error}"]
    return []


def _recover(
    source: Path, place: Path, options: argparse.Namespace, session: Mapping[str, str] = MappingProxyType({})
) -> Recovery:
    """Recover one file, and show how far that is."""
    shown = 0

    def progress(file: Salvage) -> None:
        nonlocal shown
        if file.position >= shown + _STEP:
            live_line(f"{100 * file.position // file.report.size:3} %", error=True)
            shown = file.position

    has_progress = is_terminal(error=True) and not options.json
    found = recover(source, place, progress if has_progress else lambda _: None, session)
    if shown:
        clear_live_line(error=True)
    return found


def _facts(found: Recovery, source: Path, output: Path) -> dict[str, Any]:
    names = {"file": str(source), "output": str(output), "output_bytes": found.part.size}
    return {**names, **found.facts, "notes": list(found.notes)}


def _print(facts: dict[str, Any], report: SalvageReport) -> None:
    print_line(f"{facts['file']}: {count_text(report.messages, 'message')} read of {size_text(report.size)}")
    print_losses(report)
    print_line(f"{facts['output']}: written, closed, with an index, {size_text(facts['output_bytes'])}")
    for note in facts["notes"]:
        print_line(f"  note: {note}")
    if report.whole:
        print_line("complete: nothing is lost")


def print_losses(report: SalvageReport) -> None:
    """Print the losses; nothing without losses."""
    start_ns = min((each for each in (report.start_ns, *(loss.start_ns for loss in report.lost)) if each), default=0)
    for loss in report.lost[:_SHOWN]:
        print_line(f"  LOST {_loss_text(loss, start_ns)}")
    more = max(0, len(report.lost) - _SHOWN) + report.more_lost
    if more:
        print_line(f"  LOST in {count_text(more, 'more place')}")
    if report.missing:
        print_line(
            f"  {count_text(report.missing, 'message')} of the index {by_count(report.missing, 'is', 'are')} unreadable"
        )
    elif report.missing is None and report.missing_numbers:
        missing = count_text(report.missing_numbers, "entry", "entries")
        print_line(f"  up to {missing}, by their numbers, are missing between others")


_NAMES = {
    "cut_off": "the end",
    "chunk": "a chunk of messages",
    "bytes": "bytes",
    "channel": "messages",
    "number": "an entry",
    "metadata": "metadata",
    "ledger": "the ledger",
    "attachment": "an attachment",
    "header": "the header",
}


def _loss_text(loss: Loss, start_ns: int) -> str:
    """Name, time and place of a loss."""
    times = [moment_text(each - start_ns) for each in (loss.start_ns, loss.end_ns) if each]
    match times:
        case [first, last]:
            when = f" between {first} and {last}"
        case [first]:
            when = f" after {first}"
        case _:
            when = ""
    return f"{_NAMES[loss.what]}{when} (offset {loss.at:,}, {count_text(loss.size, 'byte')}): {loss.text}"
