"""Comparison of two recordings: their files, and the differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.quantities import count_text, counted
from igtl_gateway.record.sessionfile.columns import Unfit
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.compare import LeafDecoder, Tolerance
from igtl_gateway.replay.diff import DiffInput, StreamDiff, diff
from igtl_gateway.replay.exchange_summary import exchange_entries
from igtl_gateway.replay.random_ids import numbered_ids
from igtl_gateway.replay.recorded_config import config_to_run, units_of
from igtl_gateway.replay.source import check_recorded, matches_any, without_messages


@dataclass(frozen=True, slots=True)
class RecordingDiff:
    """The differences of two recordings.

    Attributes:
        one, other: the recordings.
        streams: differences by kind and stream, also of equal streams.
        stamp_offset_ns: most frequent offset of the stamps in the messages of the other recording.
        offset_ns: mean offset of its gateway times.
        by_entry: the recordings that could not be read in columns, only entry by entry: those of older versions.
        unread: topics that are not compared because they cannot be read, and why.
    """

    one: Path
    other: Path
    streams: tuple[StreamDiff, ...]
    stamp_offset_ns: int
    offset_ns: float
    by_entry: tuple[Path, ...] = ()
    unread: tuple[str, ...] = ()

    def __repr__(self) -> str:
        different = [stream.stream or stream.kind for stream in self.streams if not stream.equal]
        found = f"different: {', '.join(different)}" if different else "all equal"
        return f"<RecordingDiff {self.one} {self.other}: {counted(len(self.streams), 'stream')}, {found}>"

    @property
    def equal(self) -> bool:
        """Whether all streams are equal, within the tolerance."""
        return all(stream.equal for stream in self.streams)

    def to_dict(self) -> dict[str, Any]:
        """Return the differences as JSON values, as ``igtl-gateway diff --json`` prints them."""
        facts = {
            "one": str(self.one),
            "other": str(self.other),
            "equal": self.equal,
            "stamp_offset_ns": self.stamp_offset_ns,
            "offset_ns": self.offset_ns,
            "streams": [{**asdict(stream), "equal": stream.equal} for stream in self.streams],
        }
        if self.by_entry:
            facts["by_entry"] = [str(path) for path in self.by_entry]
        if self.unread:
            facts["unread"] = list(self.unread)
        found: dict[str, Any] = _json_value(facts)
        return found


def compare_recordings(one: Path, other: Path, streams: Sequence[str], tolerance: Tolerance) -> RecordingDiff:
    """Compare two recordings; one of them may be of another program.

    Args:
        one, other: the recordings.
        streams: globs of the streams to compare; empty = all, with notes.
        tolerance: differences that count as equal.

    Raises UnsupportedRecording, DamagedRecording, ConfigError if no stream matches, and GatewayError if nothing of
    a recording can be read.
    """
    with SessionFile.open(one) as first, SessionFile.open(other) as second:
        return compare_sessions(first, second, streams, tolerance)


def compare_sessions(
    one: SessionFile, other: SessionFile, streams: Sequence[str], tolerance: Tolerance
) -> RecordingDiff:
    """Compare two open recordings; see `compare_recordings`."""
    for file in (one, other):
        if not file.entry_count and any(each.count for each in file.skipped):
            raise without_messages(file)  # "equal" would be about nothing
    if faults := check_recorded([one, other], streams, "streams"):
        raise ConfigError("; ".join(faults))  # "equal" would be about fewer streams than were asked for
    foreign = one.foreign is not other.foreign
    sides = _side(one), _side(other)
    report = diff(*sides, globs=streams, tolerance=tolerance, foreign=foreign)
    if streams and not report.streams:  # nothing compared is not equal
        raise ConfigError(f"streams: found {', '.join(map(repr, streams))}, expected a stream of one of the recordings")
    by_entry = tuple(file.path for file, side in zip((one, other), sides, strict=True) if side.columns is None)
    unread = tuple(
        f"{file.path}: {each.topic}: {count_text(each.count, 'message')}, {each.why}"
        for file in (one, other)
        for each in file.skipped
        if each.count and matches_any(each.topic, streams)
    )
    return RecordingDiff(
        one.path, other.path, tuple(report.streams), report.stamp_offset_ns, report.offset_ns, by_entry, unread
    )


def _side(file: SessionFile) -> DiffInput:
    units = units_of(config_to_run(file.session), file)
    decoder = LeafDecoder(file.definitions, units, numbered_ids(exchange_entries(file)))
    try:
        return DiffInput(file.entries(), decoder, file.columns())
    except Unfit:
        return DiffInput(file.entries(), decoder)


def _json_value(value: Any) -> Any:
    """JSON has no infinity."""
    match value:
        case dict():
            return {key: _json_value(part) for key, part in value.items()}
        case list():
            return [_json_value(part) for part in value]
        case float() if not math.isfinite(value):
            return str(value)
        case _:
            return value
