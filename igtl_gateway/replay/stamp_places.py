"""Finds the offsets of stamps in the CDR bytes of a ROS message, by the definition of its type.

A stamp is a field ``stamp`` or ``timestamp`` of the type ``builtin_interfaces/Time``, at any depth: in headers, in the
transforms of a TFMessage, in the markers of a MarkerArray; and the time of ``/clock``.  Other times, such as the times
of a scan or of a reference clock, are data and not stamps.

The definition comes from the recording if it has one, else from ROS 2 Jazzy or igtl_msgs.  It is compiled once into a
list of steps.  Steps after the last stamp are left out, so that of a message with a leading header only the header is
read.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rosbags.typesys import Stores, get_typestore

from igtl_gateway.base.errors import RecordingError
from igtl_gateway.base.untrusted import definitions
from igtl_gateway.convert.interfaces import SHARES
from igtl_gateway.replay.simclock import CLOCK_TYPE

_TIME = "builtin_interfaces/msg/Time"
_STAMPS = frozenset({"stamp", "timestamp"})
_SIZES = {
    "bool": 1, "byte": 1, "octet": 1, "char": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4,
    "uint32": 4, "float32": 4, "int64": 8, "uint64": 8, "float64": 8,
}  # fmt: skip
_BASE, _NAME, _ARRAY = 1, 2, 3  # rosbags' kinds of field types; the others are sequences
_ENCAPSULATION = 4  # bytes; alignment is relative to their end


@dataclass(frozen=True, slots=True)
class _Numbers:
    """A number of consecutive numbers; ``several``: the elements of a sequence."""

    size: int
    count: int
    several: bool = False


@dataclass(frozen=True, slots=True)
class _Stamp:
    pass


@dataclass(frozen=True, slots=True)
class _Text:
    """A string; ``wide``: of wide characters, which rosbags cannot read and which end the walk."""

    wide: bool = False


@dataclass(frozen=True, slots=True)
class _RepeatedSteps:
    """Repeated steps; 0: the number of repetitions is in the bytes."""

    steps: tuple[_Step, ...]
    count: int


_Step = _Numbers | _Stamp | _Text | _RepeatedSteps


class StampPlaces:
    """Finds the stamps of messages.

    Args:
        definitions: type → definition with all dependencies, from the recording.
        all_times: find all fields of the type ``builtin_interfaces/Time`` instead.
    """

    def __init__(self, definitions: Mapping[str, str], *, all_times: bool = False) -> None:
        self._definitions = definitions
        self._all_times = all_times
        self._known: dict[str, Any] = dict(get_typestore(Stores.ROS2_JAZZY).fielddefs)
        self._steps: dict[str, tuple[_Step, ...] | None] = {}

    def of(self, ros_type: str, data: bytes | memoryview) -> list[int] | None:
        """Return the offsets in order; None for a type without a definition, or for bytes that are not of the type."""
        if ros_type not in self._steps:
            self._steps[ros_type] = self._compile(ros_type)
        steps = self._steps[ros_type]
        if steps is None or len(data) < _ENCAPSULATION or data[0] != 0 or data[1] not in (0, 1):
            return None
        walk = _Walk(data)
        try:
            walk.steps(steps)
        except (struct.error, ValueError):
            return None
        return walk.places if walk.at <= len(data) else None

    def _compile(self, ros_type: str) -> tuple[_Step, ...] | None:
        own: Mapping[str, Any] = {}
        try:
            if text := self._definitions.get(ros_type, ""):
                own = definitions.parse_definition(text, ros_type, wide_strings=True)
            steps = self._of_struct(ros_type, own)
        except (RecordingError, OSError, UnicodeDecodeError, KeyError, RecursionError):
            return None
        while steps and not _has_stamp(steps[-1]):
            steps.pop()
        return tuple(steps)

    def _of_struct(self, name: str, own: Mapping[str, Any]) -> list[_Step]:
        found = own.get(name) or self._known.get(name) or self._ours(name)
        steps: list[_Step] = []
        for field, (kind, inner) in found[1]:
            is_stamp = field in _STAMPS or name == CLOCK_TYPE
            added: list[_Step] = [_Stamp()] if is_stamp and inner == _TIME else self._of_type(kind, inner, own)
            for step in added:
                last = steps[-1] if steps else None
                if isinstance(step, _Numbers) and isinstance(last, _Numbers) and _joins(last, step):
                    steps[-1] = _Numbers(step.size, last.count + step.count)
                else:
                    steps.append(step)
        return steps

    def _of_type(self, kind: int, inner: Any, own: Mapping[str, Any]) -> list[_Step]:
        if kind == _BASE:
            if inner[0] in ("string", "wstring"):
                return [_Text(wide=inner[0] == "wstring")]
            return [_Numbers(_SIZES[inner[0]], 1)]
        if kind == _NAME:
            return [_Stamp()] if self._all_times and inner == _TIME else self._of_struct(inner, own)
        (kind_of_each, each_type), length = inner
        steps = self._of_type(kind_of_each, each_type, own)
        count = length if kind == _ARRAY else 0
        match steps:
            case [_Numbers(size, each, False)]:
                return [_Numbers(size, each * count if count else each, several=not count)]
            case _:
                return [_RepeatedSteps(tuple(steps), count)]

    def _ours(self, name: str) -> Any:
        """Return the definition of a type of igtl_msgs.  Raises KeyError."""
        package, _, rest = name.partition("/")
        for share in SHARES:
            path = share / package / f"{rest}.msg"
            if path.is_file():
                self._known |= definitions.parse_definition(path.read_text("utf-8"), name)
        return self._known[name]


def _joins(last: _Numbers, step: _Numbers) -> bool:
    return last.size == step.size and not last.several and not step.several


def _has_stamp(step: _Step) -> bool:
    return isinstance(step, _Stamp) or (isinstance(step, _RepeatedSteps) and any(map(_has_stamp, step.steps)))


class _Walk:
    """One walk through a message.  Raises struct.error or ValueError if the bytes are not of the type."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = data
        self._number = struct.Struct(("<" if data[1] & 1 else ">") + "I")
        self.at = _ENCAPSULATION
        self.places: list[int] = []

    def steps(self, steps: tuple[_Step, ...]) -> None:
        for step in steps:
            match step:
                case _Stamp():
                    self._align(4)
                    self.places.append(self.at)
                    self.at += 8
                case _Numbers(size, count, several):
                    count *= self._count() if several else 1
                    if count:
                        self._align(size)
                        self.at += size * count
                case _Text(wide):
                    if wide:
                        raise ValueError("a wide string")
                    length = self._count()
                    self.at += length
                case _RepeatedSteps(inner, count):
                    for _ in range(count or self._count()):
                        self.steps(inner)
                        if self.at > len(self._data):
                            raise ValueError("ends too early")

    def _count(self) -> int:
        self._align(4)
        (count,) = self._number.unpack_from(self._data, self.at)
        self.at += 4
        return int(count)

    def _align(self, size: int) -> None:
        self.at += -(self.at - _ENCAPSULATION) % size
