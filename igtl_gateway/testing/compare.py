"""Whether two sessions say the same, stream by stream, and in words where they do not.

Compared are the messages of each stream in their order: bytes first, and where these differ the decoded fields.
When a message was recorded, by whom it came (numbers of links) and notes are not compared: they differ from run to
run.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.config import matches
from igtl_gateway.errors import GatewayError
from igtl_gateway.replay.mcap_reader import SessionFile
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.testing.rostypes import unpack
from igtl_gateway.wire import describe

#: A recording, a gateway on manual time, or the entries of a session.
Session = Path | str | ManualGateway | Iterable[Entry]

#: So many differences are told; all are counted.
MAX_TOLD = 10

_KINDS = {
    Kind.IGTL_IN: "OpenIGTLink in",
    Kind.IGTL_OUT: "OpenIGTLink out",
    Kind.ROS_IN: "ROS in",
    Kind.ROS_OUT: "ROS out",
}
_IGTL = (Kind.IGTL_IN, Kind.IGTL_OUT)
#: What follows from the rest of a message: no difference of its own.
_DERIVED = ("crc", "body_size", "content_size")

_Stream = tuple[Kind, str]
_NOTHING = "nothing"


def assert_session_equal(
    expected: Session,
    found: Session,
    *,
    ignore: Sequence[str] = (),
    ignore_fields: Sequence[str] = (),
    tolerance: float = 0.0,
) -> None:
    """Fail unless both sessions have the same streams with the same messages.

    Args:
        ignore: globs of streams that are left out: topics or ``TYPE/device`` (``*`` one level, ``**`` any).
        ignore_fields: globs of fields that may differ, such as ``"timestamp.*"`` or ``"header.stamp_ns"``; their paths
            are those that a failure names.
        tolerance: how far numbers with a fraction may be apart, in the unit of the field.

    Raises AssertionError with the first differences; UnsupportedRecording or DamagedRecording.
    """
    one, other = _streams(expected, ignore), _streams(found, ignore)
    told: list[str] = []
    for stream in sorted(one.keys() | other.keys(), key=lambda stream: (stream[0].value, stream[1])):
        told += _stream_differences(
            f"{_KINDS[stream[0]]} {stream[1]}", one.get(stream, []), other.get(stream, []), ignore_fields, tolerance
        )
    if told:
        more = f"\n  … and {len(told) - MAX_TOLD} more" if len(told) > MAX_TOLD else ""
        lines = "".join(f"\n  {line}" for line in told[:MAX_TOLD])
        raise AssertionError(f"sessions differ ({_name(expected)} was expected, {_name(found)} found):{lines}{more}")


def _streams(session: Session, ignore: Sequence[str]) -> dict[_Stream, list[Entry]]:
    """The messages of a session by stream."""
    streams: dict[_Stream, list[Entry]] = {}
    for entry in _entries(session):
        if entry.kind in _KINDS and not any(matches(glob, entry.channel) for glob in ignore):
            streams.setdefault((entry.kind, entry.channel), []).append(entry)
    return streams


def _entries(session: Session) -> Iterator[Entry]:
    if isinstance(session, str | Path):
        with SessionFile.open(session) as file:
            yield from file.entries()
    else:
        yield from session.log if isinstance(session, ManualGateway) else session


def _name(session: Session) -> str:
    return str(session) if isinstance(session, str | Path) else "the session of the test"


def _stream_differences(
    name: str, one: list[Entry], other: list[Entry], ignored: Sequence[str], tolerance: float
) -> list[str]:
    told = []
    if len(one) != len(other):
        told.append(f"{name}: {len(one)} messages expected, {len(other)} found")
    for number, (expected, found) in enumerate(zip(one, other, strict=False), start=1):
        difference = _difference(expected, found, ignored, tolerance)
        if difference:
            told.append(f"{name}, message {number} of {len(one)}: {difference}")
    return told


def _difference(expected: Entry, found: Entry, ignored: Sequence[str], tolerance: float) -> str:
    """The first field in which two messages of a stream differ; ``""`` if there is none that counts."""
    if expected.type != found.type:
        return f"type {expected.type} expected, {found.type} found"
    one, other = expected.data(), found.data()
    if one == other:
        return ""
    try:
        pairs = zip_longest(_fields(expected), _fields(found), fillvalue=("", _NOTHING))
        for (path, value), (other_path, other_value) in pairs:
            if path != other_path:
                return f"{path or other_path}: {_shown(value)} expected, {other_path or 'nothing'} found"
            if not any(matches(glob, path) for glob in ignored) and not _same(value, other_value, tolerance):
                return f"{path}: {_shown(value)} expected, {_shown(other_value)} found"
    except GatewayError:
        pass  # not decodable: the bytes themselves are the answer
    else:
        if ignored or tolerance:
            return ""
    at = next((at for at, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
    return f"byte {at}: {one[at : at + 8].hex(' ') or 'end'} expected, {other[at : at + 8].hex(' ') or 'end'} found"


def _fields(entry: Entry) -> Iterator[tuple[str, Any]]:
    """Every leaf of a decoded message with its path, as ``content.matrix[0][3]``."""
    if entry.kind in _IGTL:
        told = describe(entry.data())
        if told["crc_ok"]:
            told = {name: value for name, value in told.items() if name not in _DERIVED}
        return _flat(told, "")
    return _flat(unpack(entry.type, entry.data()), "")


def _flat(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if dataclasses.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _flat(part, f"{path}.{name}" if path else name)
    elif isinstance(value, np.ndarray):
        yield from _flat(value.tolist(), path)
    elif isinstance(value, list | tuple):
        yield f"{path}.length", len(value)
        for index, part in enumerate(value):
            yield from _flat(part, f"{path}[{index}]")
    else:
        yield path, bytes(value) if isinstance(value, memoryview) else value


def _same(one: Any, other: Any, tolerance: float) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= tolerance or one == other or (math.isnan(one) and math.isnan(other))
    return bool(one == other)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:70]}… ({len(text)} characters)"
