"""``igtl-gateway deidentify``: a session without identity, as a new file that verifies."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from igtl_gateway.addon import NS_PER_S, ConfigError, UnsupportedRecording
from igtl_gateway.addon.terminal import (
    add_file,
    add_json,
    add_output,
    add_overwrite,
    aligned,
    count_text,
    default,
    new_recording,
    print_json,
    print_line,
)
from igtl_gateway.addon.untrusted import is_same, read_bytes
from igtl_gateway.addon.writing import check_target
from igtl_gateway.addons.deidentify.profile import BASIC, read_profile
from igtl_gateway.addons.deidentify.pseudonyms import MIN_KEY_BYTES
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.addons.deidentify.rules import NOT_COVERED
from igtl_gateway.addons.deidentify.session import deidentify

EXAMPLES = """\
  # no names, no text, other times; random pseudonyms
  igtl-gateway deidentify out.mcap -o clean.mcap
  # the same pseudonyms in all sessions of a study
  head -c 32 /dev/urandom > study.key && chmod 600 study.key
  igtl-gateway deidentify out.mcap -o clean.mcap --secret study.key
  # names that stay, rules for text, masks of pictures
  igtl-gateway deidentify out.mcap -o clean.mcap --profile study.toml

The result verifies: inputs are changed, outputs are computed again.  The report
names each rule with its option of DICOM PS3.15, what was left, and what no
rule covers, such as faces in volumes.  See docs/how-to/deidentify.md.

exit code 1 if pictures are left without a mask, and a mask of the profile
matches no stream."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser)
    add_output(parser, read=new_recording, required=True)
    parser.add_argument(
        "--profile", type=Path, metavar="FILE", help="what stays, rules and masks (TOML) " + default("basic: nothing")
    )
    parser.add_argument(
        "--secret", type=Path, metavar="FILE", help="key of the pseudonyms " + default("random, and not stored")
    )
    times = parser.add_mutually_exclusive_group()
    times.add_argument(
        "--shift", type=int, metavar="S", help="move all times by this number of seconds " + default("from the key")
    )
    times.add_argument("--keep-times", action="store_true", help="keep all times")
    add_overwrite(parser, "OUT")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    check_target(options.output, overwrite=options.overwrite)
    if is_same(options.output, options.file):
        raise ConfigError(f"{options.output}: found the recording itself, expected another file to write to")
    if options.shift == 0:
        raise ConfigError("--shift: found 0, expected another number, or --keep-times")
    if options.shift is not None and abs(options.shift) > 1 << 32:
        raise ConfigError(f"--shift: found {options.shift}, expected -4294967296 to 4294967296")
    profile = read_profile(options.profile) if options.profile else BASIC
    shift_ns = 0 if options.keep_times else None if options.shift is None else options.shift * NS_PER_S
    report = deidentify(
        options.file, options.output, profile, _key(options.secret), shift_ns=shift_ns, overwrite=options.overwrite
    )
    if options.json:
        print_json({"file": str(options.output), **report.to_dict()})
    else:
        _print(options.output, report)
    return int(report.may_miss_pictures)


def _key(path: Path | None) -> bytes:
    """Return the key of a file, or a random one.  Raises ConfigError."""
    if path is None:
        return os.urandom(32)
    try:
        key = read_bytes(path)
    except UnsupportedRecording as error:
        raise ConfigError(f"--secret: {error}") from None
    if len(key) < MIN_KEY_BYTES:
        raise ConfigError(f"--secret: {path}: found {len(key)} bytes, expected at least {MIN_KEY_BYTES}")
    return key


def _print(out: Path, report: Report) -> None:
    counts = f"{count_text(report.inputs, 'input')}, {count_text(report.outputs, 'output')} computed again"
    print_line(f"{out}: {counts}; verified")
    facts = report.to_dict()
    rows = [
        (row["rule"], f"{row['changes']:,}", row["option"], row["what"]) for row in facts["rules"] if row["changes"]
    ]
    print_line(*aligned([("rule", "changes", "option", "what"), *rows], left=1))
    for stream, number in facts["removed"].items():
        print_line(f"removed: {count_text(number, 'message')} of {stream}")
    for what, why in facts["left"].items():
        print_line(f"left: {what}: {why}")
    for place, question in report.unused.items():
        print_line(f"profile: {place} matches nothing in the recording" + (f"; {question}" if question else ""))
    for each in NOT_COVERED:
        print_line(f"not covered: {each}")
    for code, meaning in facts["options"].items():
        print_line(f"option {code}: {meaning}")
