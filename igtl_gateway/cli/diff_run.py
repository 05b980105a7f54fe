"""``igtl-gateway diff``: two recordings side by side."""

from __future__ import annotations

import argparse
import math

from igtl_gateway.app.comparison import RecordingDiff, compare_recordings
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.natural import natural
from igtl_gateway.base.quantities import by_count, count_text, duration_text, offset_text
from igtl_gateway.cli.losses import DIRECTIONS
from igtl_gateway.cli.terminal import aligned, print_json, print_line
from igtl_gateway.replay.compare import Tolerance
from igtl_gateway.replay.diff import StreamDiff

#: What the log calls a side → what people call it; of files of other programs only that it is ROS is known.
_SIDES = {kind.value: text for kind, text in DIRECTIONS.items()} | {"ros": "ROS"}


def run(options: argparse.Namespace) -> int:
    tolerance = Tolerance(options.tolerance_mm, options.tolerance_deg)
    for name, value in (("mm", tolerance.mm), ("deg", tolerance.deg)):
        if not 0 <= value < math.inf:
            raise ConfigError(f"--tolerance-{name}: found {value}, expected 0 or more")
    report = compare_recordings(options.one, options.other, options.streams, tolerance)
    if options.json:
        print_json(report.to_dict())
    else:
        _print(options, report)
    return 0 if report.equal else 1


def _print(options: argparse.Namespace, report: RecordingDiff) -> None:
    messages = sum(stream.messages for stream in report.streams)
    others = sum(stream.other_messages for stream in report.streams)
    print_line(f"A {options.one}: {count_text(messages, 'message')}")
    print_line(f"B {options.other}: {count_text(others, 'message')}")
    print_line(f"  gateway times: {_later(report.offset_ns)}")
    if report.stamp_offset_ns:
        print_line(f"  stamps in messages: {_later(report.stamp_offset_ns)}")
    for path in report.by_entry:
        print_line(f"  {path}: an older version, read entry by entry")
    print_line(*aligned(_table(report), left=1))
    for stream in report.streams:
        for line in _places(stream):
            print_line(f"{_name(stream)}: {line}")
    for line in report.unread:
        print_line(f"not compared: {line}")
    wrong = sum(not stream.equal for stream in report.streams)
    equal = "what is compared is equal" if report.unread else "equal"
    print_line(equal if report.equal else f"DIFFERENT: {count_text(wrong, 'stream')} of {len(report.streams):,}")


def _name(stream: StreamDiff) -> str:
    return f"{_SIDES.get(stream.kind, stream.kind)} {stream.stream}".rstrip()


def _later(offset_ns: float) -> str:
    return f"B is {duration_text(offset_ns)} {'later' if offset_ns > 0 else 'earlier'}" if offset_ns else "equal"


def _table(report: RecordingDiff) -> list[tuple[str, ...]]:
    """Return the rows, with the name of the side over its streams; columns without a number in any row are left out."""
    title = ("stream", "A", "B", "missing", "extra", "different", "mm", "deg", "offset", "jitter")
    found = [(stream, _row(stream, report)) for stream in sorted(report.streams, key=_order)]
    columns = [0, 1, 2, *(at for at in range(3, len(title)) if any(row[at] for _, row in found))]
    rows: list[tuple[str, ...]] = [title]
    side = ""
    for stream, row in found:
        if stream.kind != side and stream.stream:
            rows.append((_SIDES.get(stream.kind, stream.kind), *[""] * (len(title) - 1)))
        side = stream.kind
        rows.append(row)
    return [tuple(row[at] for at in columns) for row in rows]


def _order(stream: StreamDiff) -> tuple[int, list[tuple[int, str]]]:
    """What is about the bridge first, then the sides, each in the order of its names."""
    return (list(_SIDES).index(stream.kind) if stream.kind in _SIDES else -1), natural(stream.stream)


def _row(stream: StreamDiff, report: RecordingDiff) -> tuple[str, ...]:
    paired = stream.messages - stream.missing
    return (
        f"  {stream.stream}" if stream.stream else _name(stream),
        *(f"{number:,}" for number in (stream.messages, stream.other_messages)),
        *(f"{number:,}" if number else "" for number in (stream.missing, stream.extra)),
        f"{stream.different + stream.restamped:,}" if stream.different + stream.restamped else "",
        *(f"{number:.4g}" if number else "" for number in (stream.mm, stream.deg)),
        offset_text(stream.offset_ns - report.offset_ns) if paired else "",
        duration_text(stream.jitter_ns) if paired > 1 else "",
    )


def _places(stream: StreamDiff) -> list[str]:
    """Where the first differences are."""
    lines = [str(stream.first)] if stream.first else []
    lines += (
        [
            f"{count_text(stream.restamped, 'stamp')} {by_count(stream.restamped, 'differs', 'differ')} from the "
            "common offset"
        ]
        if stream.restamped
        else []
    )
    if stream.within:
        at = f"at message {stream.mm_at or stream.deg_at}"
        lines.append(f"{stream.within:,} differ within the tolerance, most {at}")
    lines += [f"first message missing in B: entry {stream.first_missing} of A"] if stream.missing else []
    lines += [f"first message only in B: entry {stream.first_extra}"] if stream.extra else []
    return lines
