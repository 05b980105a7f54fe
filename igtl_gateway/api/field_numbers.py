"""The numbers of messages by name, for plots: of one message, and of a stream as columns.

The names are those of tables (``columns``); a number in a list that has names beside it is called by its own, such as
``position.elbow``, and one of a list of messages by the name of its message, such as ``Stylus.x_mm``.  Each number has
a place beside its name, with the numbers of lists only: ``position.0``, ``elements.1.x_mm``.  ROS types of numbers, and
poses, are read all at once; other messages are decoded, one by one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.cdr_columns import Column, NotColumns, ros_columns
from igtl_gateway.api.columns import HEAD, MAX_NUMBERS, name_igtl_fields, name_ros_fields
from igtl_gateway.api.igtl_columns import POSE_TYPES, pose_columns, pose_rows
from igtl_gateway.api.named_numbers import NAME_FIELDS
from igtl_gateway.base.errors import GatewayError, failure_text
from igtl_gateway.base.untrusted.decoding import MessageDecoder
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.base.versions import Self
from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.wire.registry import describe_content

if TYPE_CHECKING:
    from igtl_gateway.api.stream import Stream

#: Names of a message in a list of messages.
_OWN_NAMES = ("name", "child_frame_id")
#: A number that is in every message, and shows nothing.
_LEFT_OUT = frozenset({"header.seq"})
_MOST_PLACE = 99_999_999

Floats = npt.NDArray[np.float64]
#: Name, place and value of a number.
_Found = Iterator[tuple[str, str, float]]
#: Place of a number in several messages, rows of those that have it, and its values there.
_FoundInAll = Iterator[tuple[str, npt.NDArray[Any], npt.NDArray[Any]]]


@dataclass(frozen=True, slots=True, eq=False)
class FieldNumbers:
    """Numbers of N messages.

    Attributes:
        times: (N,) int64, gateway times, UTC ns.
        fields: name → (N,) float64, NaN where a message has none.
        problem: why a message is left out; "" if all are there.
    """

    times: npt.NDArray[np.int64]
    fields: dict[str, Floats]
    problem: str = ""


@dataclass(frozen=True, slots=True)
class FieldReader:
    """Reads the numbers of the messages of a stream.

    Attributes:
        is_igtl: whether they are messages of OpenIGTLink.
        type: their OpenIGTLink or ROS type.
        decoder: of ROS messages.
        unit: of lengths in OpenIGTLink messages, which become millimetres.
        acceptance: of the session.
        wanted: name or place of a number, or of a list with several; "": all of them.
        most_bytes: of a message that is read; None: any.
    """

    is_igtl: bool
    type: str
    decoder: MessageDecoder
    unit: str = "mm"
    acceptance: Acceptance = field(default=DEFAULT_ACCEPTANCE)
    wanted: str = ""
    most_bytes: int | None = None

    @classmethod
    def of(
        cls, stream: Stream, definitions: Mapping[str, str], wanted: str = "", most_bytes: int | None = None
    ) -> Self:
        """Return the reader of a stream of a recording.  Raises ConfigError as ``Stream.unit``.

        Args:
            definitions: ROS type → definition, of its file.
        """
        is_igtl = stream.direction.startswith("igtl")
        decoder = MessageDecoder(lambda ros_type: definitions.get(ros_type, ""))
        unit = stream.unit if is_igtl else "mm"
        return cls(is_igtl, stream.type, decoder, unit, stream.acceptance, wanted, most_bytes)

    def numbers(self, payload: bytes | memoryview) -> dict[str, float]:
        """Return the numbers of a message by name.  Raises what decoding raises, of many types."""
        if self.is_igtl:
            fields = name_igtl_fields(describe_content(self.acceptance.message(payload).content), self.unit)
        else:
            message = self.decoder.decode(self.type, bytes(payload))
            fields = name_ros_fields(self.decoder.store(self.type), message)
        return numbers_of(fields, self.wanted)

    def of_blocks(self, blocks: Iterable[MessageBlock], every: int = 1) -> FieldNumbers:
        """Return the numbers of a stream, of every first, second, … message."""
        parts: list[FieldNumbers] = []
        seen = 0
        for block in blocks:
            parts.append(self._of_block(block if every == 1 else block.where(slice(-seen % every, None, every))))
            seen += len(block)
        return _joined(parts)

    def _of_block(self, block: MessageBlock) -> FieldNumbers:
        problem = ""
        if self.most_bytes is not None and (long := block.ends - block.begins > self.most_bytes).any():
            problem = f"messages above {self.most_bytes >> 20} MiB have no plot"
            block = block.where(~long)
        try:
            columns = self._columns(block)
        except (NotColumns, GatewayError):
            decoded, kept, why = self._one_by_one(block)
            return FieldNumbers(block.times[kept], _columns_of(decoded), why or problem)
        found: dict[str, Floats] = {}
        for name, have, values in _of_columns(columns, self.wanted):
            found[name] = np.full(len(block), np.nan)
            found[name][have] = values
        return FieldNumbers(block.times, found, problem)

    def _columns(self, block: MessageBlock) -> list[Column]:
        """Return the columns of all messages at once.  Raises NotColumns, GatewayError."""
        if not self.is_igtl:
            return ros_columns(block, self.decoder.store(self.type).fielddefs, self.type)
        if self.type in POSE_TYPES:
            found = pose_rows(block, self.type, self.acceptance)
            if len(found.rows) == len(block):
                return pose_columns(found, self.unit)
        raise NotColumns

    def _one_by_one(self, block: MessageBlock) -> tuple[list[dict[str, float]], list[int], str]:
        rows: list[dict[str, float]] = []
        kept: list[int] = []
        problem = ""
        for at in range(len(block)):
            try:
                rows.append(self.numbers(block.payload(at)))
            except Exception as error:  # decoding raises many types of errors; only this message is left out
                problem = failure_text(error)
            else:
                kept.append(at)
        return rows, kept, problem


def numbers_of(fields: Mapping[str, Any], wanted: str = "") -> dict[str, float]:
    """Return the numbers of a message by name.

    Args:
        fields: of the message, named with units as tables name them.
        wanted: see `FieldReader`; a place in a list of any length, too.
    """
    headed = {_headed(name): value for name, value in fields.items()}
    found = _in_message("", "", headed, wanted)
    return {
        _key(name, place, wanted): value
        for name, place, value in found
        if place not in _LEFT_OUT and _is_wanted(name, place, wanted)
    }


def _headed(name: str) -> str:
    """Return the name of a column beside those that each table has."""
    return f"{name}_" if name in HEAD else name


def _is_wanted(name: str, place: str, wanted: str) -> bool:
    return not wanted or any(each == wanted or each.startswith(f"{wanted}.") for each in (name, place))


def _key(name: str, place: str, wanted: str) -> str:
    """Return the name of a number, or its place where that is what was asked for."""
    return name if not wanted or name == wanted or name.startswith(f"{wanted}.") else place


def _path(place: str, name: object) -> str:
    return f"{place}.{name}" if place else str(name)


def _places(place: str, length: int, wanted: str) -> Iterable[int]:
    """Return the places of a list that have numbers: all of one that tables have, else the one that is wanted."""
    if length <= MAX_NUMBERS:
        return range(length)
    rest = wanted.removeprefix(f"{place}.")
    at = whole_number(rest.partition(".")[0], _MOST_PLACE) if rest != wanted else None
    return (at,) if at is not None and at < length else ()


# -- one message --------------------------------------------------------------------------------------------------


def _in_message(name: str, place: str, value: Any, wanted: str) -> _Found:
    if isinstance(value, bool | int | float):
        yield name, place, float(value)
    elif isinstance(value, Mapping):
        beside: list[Any] = next((value[each] for each in NAME_FIELDS if isinstance(value.get(each), list)), [])
        for key, inner in value.items():
            if isinstance(inner, list | tuple | np.ndarray):
                yield from _in_list(_path(name, key), _path(place, key), inner, beside, wanted)
            else:
                yield from _in_message(_path(name, key), _path(place, key), inner, wanted)
    elif isinstance(value, list | tuple | np.ndarray):
        yield from _in_list(name, place, value, (), wanted)


def _in_list(name: str, place: str, values: Any, beside: Sequence[Any], wanted: str) -> _Found:
    by_name = len(beside) == len(values) and all(isinstance(each, str) for each in beside)
    for at in _places(place, len(values), wanted):
        inner = values[at].item() if isinstance(values, np.ndarray) and values.ndim == 1 else values[at]
        own = next((inner[key] for key in _OWN_NAMES if inner.get(key)), "") if isinstance(inner, Mapping) else ""
        called = str(own) or _path(name, beside[at] if by_name else at)
        yield from _in_message(called, _path(place, at), inner, wanted)


# -- columns of all messages --------------------------------------------------------------------------------------


def _of_columns(columns: Iterable[Column], wanted: str) -> _FoundInAll:
    """Yield the numbers of columns, as `numbers_of` has them of each message; names in lists are no columns."""
    for column in columns:
        name = _headed(column.name)
        if column.is_text or name in _LEFT_OUT:
            continue
        if column.offsets is not None:
            found = _in_lists(name, column.values, column.offsets, wanted)
        else:
            rows = np.arange(len(column.values)) if column.valid is None else np.flatnonzero(column.valid)
            found = _in_arrays(name, rows, column.values[rows], wanted)
        for place, have, values in found:
            if _is_wanted(place, place, wanted):
                yield place, have, values


def _in_arrays(place: str, rows: npt.NDArray[Any], values: npt.NDArray[Any], wanted: str) -> _FoundInAll:
    """Yield the numbers of messages that have as many: values (N,), (N, K), or structures with such fields."""
    if values.dtype.names:
        for each in values.dtype.names:
            yield from _in_arrays(_path(place, each), rows, values[each], wanted)
    elif values.ndim == 1:
        yield place, rows, values
    else:
        for at in _places(place, values.shape[1], wanted):
            yield from _in_arrays(_path(place, at), rows, values[:, at], wanted)


def _in_lists(place: str, values: npt.NDArray[Any], offsets: npt.NDArray[np.int64], wanted: str) -> _FoundInAll:
    sizes = np.diff(offsets)
    longest = int(sizes.max(initial=0))
    chosen = set(_places(place, longest, wanted)) if longest > MAX_NUMBERS else set[int]()
    for at in sorted({*range(min(longest, MAX_NUMBERS)), *chosen}):
        rows = np.flatnonzero((sizes > at) & ((sizes <= MAX_NUMBERS) | (at in chosen)))
        if len(rows):
            yield from _in_arrays(_path(place, at), rows, values[offsets[:-1][rows] + at], wanted)


# -- columns of what was decoded ----------------------------------------------------------------------------------


def _columns_of(rows: Sequence[Mapping[str, float]]) -> dict[str, Floats]:
    """Return the columns of messages: of all their numbers, in order of the first message that has them."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.array([row.get(name, np.nan) for row in rows], np.float64) for name in names}


def _joined(parts: Sequence[FieldNumbers]) -> FieldNumbers:
    if len(parts) == 1:
        return parts[0]
    names = dict.fromkeys(name for part in parts for name in part.fields)
    sizes = [len(part.times) for part in parts]
    fields = {
        name: np.concatenate(
            [part.fields.get(name, np.full(size, np.nan)) for part, size in zip(parts, sizes, strict=True)]
        )
        for name in names
    }
    times = np.concatenate([np.zeros(0, np.int64), *(part.times for part in parts)])
    return FieldNumbers(times, fields, next((part.problem for part in reversed(parts) if part.problem), ""))
