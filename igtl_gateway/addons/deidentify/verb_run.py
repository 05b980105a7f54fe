"""``igtl-gateway deidentify``: a session without identity, as a new file that verifies."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from igtl_gateway.addon import NS_PER_S, ConfigError, UnsupportedRecording
from igtl_gateway.addon.terminal import aligned, count_text, counted, print_json, print_line
from igtl_gateway.addon.untrusted import is_same, read_bytes
from igtl_gateway.addon.writing import check_target
from igtl_gateway.addons.deidentify.profile import BASIC, read_profile
from igtl_gateway.addons.deidentify.pseudonyms import MIN_KEY_BYTES
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.addons.deidentify.rules import NOT_COVERED
from igtl_gateway.addons.deidentify.session import deidentify


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
        raise ConfigError(f"--secret: {path}: found {counted(len(key), 'byte')}, expected at least {MIN_KEY_BYTES}")
    return key


def _print(out: Path, report: Report) -> None:
    counts = f"{count_text(report.inputs, 'input')}, {count_text(report.outputs, 'output')} computed again"
    print_line(f"{out}: {counts}; verified")
    facts = report.to_dict()
    rows = [
        (row["rule"], f"{row['changes']:,}", row["option"], row["what"]) for row in facts["rules"] if row["changes"]
    ]
    print_line(*aligned([("rule", "changes", "option", "what"), *rows], left=1, text=True))
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
