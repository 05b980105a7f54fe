"""``igtl-gateway verify``: check that the outputs of a recording follow from its inputs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

from igtl_gateway.app.sealing import UNTIMED, SealVerification, verify_seal
from igtl_gateway.app.verification import RECORDED, Verification, verify_parts, verify_recording
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.natural import natural
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.systems.processes import usable_cpus
from igtl_gateway.cli.common import print_damaged_indexes, utc_text
from igtl_gateway.cli.terminal import LiveProgress, print_json, print_line
from igtl_gateway.record.sessionfile.seal_check import CHANGED, CUT, SEALED, UNSEALED, UNTRUSTED, SealReport
from igtl_gateway.record.sessionfile.side_file import SIDE_FILE

_STATES = {
    SEALED: "sealed: every byte is as it was sealed",
    CUT: "CUT: the end is missing",
    CHANGED: "CHANGED",
    UNSEALED: "NOT SEALED: it has no seal",
    UNTRUSTED: "NOT TRUSTED: no seal is of a trusted key",
    UNTIMED: "NOT TIME-STAMPED: no given authority confirms when it was sealed",
}


def run(options: argparse.Namespace) -> int:
    if options.trusted and not options.seal:
        raise ConfigError("--trusted: found no --seal, expected it with trusted keys")
    if options.tsa and not options.seal:
        raise ConfigError("--tsa: found no --seal, expected it with certificates of time-stamp authorities")
    if options.seal:
        return _run_seal(options)
    progress = LiveProgress()
    on_progress = progress if progress.is_wanted else None
    try:
        if parts := verify_parts(options.file, options.config, reference=options.reference, on_progress=on_progress):
            progress.end()
            return _run_parts(parts, options)
        result = verify_recording(
            options.file,
            options.config,
            reference=options.reference,
            workers=usable_cpus(),
            on_progress=on_progress,
        )
    finally:
        progress.end()
    if options.json:
        print_json(result.to_dict())
    else:
        _print(result, options.all)
        print_damaged_indexes(options.file, result.damaged_indexes)
    return 0 if result.good and not result.damaged_indexes else 1


def _run_parts(parts: Sequence[Verification], options: argparse.Namespace) -> int:
    """Print the results of the parts of a merged session."""
    good = all(part.good for part in parts)
    if options.json:
        print_json({"file": str(options.file), "good": good, "parts": [part.to_dict() for part in parts]})
        return 0 if good else 1
    for part in parts:
        _print(part, options.all)
    return 0 if good else 1


def _run_seal(options: argparse.Namespace) -> int:
    if options.config or options.all:
        raise ConfigError("--seal: found --config or --all, expected neither: it does not compute outputs")
    result = verify_seal(options.file, options.trusted, options.tsa)
    if options.json:
        print_json(result.to_dict())
    else:
        _print_seal(result)
    return 0 if result.good else 1


def _print_seal(result: SealVerification) -> None:
    for report in result.parts:
        print_line(f"{report.file}: {_STATES[report.state]}")
        for line in _seal_lines(report):
            print_line(f"  {line}")
    if len(result.parts) > 1 or result.problem:
        count = count_text(len(result.parts), "part")
        print_line(f"{result.file}: {count}: {_STATES[result.state]}")
        if result.problem:
            print_line(f"  {result.problem}")
        if result.side_file:
            print_line(f"  {SIDE_FILE}: {result.side_file}")
    for path in result.added:
        print_line(f"{path}: NOT SEALED: no seal covers marks that were added later")


def _seal_lines(report: SealReport) -> Iterator[str]:
    """Yield what is known about the seals of a file."""
    if report.key:
        trust = {
            None: "not compared with trusted keys: give --trusted KEYS",
            True: "trusted" + (", as a trusted key introduces it" if report.introduced else ""),
            False: "not trusted",
        }[report.trusted]
        yield f"key       {report.key} ({trust})"
    if not report.seals:
        return
    part = f", part {report.part}" if report.part or report.last_part is False else ""
    first, last = (utc_text(ns) for ns in (report.first_ns, report.last_ns))
    yield f"seals     {report.seals:,}, {first} to {last} by the clock of the recorder"
    yield f"recording {report.recording}{part}"
    if report.first:
        found = report.first
        number = f" {found.number}" if found.number else ""
        entries = f", entries {found.first_entry:,} to {found.last_entry:,}" if found.first_entry >= 0 else ""
        yield f"first     {found.kind}{number} {found.what}: bytes {found.begin:,} to {found.end:,}{entries}"
        if found.text:
            yield f"          {found.text}"
    if report.state != SEALED:
        entry = f", up to entry {report.sealed_entry:,}" if report.sealed_entry >= 0 else ""
        yield f"intact    the first {count_text(report.sealed_bytes, 'byte')}{entry}"
    if report.state == CUT:
        yield f"unsealed  the {count_text(report.unsealed_bytes, 'byte')} behind them"
    if stamp := report.time_stamp:
        if not stamp.checked:
            yield "time      there is a time stamp, which was not checked: give --tsa CERTS"
        else:
            yield f"time      {stamp.problem or f'{utc_text(stamp.time_ns)}, confirmed by {stamp.authority}'}"
    if report.last_seal:
        yield f"last seal {report.last_seal}"


def _print(result: Verification, everything: bool) -> None:
    versions = f"recorded by igtl-gateway {result.recorded_by or '(unknown)'}, verified by {result.verified_by}"
    configuration = "the recorded configuration" if result.config == RECORDED else result.config
    print_line(f"{result.file}: {versions} with {configuration}")
    for each in result.absent:
        print_line(f"? {each}")
    how = f", {result.compiled:,} of them by compiled conversions" if result.compiled else ""
    inputs, outputs = count_text(result.inputs, "input"), count_text(result.outputs, "output")
    print_line(f"  {inputs} processed{how}, {outputs} compared")
    if result.good and not result.outputs:
        print_line("nothing to verify: no outputs recorded, none computed")
    elif result.good:
        print_line(f"verified: all {count_text(result.equal, 'output')} equal, byte for byte")
    else:
        print_line(f"DIFFERENT: {count_text(result.differing, 'output')} of {result.outputs:,}")
        for difference in result.firsts.values() if everything else result.differences[:1]:
            print_line(f"  {difference}")
        for stream, number in sorted(result.by_stream.items(), key=lambda item: natural(item[0])):
            print_line(f"  {stream}: {count_text(number, 'difference')}")
        if result.advice:
            print_line(f"outputs that are digests: {result.advice}")
    for number, thing, things, why in (
        (result.lost, "output", "", "that the recording has lost"),
        (result.missing, "further entry", "further entries", "that the recording has lost or not selected"),
        (result.orphans, "output", "", "whose input is one of these"),
        (result.late, "note", "", "of a stream whose first message is one of these"),
    ):
        if number:
            print_line(f"not verified: {count_text(number, thing, things)} {why}")
