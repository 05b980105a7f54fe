"""``igtl-gateway slice``: cut a part out of a recording."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from igtl_gateway.base.errors import ConfigError, GatewayError, UnsupportedRecording
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import count_text, moment_text, size_text
from igtl_gateway.base.untrusted.files import is_same
from igtl_gateway.base.version import __version__
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.gateway.log.marks import Mark
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.large_outputs import LargeOutputs
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.whole_files import written
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.exchange_summary import ExchangeSummary, incomplete
from igtl_gateway.replay.moment import check_part
from igtl_gateway.replay.recheck import message_counts
from igtl_gateway.replay.recorded_config import absent_sources, config_to_run
from igtl_gateway.replay.recorded_marks import carry_marks, marked_moment, marks_of
from igtl_gateway.replay.slice import Slice, SliceReport
from igtl_gateway.replay.slice_state import SliceWindow
from igtl_gateway.replay.source import check_recorded, without_messages


def run(options: argparse.Namespace) -> int:
    if options.out and options.output:
        raise ConfigError(f"found two files to write, {options.out} and {options.output}, expected one: -o OUT")
    if options.out:
        print_line(f"igtl-gateway slice: {options.out}: the new spelling is -o {options.out}", error=True)
        options.output = options.out
    if not options.output:
        raise ConfigError("found no file to write, expected -o OUT")
    with SessionFile.open(options.file) as file:
        if file.foreign:
            raise UnsupportedRecording(
                f"{options.file}: found an MCAP file of another program, expected a session of igtl-gateway"
            )
        if not file.entry_count:
            raise without_messages(file)
        if is_same(options.output, options.file):
            raise ConfigError(f"{options.output}: found the recording itself, expected another file to write to")
        marks = partial(marks_of, file)
        start_ns, end_ns = (
            None if text is None else marked_moment(text, file.start_ns, name, marks)
            for name, text in (("--start", options.start), ("--end", options.end))
        )
        check_part(start_ns, end_ns, file.start_ns, file.end_ns, is_empty_part=True)
        window = SliceWindow(
            file.start_ns if start_ns is None else start_ns,
            file.end_ns + 1 if end_ns is None else end_ns,
            tuple(options.streams),
        )
        # without any, the part would have the state of the gateway only
        for fault in check_recorded([file], options.streams):
            print_line(f"! {fault}", error=True)
        config = config_to_run(file.session, options.config)
        for absent in absent_sources(file, config) if options.config else ():
            print_line(f"? {absent}", error=True)
        part = Slice(
            file.entries, config, window, file.entries_starting_at, file.prologue(), file.columns, message_counts(file)
        )
        wanted = [mark for mark in marks() if _is_in(mark, window)]
        _write(file, part, window, options, has_marks=bool(wanted))
        # the window may begin before the first message in it, and end behind the last one
        carry_marks(options.output, _unlogged(wanted, options.output, window.start_ns), only_within=False)
        with SessionFile.open(options.output) as made:
            cut = list(incomplete(ExchangeSummary.of(made)))
        if options.json:
            facts = {**_facts(part.report), "incomplete": cut}
            print_json({"file": str(options.output), "bytes": options.output.stat().st_size, **facts})
        else:
            _print(options.output, part.report)
            for line in cut:
                print_line(f"? {line}")
    return 0


def _is_in(mark: Mark, window: SliceWindow) -> bool:
    return mark.time_ns < window.end_ns and window.start_ns <= mark.last_ns


def _unlogged(marks: Sequence[Mark], part: Path, start_ns: int) -> list[Mark]:
    """Return the marks that the log of a part lacks: added ones, and those of its time that were noted later."""
    with SessionFile.open(part) as file:
        known = {(mark.label, mark.time_ns) for mark in marks_of(file, added=False)}
    return [
        mark
        for mark in marks
        if mark.is_added or (mark.time_ns >= start_ns and (mark.label, mark.time_ns) not in known)
    ]


def _write(
    file: SessionFile, part: Slice, window: SliceWindow, options: argparse.Namespace, *, has_marks: bool
) -> None:
    qos = {(channel.topic, channel.type): channel.qos for channel in file.channels}

    def qos_of(topic: str, ros_type: str) -> Qos | None:
        return qos.get((topic, ros_type))

    facts = {
        "slice_of": file.path.name,
        "slice_start_ns": str(window.start_ns),
        "slice_end_ns": str(window.end_ns),
        "slice_streams": json.dumps(window.globs),
        "sliced_by": __version__,
    }
    if options.config:
        facts[layout.CONFIGURATION_KEY] = json.dumps(config_to_run(file.session, options.config).to_dict())
    # a slice begins at its own beginning, whatever it was cut from
    own = (layout.PART_KEY, layout.PREVIOUS_KEY, layout.SNAPSHOT_KEY, layout.TRIGGER_KEY)
    facts = {**{key: value for key, value in file.session.items() if key not in own}, **facts}
    with written(options.output, overwrite=options.overwrite) as place:
        has_digests = file.has_digests and part.follows
        writer = SessionWriter(
            place, facts, qos_of=qos_of, definition_of=file.definition_of, compression="zstd", prologue=part.before(),
            outputs=LargeOutputs("digest") if has_digests else None,
        )  # fmt: skip
        for each in file.beside():
            writer.add_beside(each)
        part.write(writer)
        losses = {} if file.foreign else layout.declared_losses(file.ledger)
        writer.close({"streams": part.report.ledger, **losses})
        if not (part.report.inputs or part.report.outputs or has_marks):
            begin, end = (
                moment_text(each - file.start_ns) for each in (window.start_ns, min(window.end_ns, file.end_ns))
            )
            where = f"{', '.join(window.globs) or 'any stream'} from {begin} to {end}"
            raise GatewayError(f"{file.path}: found no message of {where}, expected at least one")


def _facts(report: SliceReport) -> dict[str, object]:
    return {
        "prologue": report.prologue,
        "depth": report.depth.value,
        "inputs": report.inputs,
        "outputs": report.outputs,
        "computed": report.computed,
        "differing": report.differing,
        "compiled": report.compiled,
    }


def _print(out: Path, report: SliceReport) -> None:
    print_line(
        f"{out}: {count_text(report.inputs, 'input')} and {count_text(report.outputs, 'output')}, "
        f"{size_text(out.stat().st_size)}; "
        f"before it {count_text(report.prologue, 'input')} with the state at its beginning"
    )
    if report.computed:
        print_line(
            f"computed: the outputs of {count_text(report.computed, 'input')} depend on other streams; "
            "the file has the outputs that this version computes without them"
        )
    elif report.differing:
        print_line(
            f"copied as recorded, but this version computes other bytes: {count_text(report.differing, 'output')}; "
            "see `igtl-gateway verify` of the whole recording"
        )
