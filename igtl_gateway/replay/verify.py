"""Verification: feed the recorded inputs to the gateway and compare what it says with what was said that day.

What the gateway produced is compared byte by byte; of notes the code, level, stream and links count, not the
wording.  Where bytes differ, both are decoded and the first field that differs is named.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from igtl_gateway.buffers import Buffer
from igtl_gateway.config import Config
from igtl_gateway.convert.igtl_msgs import LinkStatusList, Metadata, RawMessage
from igtl_gateway.convert.table import TO_ROS
from igtl_gateway.errors import GatewayError
from igtl_gateway.gateway import gateway_of
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Note
from igtl_gateway.wire import describe

#: So many differences are kept in full; all are counted.
MAX_KEPT = 100

#: What the gateway publishes: by conversion, and of its own.
_MESSAGES = {row.message.TYPE: row.message for row in TO_ROS} | {
    kind.TYPE: kind for kind in (LinkStatusList, Metadata, RawMessage)
}


@dataclass(frozen=True, slots=True)
class Difference:
    """One output that is not what was recorded.

    Attributes:
        seq: entry number of the output.
        cause: entry number of the input that caused it.
        stream: its channel.
        field: path of the first field that differs, or ``"message"`` where one side has none.
        recorded: value in the recording.
        computed: value today.
    """

    seq: int
    cause: int
    stream: str
    field: str
    recorded: Any
    computed: Any

    def __str__(self) -> str:
        return (
            f"entry {self.seq} (caused by entry {self.cause}), {self.stream}: {self.field} "
            f"was {_shown(self.recorded)}, is now {_shown(self.computed)}"
        )


@dataclass(slots=True)
class Report:
    """The outcome: ``good`` if every output is the same and nothing is missing that should be there."""

    inputs: int = 0
    outputs: int = 0
    equal: int = 0
    lost: int = 0
    differing: int = 0
    by_stream: dict[str, int] = field(default_factory=dict)
    differences: list[Difference] = field(default_factory=list)

    @property
    def good(self) -> bool:
        return self.differing == 0

    def add(self, difference: Difference) -> None:
        self.differing += 1
        self.by_stream[difference.stream] = self.by_stream.get(difference.stream, 0) + 1
        if len(self.differences) < MAX_KEPT:
            self.differences.append(difference)


def verify(entries: Iterable[Entry], config: Config, declared_lost: int = 0, prologue: Iterable[Entry] = ()) -> Report:
    """Compare the recorded outputs with those that ``config`` gives today for the recorded inputs.

    Args:
        entries: the recording, in order.
        config: the configuration to run with, usually the recorded one.
        declared_lost: how many entries the recorder says that it dropped; so many missing outputs are excused.
        prologue: inputs before the recording, whose outputs are not compared.
    """
    gateway, report = gateway_of(config), Report()
    for entry in prologue:
        gateway.handle(entry)
    expected: deque[Entry] = deque()
    cause = 0
    for entry in entries:
        if entry.kind.is_input:
            _miss(expected, cause, report)
            report.inputs += 1
            cause = entry.seq
            expected.extend(gateway.handle(entry))
            continue
        report.outputs += 1
        while expected and expected[0].seq < entry.seq:
            _miss_one(expected.popleft(), cause, report)
        if expected and expected[0].seq == entry.seq:
            difference = compare(entry, expected.popleft(), cause)
        else:
            difference = Difference(entry.seq, cause, _name(entry), "message", _kind(entry), "nothing")
        if difference:
            report.add(difference)
        else:
            report.equal += 1
    _miss(expected, cause, report)
    _excuse(report, declared_lost)
    return report


def _miss(expected: deque[Entry], cause: int, report: Report) -> None:
    while expected:
        _miss_one(expected.popleft(), cause, report)


def _miss_one(entry: Entry, cause: int, report: Report) -> None:
    report.lost += 1
    report.add(Difference(entry.seq, cause, _name(entry), "message", "nothing", _kind(entry)))


def _excuse(report: Report, declared_lost: int) -> None:
    """Outputs that the recorder said it dropped are losses of that day, not differences of today."""
    if report.lost and report.lost <= declared_lost and report.lost == report.differing:
        report.differing = 0
        report.by_stream.clear()
        report.differences.clear()


def compare(recorded: Entry, computed: Entry, cause: int) -> Difference | None:
    """The first difference of two outputs, None if they are the same."""

    def differ(what: str, one: Any, other: Any) -> Difference:
        return Difference(recorded.seq, cause, _name(recorded), what, one, other)

    if recorded.kind is Kind.NOTE and computed.kind is Kind.NOTE:
        one, other = Note.unpack(recorded.data()), Note.unpack(computed.data())
        for what in ("code", "level", "stream"):
            if getattr(one, what) != getattr(other, what):
                return differ(f"note.{what}", getattr(one, what), getattr(other, what))
    for what in ("kind", "channel", "type", "links", "stamp_ns", "source_ns"):
        if getattr(recorded, what) != getattr(computed, what):
            return differ(what, getattr(recorded, what), getattr(computed, what))
    if recorded.kind is Kind.NOTE or recorded.data() == computed.data():
        return None
    return differ(*_first_field(recorded, computed))


def _first_field(recorded: Entry, computed: Entry) -> tuple[str, Any, Any]:
    """Path and values of the first field in which two payloads of one type differ."""
    one, other = recorded.data(), computed.data()
    try:
        for (path, value), (other_path, other_value) in zip(
            _fields(recorded, one), _fields(computed, other), strict=False
        ):
            if path != other_path:
                return path, value, f"nothing ({other_path} follows)"
            if value != other_value and not (_is_nan(value) and _is_nan(other_value)):
                return path, value, other_value
    except GatewayError:
        pass  # not decodable: the bytes themselves are the answer
    offset = next((at for at, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
    return f"byte {offset}", one[offset : offset + 8].hex(), other[offset : offset + 8].hex()


def _fields(entry: Entry, data: Buffer) -> Iterator[tuple[str, Any]]:
    if entry.kind is Kind.IGTL_OUT:
        told = describe(data)
        # errors, sizes and CRC follow from the content: name the cause before the consequence
        for derived in ("error", "crc", "crc_ok", "body_size", "content_size"):
            if derived in told:
                told[derived] = told.pop(derived)
        return _flat(told, "")
    message = _MESSAGES.get(entry.type)
    return _flat(message.unpack(data), "") if message else iter(())


def _flat(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Every leaf of nested values with its path, as ``content.matrix[0][3]``."""
    if dataclasses.is_dataclass(value):
        value = {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _flat(part, f"{path}.{name}" if path else name)
    elif isinstance(value, np.ndarray):
        yield from _flat(value.tolist(), path)
    elif isinstance(value, list | tuple):
        for index, part in enumerate(value):
            yield from _flat(part, f"{path}[{index}]")
    elif isinstance(value, memoryview):
        yield path, bytes(value)
    else:
        yield path, value


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _name(entry: Entry) -> str:
    return entry.channel or entry.kind.value


def _kind(entry: Entry) -> str:
    return f"{entry.kind.value} of {entry.size} bytes"


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 120 else f"{text[:100]}… ({len(text)} characters)"
