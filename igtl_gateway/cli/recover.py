"""``igtl-gateway recover``: a damaged recording becomes a whole file again."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from igtl_gateway import __version__
from igtl_gateway.cli.common import count, print_json, size
from igtl_gateway.errors import ConfigError
from igtl_gateway.record.mcap_copy import CopyWriter
from igtl_gateway.replay.salvage import Loss, Report, Salvage
from igtl_gateway.stamp import NS_PER_S

EXAMPLES = """\
  igtl-gateway recover out.mcap                 after a crash: out.recovered.mcap, closed and with its index
  igtl-gateway recover out.mcap -o whole.mcap   under another name
  igtl-gateway recover out.mcap --json          what was read and lost, for programs

exit code 0: all that was recorded is in the new file; 1: something is lost, and the output says what"""

_STEP = 64 << 20  # bytes between two words on the progress
_SHOWN = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="a recording, or another MCAP file, damaged or not")
    parser.add_argument(
        "-o", "--output", metavar="OUT", type=Path, help="the file to write (default: FILE with .recovered.mcap)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace OUT if it exists")
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object")


def run(options: argparse.Namespace) -> int:
    source: Path = options.file
    output: Path = options.output or source.with_suffix(".recovered.mcap")
    if output.exists() and source.exists() and output.samefile(source):
        raise ConfigError(f"{output}: is the damaged file itself; expected another name for the recovered one")
    with Salvage.open(source) as file:
        with CopyWriter(
            output,
            file.profile,
            file.library,
            file.recorded_session,
            compression=file.compression,
            overwrite=options.overwrite,
        ) as writer:
            _copy(file, writer, progress=sys.stderr.isatty() and not options.json)
            facts = _facts(file)
            ledger = file.ledger or {}
            if "recovered" in ledger:
                facts["earlier"] = ledger["recovered"]
            written = writer.close({**ledger, "recovered": facts})
        report = file.report
        told = {"file": str(source), "output": str(output), "output_bytes": written, **facts}
    if options.json:
        print_json(told)
    else:
        _print(source, output, written, report)
    return 0 if report.whole else 1


def _copy(file: Salvage, writer: CopyWriter, *, progress: bool) -> None:
    for metadata in file.metadata:
        writer.add_metadata(metadata)
    for attachment in file.attachments():
        writer.add_attachment(attachment)
    next_word = _STEP
    for each in file.read():
        writer.write(each.schema, each.channel, each.message)
        if progress and file.position >= next_word:
            print(f"\r{100 * file.position // file.report.size:3} %", end="", file=sys.stderr, flush=True)
            next_word = file.position + _STEP
    if next_word > _STEP:
        print("\r     \r", end="", file=sys.stderr, flush=True)


def _facts(file: Salvage) -> dict[str, Any]:
    """What the ledger of the new file says of its origin."""
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


def _print(source: Path, output: Path, written: int, report: Report) -> None:
    print(f"{source}: {count(report.messages, 'message')} read of {size(report.size)}")
    print_losses(report)
    print(f"{output}: written, closed and with its index, {size(written)}")
    if report.whole:
        print("whole: nothing that was recorded is lost")


def print_losses(report: Report) -> None:
    """What is lost, in words; nothing where nothing is."""
    for loss in report.lost[:_SHOWN]:
        print(f"  LOST {_words(loss, report.start_ns)}")
    more = max(0, len(report.lost) - _SHOWN) + report.more_lost
    if more:
        print(f"  LOST in {count(more, 'more place')}")
    if report.missing:
        print(f"  {count(report.missing, 'message')} of the index could not be read")
    elif report.missing is None and report.missing_numbers:
        print(
            f"  up to {count(report.missing_numbers, 'entry', 'entries')}, by their numbers, are missing between others"
        )


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


def _words(loss: Loss, start_ns: int) -> str:
    """Name, time and place of a loss."""
    times = [f"{(each - start_ns) / NS_PER_S:.3f} s" for each in (loss.start_ns, loss.end_ns) if each]
    match times:
        case [first, last]:
            when = f" between {first} and {last}"
        case [first]:
            when = f" after {first}"
        case _:
            when = ""
    return f"{_NAMES[loss.what]}{when} (offset {loss.at:,}, {count(loss.size, 'byte')}): {loss.text}"
