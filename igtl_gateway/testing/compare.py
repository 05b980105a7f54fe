"""Comparison of two sessions, stream by stream, with a description of the differences.

The messages of each stream are compared in their order: first the bytes, and if these differ, the decoded values
(``replay.compare``).  Gateway times, link numbers and notes are not compared: they differ from run to run.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from igtl_gateway.base.globs import matches
from igtl_gateway.base.near import unmatched
from igtl_gateway.base.quantities import counted
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.stream_units import StreamUnits
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.replay.compare import LeafDecoder, Tolerance, Undecodable, compare_values
from igtl_gateway.testing.gateway import ManualGateway, recorded_config

#: A recording, a gateway on manual time, or the entries of a session.
Session = Path | str | ManualGateway | Iterable[Entry]

#: Maximum number of differences that are listed; the others are counted.
MAX_LISTED = 10

_KINDS = {
    Kind.IGTL_IN: "OpenIGTLink in",
    Kind.IGTL_OUT: "OpenIGTLink out",
    Kind.ROS_IN: "ROS in",
    Kind.ROS_OUT: "ROS out",
}

_Stream = tuple[Kind, str]


@dataclass(frozen=True, slots=True)
class _Rules:
    """What is left out or tolerated."""

    streams: Sequence[str]  #: globs of streams that are left out
    fields: Sequence[str]  #: globs of fields that are left out
    tolerance: Tolerance


@dataclass(slots=True)
class _Side:
    """The messages of a session by stream, the names of those that are left out, and the decoder."""

    name: str
    decoder: LeafDecoder
    streams: dict[_Stream, list[Entry]] = field(default_factory=dict)
    ignored: set[str] = field(default_factory=set)


def assert_session_equal(
    expected: Session,
    found: Session,
    *,
    ignore: Sequence[str] = (),
    ignore_fields: Sequence[str] = (),
    tolerance_mm: float = 0.0,
    tolerance_deg: float = 0.0,
) -> None:
    """Fail unless both sessions have the same streams with the same messages.

    Args:
        ignore: globs of streams that are left out: topics or ``TYPE/device`` (``*`` one level, ``**`` any).
        ignore_fields: globs of fields that may differ, such as ``"timestamp"`` or ``"header.stamp"``; their paths are
            those that a failure names.
        tolerance_mm: tolerance of positions and points in millimetres, independent of their unit.
        tolerance_deg: tolerance of rotations in degrees.

    A glob of ``ignore`` that matches no stream of either session is a warning.

    Raises AssertionError with the first differences; UnsupportedRecording or DamagedRecording.
    """
    rules = _Rules(ignore, ignore_fields, Tolerance(tolerance_mm, tolerance_deg))
    one, other = _side(expected, rules), _side(found, rules)
    names = {channel for side in (one, other) for _, channel in side.streams} | one.ignored | other.ignored
    for glob in ignore:
        if not any(matches(glob, name) for name in names):
            warnings.warn(f"ignore {glob}: {unmatched(glob, names, 'stream of either session')}", stacklevel=2)
    differences: list[str] = []
    for stream in sorted(one.streams.keys() | other.streams.keys(), key=lambda stream: (stream[0].value, stream[1])):
        differences += _differences(stream, one, other, rules)
    if differences:
        more = f"\n  … and {len(differences) - MAX_LISTED} more" if len(differences) > MAX_LISTED else ""
        lines = "".join(f"\n  {line}" for line in differences[:MAX_LISTED])
        raise AssertionError(f"sessions differ ({one.name} was expected, {other.name} found):{lines}{more}")


def _side(session: Session, rules: _Rules) -> _Side:
    if isinstance(session, str | Path):
        with SessionFile.open(session) as file:
            config = recorded_config(file)
            side = _Side(str(session), _decoder(file.definitions, config))
            _add_entries(file.entries(), rules, side)
        return side
    entries = session.log if isinstance(session, ManualGateway) else list(session)
    types = {entry.type for entry in entries if entry.kind in (Kind.ROS_IN, Kind.ROS_OUT)}
    finder = RosTypes()
    definitions = {name: found.text(name) for name in sorted(types) if (found := finder.find(name))}
    side = _Side(
        "the gateway of the test" if isinstance(session, ManualGateway) else "the entries of the test",
        _decoder(definitions, session.config if isinstance(session, ManualGateway) else Config()),
    )
    _add_entries(entries, rules, side)
    return side


def _decoder(definitions: dict[str, str], config: Config) -> LeafDecoder:
    return LeafDecoder(definitions, StreamUnits(config))


def _add_entries(entries: Iterable[Entry], rules: _Rules, side: _Side) -> None:
    for entry in entries:
        if entry.kind in _KINDS:
            if any(matches(glob, entry.channel) for glob in rules.streams):
                side.ignored.add(entry.channel)
            else:
                side.streams.setdefault((entry.kind, entry.channel), []).append(entry)


def _differences(stream: _Stream, one: _Side, other: _Side, rules: _Rules) -> list[str]:
    """Return the differences of a stream, one line each."""
    name = f"{_KINDS[stream[0]]} {stream[1]}"
    expected, found = one.streams.get(stream, []), other.streams.get(stream, [])
    differences = []
    if len(expected) != len(found):
        differences.append(f"{name}: {counted(len(expected), 'message')} expected, {len(found)} found")
    for number, (left, right) in enumerate(zip(expected, found, strict=False), start=1):
        if left.type == right.type and left.data() == right.data():
            continue
        difference: str | None = f"type {left.type} expected, {right.type} found"
        if left.type == right.type:
            difference = _difference(_leaves(one, left, rules), _leaves(other, right, rules), rules)
        if difference is None:
            difference = _first_byte(left.data(), right.data())
        if difference:
            differences.append(f"{name}, message {number} of {len(expected)}: {difference}")
    return differences


def _leaves(side: _Side, entry: Entry, rules: _Rules) -> Iterator[tuple[str, Any]]:
    """Yield the paths and values of a message, without the fields that are left out."""
    for path, value in side.decoder.leaves(entry):
        if not any(matches(glob, path) for glob in rules.fields):
            yield path, value


def _difference(one: Iterator[tuple[str, Any]], other: Iterator[tuple[str, Any]], rules: _Rules) -> str | None:
    """Return the first difference beyond the tolerance, ``""`` without one, None if the bytes must be compared."""
    try:
        delta = compare_values(one, other, rules.tolerance)
    except Undecodable:
        return None
    if delta.field:
        measure = f" ({delta.measure})" if delta.measure else ""
        return f"{delta.field}: {_value_text(delta.one)} expected, {_value_text(delta.other)} found{measure}"
    late_ns = next((ns for ns in delta.stamps_ns if ns), 0)
    if late_ns:
        return f"stamp: found {late_ns:,} ns later than expected"
    exact = not (rules.fields or rules.tolerance.mm or rules.tolerance.deg)
    return None if exact else ""


def _first_byte(one: bytes, other: bytes) -> str:
    at = next((at for at, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
    return f"byte {at}: {one[at : at + 8].hex(' ') or 'end'} expected, {other[at : at + 8].hex(' ') or 'end'} found"


def _value_text(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:70]}… ({counted(len(text), 'character')})"
