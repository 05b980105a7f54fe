"""``igtl-gateway recover``: repair a damaged recording."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from igtl_gateway import __version__
from igtl_gateway.cli.common import count_text, size_text
from igtl_gateway.cli.options import add_file, add_json, add_overwrite, default, new_recording
from igtl_gateway.cli.terminal import clear_live_line, is_terminal, live_line, print_json, print_line
from igtl_gateway.errors import ConfigError, RecordingError, UnsupportedRecording
from igtl_gateway.sessionfile.copying import CopyWriter
from igtl_gateway.sessionfile.new_file import make_folder, os_error_text
from igtl_gateway.sessionfile.salvage import Salvage
from igtl_gateway.sessionfile.salvage_report import Loss, SalvageReport
from igtl_gateway.sessionfile.side_file import SIDE_FILE, RecordingPart, write_side_file
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.untrusted.files import is_same

EXAMPLES = """\
  # after a crash: write out.recovered.mcap, closed and with an index
  igtl-gateway recover out.mcap
  # write another file
  igtl-gateway recover out.mcap -o whole.mcap
  # all parts of a split recording, into the directory out.recovered
  igtl-gateway recover out
  # what was read and what is lost, for programs
  igtl-gateway recover out.mcap --json

exit code 0: the new file has all that was recorded; 1: something is lost, and
the output lists it"""

_NEVER = 1 << 64  # after every stamp
_STEP = 64 << 20  # bytes between two reports of the progress
_SHOWN = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, "recording, directory of a split recording, or another MCAP file")
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        type=new_recording,
        help="file to write " + default("FILE with .recovered.mcap"),
    )
    add_overwrite(parser, "OUT")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    source: Path = options.file
    if source.is_dir():
        return _run_parts(options)
    output: Path = options.output or source.with_suffix(".recovered.mcap")
    facts, report, _ = _recover(source, output, options)
    if options.json:
        print_json(facts)
    else:
        _print(facts, report)
    return 0 if report.whole else 1


def _run_parts(options: argparse.Namespace) -> int:
    """Recover all parts of a split recording, into a new directory and under the same names."""
    source: Path = options.file
    output: Path = options.output or source.with_name(f"{source.name}.recovered")
    parts = sorted(source.glob("*.mcap"))
    if not parts:
        raise UnsupportedRecording(f"{source}: found a directory without .mcap files, expected a split recording")
    try:
        make_folder(output, exist_ok=options.overwrite)
    except OSError as error:
        raise RecordingError(f"cannot record to {output}: {error.strerror}") from None
    everything = []
    written = []
    for part in parts:
        try:
            facts, report, copy = _recover(part, output / part.name, options)
        except UnsupportedRecording as error:
            facts = {"file": str(part), "whole": False, "why": str(error)}
            if not options.json:
                print_line(f"LOST {error}")
        else:
            written.append(copy)
            if not options.json:
                _print(facts, report)
        everything.append(facts)
    # in order of time, as they were recorded: part_10 comes before part_9 by name
    written.sort(key=lambda part: (part.start_ns or _NEVER, part.path.name))
    try:
        write_side_file(output, written)
    except OSError as error:
        raise RecordingError(f"cannot write {output / SIDE_FILE}: {os_error_text(error)}") from error
    whole = all(facts["whole"] for facts in everything)
    if options.json:
        print_json({"file": str(source), "output": str(output), "whole": whole, "parts": everything})
    else:
        print_line(f"{output / SIDE_FILE}: written")
    return 0 if whole else 1


def _recover(
    source: Path, output: Path, options: argparse.Namespace
) -> tuple[dict[str, Any], SalvageReport, RecordingPart]:
    """Recover one file.  Return its facts, its salvage report, and its row in the side file of a split recording."""
    if is_same(output, source):
        raise ConfigError(f"{output}: found the damaged file, expected another name for the recovered one")
    with Salvage.open(source) as file:
        with CopyWriter(
            output,
            file.profile,
            file.library,
            file.recorded_session,
            compression=file.compression,
            overwrite=options.overwrite,
        ) as writer:
            _copy(file, writer, progress=is_terminal(error=True) and not options.json)
            facts = _facts(file)
            ledger = file.ledger or {}
            if "recovered" in ledger:
                facts["earlier"] = ledger["recovered"]
            part = writer.close({**ledger, "recovered": facts})
        facts = {"file": str(source), "output": str(output), "output_bytes": part.size, **facts}
        return facts, file.report, part


def _copy(file: Salvage, writer: CopyWriter, *, progress: bool) -> None:
    for metadata in file.metadata():
        writer.add_metadata(metadata)
    for attachment in file.attachments():
        writer.add_attachment(attachment)
    next_word = _STEP
    for each in file.read():
        writer.write(each.schema, each.channel, each.message)
        if progress and file.position >= next_word:
            live_line(f"{100 * file.position // file.report.size:3} %", error=True)
            next_word = file.position + _STEP
    if next_word > _STEP:
        clear_live_line(error=True)


def _facts(file: Salvage) -> dict[str, Any]:
    """Return the facts about its origin for the ledger of the new file."""
    report = file.report
    return {
        "by": f"igtl-gateway {__version__}",
        "from": file.path.name,
        "from_bytes": report.size,
        "whole": report.whole,
        "closed": report.closed,
        "messages": report.messages,
        "missing": report.missing,
        "missing_numbers": report.missing_numbers,
        "lost": [asdict(loss) for loss in report.lost],
        "more_lost": report.more_lost,
    }


def _print(facts: dict[str, Any], report: SalvageReport) -> None:
    print_line(f"{facts['file']}: {count_text(report.messages, 'message')} read of {size_text(report.size)}")
    print_losses(report)
    print_line(f"{facts['output']}: written, closed, with an index, {size_text(facts['output_bytes'])}")
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
        print_line(f"  {count_text(report.missing, 'message')} of the index are unreadable")
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
}


def _loss_text(loss: Loss, start_ns: int) -> str:
    """Name, time and place of a loss."""
    times = [f"{(each - start_ns) / NS_PER_S:.3f} s" for each in (loss.start_ns, loss.end_ns) if each]
    match times:
        case [first, last]:
            when = f" between {first} and {last}"
        case [first]:
            when = f" after {first}"
        case _:
            when = ""
    return f"{_NAMES[loss.what]}{when} (offset {loss.at:,}, {count_text(loss.size, 'byte')}): {loss.text}"
