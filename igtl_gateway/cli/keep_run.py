"""``igtl-gateway keep``: the retention and the upload of ``bridge``, once."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.base.addons import part_of
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, RecordingError
from igtl_gateway.base.quantities import count_text, size_text
from igtl_gateway.base.untrusted.files import near_file
from igtl_gateway.cli.keep_options import keep_options
from igtl_gateway.cli.settings import values_with_effect
from igtl_gateway.cli.terminal import aligned, print_json, print_line
from igtl_gateway.config.notations import retention
from igtl_gateway.record.retention.retention import Choice, Retention, RetentionReport
from igtl_gateway.record.retention.stored import StoredRecording
from igtl_gateway.record.retention.upload_state import UploadProtection


def run(options: argparse.Namespace) -> int:
    folder: Path = options.folder
    values = values_with_effect(options, keep_options())
    if not (values["retention"] or values.get("upload")):
        raise ConfigError("found neither --retention nor --upload, expected one of them, or both")
    if not folder.is_dir():
        raise RecordingError(f"{folder}: found no directory, expected one with recordings{near_file(folder)}")
    code = part_of("upload", "keeping:upload")(folder, values) if values.get("upload") else 0
    return max(code, _retain(folder, values)) if values["retention"] else int(code)


def _retain(folder: Path, values: dict[str, Any]) -> int:
    uploads = UploadProtection(folder, all_files=values["only_uploaded"])
    uploads.refresh()

    def hindrance(recording: StoredRecording) -> str:
        if values["only_sealed"] and not recording.sealed:
            return "it is not sealed"
        return uploads.why(recording)

    rule = retention(values["retention"])
    how = Retention(folder, rule, SystemClock(), hindrance, trust_clock=values["trust_clock"])
    report = how.preview() if values["dry_run"] else how.apply()
    if values["json"]:
        print_json(_facts(report, dry=values["dry_run"]))
    else:
        _print(report, dry=values["dry_run"])
    return 1 if report.problem or not report.complete else 0


def _print(report: RetentionReport, *, dry: bool) -> None:
    rows: list[Sequence[str]] = [("", "recording", "size", "")]
    for word, choices in (("would delete" if dry else "deleted", report.deleted), ("kept", report.kept)):
        for each in choices:
            why = f"{each.reason}; {each.kept}" if each.kept else each.reason
            rows.append((word, each.recording.name, size_text(each.recording.size), why))
    if len(rows) > 1:
        print_line(*aligned(rows, left=2, indent="", text=True))
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
