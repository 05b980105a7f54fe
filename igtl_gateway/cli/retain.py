"""``igtl-gateway retain``: the retention of ``bridge --retention``, once."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import RecordingError
from igtl_gateway.cli.common import count_text, size_text
from igtl_gateway.cli.options import add_json, parser_of
from igtl_gateway.cli.terminal import cell, print_json, print_line, width
from igtl_gateway.config.notations import retention
from igtl_gateway.record.retention.retention import Choice, Retention, RetentionReport
from igtl_gateway.record.retention.stored import StoredRecording
from igtl_gateway.record.retention.upload_state import UploadProtection

EXAMPLES = """\
  # which recordings would be deleted, and which are kept although they are old
  igtl-gateway retain recordings --retention '30 d, 200 GB' --dry-run
  # delete them
  igtl-gateway retain recordings --retention '30 d, 200 GB'
  # delete only those that are sealed to their end
  igtl-gateway retain recordings --retention '30 d' --only-sealed

It deletes closed recordings and parts of split recordings, the oldest first,
and nothing else. `bridge --retention` does the same while it records."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", type=Path, help="directory of recordings")
    parser.add_argument(
        "--retention",
        required=True,
        metavar="RULE",
        type=parser_of(retention),
        help="delete by age (h, d, w), by size of all (MB, GB, TB, MiB, GiB, TiB) or by both, such as '30 d, 200 GB'",
    )
    parser.add_argument("--dry-run", action="store_true", help="print what would be deleted, and delete nothing")
    parser.add_argument("--only-sealed", action="store_true", help="keep recordings that are not sealed to their end")
    parser.add_argument("--only-uploaded", action="store_true", help="keep recordings that no store has confirmed")
    parser.add_argument(
        "--trust-clock",
        action="store_true",
        help="delete by age although the clock is ahead of the last run by more than the age",
    )
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    folder: Path = options.folder
    if not folder.is_dir():
        raise RecordingError(f"{folder}: found no directory, expected one with recordings")

    uploads = UploadProtection(folder, all_files=options.only_uploaded)
    uploads.refresh()

    def hindrance(recording: StoredRecording) -> str:
        if options.only_sealed and not recording.sealed:
            return "it is not sealed"
        return uploads.why(recording)

    how = Retention(folder, options.retention, SystemClock(), hindrance, trust_clock=options.trust_clock)
    report = how.preview() if options.dry_run else how.apply()
    if options.json:
        print_json(_facts(report, dry=options.dry_run))
    else:
        _print(report, dry=options.dry_run)
    return 1 if report.problem or not report.complete else 0


def _print(report: RetentionReport, *, dry: bool) -> None:
    columns = width(each.recording.name for each in (*report.deleted, *report.kept))
    for word, choices in (("would delete" if dry else "deleted", report.deleted), ("kept", report.kept)):
        for each in choices:
            why = f"{each.reason}; {each.kept}" if each.kept else each.reason
            print_line(f"{word:<12} {cell(each.recording.name, columns)} {size_text(each.recording.size):>9}  {why}")
    if report.clock:
        print_line(f"by age nothing is deleted: {report.clock}; --trust-clock deletes", error=True)
    if not report.complete:
        print_line("found more files than one run looks at; run it again", error=True)
    if report.problem:
        print_line(f"nothing is deleted: {report.problem}", error=True)
    size = size_text(sum(each.recording.size for each in report.deleted))
    done = "would be deleted" if dry else "deleted"
    print_line(f"{count_text(len(report.deleted), 'recording')} {done} ({size}); {size_text(report.bytes_left)} left")


def _facts(report: RetentionReport, *, dry: bool) -> dict[str, Any]:
    def rows(choices: list[Choice]) -> list[dict[str, Any]]:
        return [
            {"file": each.recording.name, "bytes": each.recording.size, "reason": each.reason}
            | ({"kept": each.kept} if each.kept else {})
            for each in choices
        ]

    return {
        "dry_run": dry,
        "deleted": rows(report.deleted),
        "kept": rows(report.kept),
        "bytes_left": report.bytes_left,
        "clock": report.clock,
        "problem": report.problem,
        "complete": report.complete,
    }
