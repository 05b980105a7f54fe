"""``igtl-gateway keep``: the retention and the upload of ``bridge``, once."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from igtl_gateway.base.addons import is_present, part_of
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, RecordingError
from igtl_gateway.cli.common import count_text, size_text
from igtl_gateway.cli.settings import add_absent, add_settings, values_with_effect
from igtl_gateway.cli.terminal import cell, print_json, print_line, width
from igtl_gateway.config.notations import retention
from igtl_gateway.config.setting import Setting, grouped
from igtl_gateway.config.settings import BY_SETTING
from igtl_gateway.record.retention.retention import Choice, Retention, RetentionReport
from igtl_gateway.record.retention.stored import StoredRecording
from igtl_gateway.record.retention.upload_state import UploadProtection

EXAMPLES = """\
  # which recordings would be deleted, and which are kept although they are old
  igtl-gateway keep recordings --retention '30 d, 200 GB' --dry-run
  # delete them
  igtl-gateway keep recordings --retention '30 d, 200 GB'
  # delete only those that are sealed to their end
  igtl-gateway keep recordings --retention '30 d' --only-sealed
  # upload all recordings of a directory, or what a bridge has left of them
  igtl-gateway keep recordings --upload s3://sessions/or1
  # upload, then delete those that are old and that the store has
  igtl-gateway keep recordings --upload s3://sessions/or1 \\
      --retention '30 d' --only-uploaded

It deletes closed recordings and parts of split recordings, the oldest first,
and nothing else. `bridge --retention` and `bridge --upload` do the same while
they record.  Keys of the store come from AWS_ACCESS_KEY_ID and
AWS_SECRET_ACCESS_KEY, or from ~/.aws; AWS_ENDPOINT_URL names another store
than that of AWS.  An upload that was interrupted continues.  Objects are
created, never replaced."""

_OF_RETENTION: dict[str, Any] = {"needs": ("retention",), "group": "retention"}
OPTIONS = (
    Setting("json", False, "print the result as one JSON object, of each of the two"),
    replace(
        BY_SETTING["retention"],
        about="delete by age (h, d, w), by size of all (MB, GB, TB, MiB, GiB, TiB) or by both, such as '30 d, 200 GB'",
        needs=(),
        group="retention",
    ),
    Setting("dry_run", False, "print what would be deleted, and delete nothing", **_OF_RETENTION),
    Setting("only_sealed", False, "keep recordings that are not sealed to their end", **_OF_RETENTION),
    Setting("only_uploaded", False, "keep recordings that no store has confirmed", **_OF_RETENTION),
    Setting(
        "trust_clock",
        False,
        "delete by age although the clock is ahead of the last run by more than the age",
        **_OF_RETENTION,
    ),
)


def _options() -> tuple[Setting, ...]:
    """The options, with those of the upload if it is there."""
    more: tuple[Setting, ...] = part_of("upload", "keeping:OPTIONS") if is_present("upload") else ()
    return (*OPTIONS, *grouped("upload", *more))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", type=Path, help="directory of recordings")
    add_settings(parser, _options())
    add_absent(parser, "upload")


def run(options: argparse.Namespace) -> int:
    folder: Path = options.folder
    values = values_with_effect(options, _options())
    if not (values["retention"] or values.get("upload")):
        raise ConfigError("found neither --retention nor --upload, expected one of them, or both")
    if not folder.is_dir():
        raise RecordingError(f"{folder}: found no directory, expected one with recordings")
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
