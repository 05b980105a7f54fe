"""What ``merge`` and ``info`` print of a merged session."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from igtl_gateway.base.quantities import clock_text, count_text, duration_text
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.cli.terminal import aligned, print_line
from igtl_gateway.record.sessionfile.merged import Method


def print_merge(facts: Mapping[str, Any]) -> None:
    """Print the parts of a merged session, the offsets of their clocks, and the latencies between them."""
    rows = [("part", "file", "messages", "clock ahead by", "between", "drift", "")]
    for part in facts["parts"]:
        clock = part["clock"]
        rows.append(
            (
                part["name"],
                part["file"],
                f"{part['messages']:,}",
                _offset(clock["offset_s"]),
                f"{_offset(clock['low_s'])} and {_offset(clock['high_s'])}",
                f"{clock['drift_ppm']:+.2f} ppm" if clock["drift_ppm"] else "",
                _method(clock),
            )
        )
    print_line(*aligned(rows, left=2, text=True))
    if facts["latencies"]:
        print_line("latencies of the messages that cross:")
        crossing = [("from", "to", "stream", "messages", "min", "median", "99 %", "±")]
        for row in facts["latencies"]:
            numbers = (row["min_ms"], row["p50_ms"], row["p99_ms"], row["error_ms"])
            crossing.append((row["from"], row["to"], row["stream"], f"{row['messages']:,}", *map(_latency, numbers)))
        print_line(*aligned(crossing, left=3))
    for line in _remarks(facts):
        print_line(line)


def _remarks(facts: Mapping[str, Any]) -> Iterator[str]:
    for text in facts["left_out"]:
        yield f"left out, as it contradicts the other streams: {text}"
    for text in facts.get("reported", ()):
        yield f"reported by {text}"
    for part in facts["parts"]:
        if changes := _changes(part["clock"]):
            yield (
                f"the clock of {part['name']} was set, or its rate changed, {count_text(changes, 'time')}: "
                "the offset is that in the middle of the session"
            )
        if part.get("sealed_by"):
            yield (
                f"{part['file']} is sealed.  Its seal is about the bytes of that file and is not in this one: "
                f"keep the file; its SHA-256 is {part['sha256']}"
            )


def _changes(clock: Mapping[str, Any]) -> int:
    """Return how often the offset of a clock changed; 0 where a damaged file has no lines."""
    chain = clock.get("chain")
    return sum(len(lines) - 1 for lines in chain if isinstance(lines, list) and lines) if isinstance(chain, list) else 0


def _method(clock: Mapping[str, Any]) -> str:
    via = f", by {', '.join(clock['via'])}" if clock["via"] else ""
    return Method[clock["method"].upper()].value + via


def _offset(seconds: float | None) -> str:
    return "?" if seconds is None else clock_text(seconds * NS_PER_S)


def _latency(value: float | None) -> str:
    return "?" if value is None else ("-" if value < 0 else "") + duration_text(value * NS_PER_MS)
