"""Numbers of a stream by their names, for a plot: those of a message, and those of a recording over its time.

A long stream is thinned: every second, third, … message is decoded, so that a plot needs no more than some of them.
The names are those of tables (`export --to csv`); a number in a list that has names beside it is called by its own,
such as ``position.elbow``, and one of a list of tools by the tool, such as ``Stylus.x_mm``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addon import NS_PER_S, GatewayError, failure_text
from igtl_gateway.addon.igtl import BULKY, describe_content
from igtl_gateway.addon.reading import Stream, open_recording, session_of
from igtl_gateway.addon.streams import MAX_NUMBERS, NAME_FIELDS, name_igtl_fields, name_ros_fields
from igtl_gateway.addon.untrusted import MessageDecoder

#: Messages of a plot, numbers of a message and bytes of one that is decoded, streams that are named.
MAX_POINTS, MAX_FIELDS, _MAX_BYTES, MAX_STREAMS = 1_500, 200, 8 << 20, 500
#: Streams that are looked at where none is chosen.
_MAX_TRIED = 8
#: Names of an element of a list of messages.
_OWN_NAMES = ("name", "child_frame_id")
#: A number that is in every message, and shows nothing.
_LEFT_OUT = frozenset({"header.seq"})


def numbers_of(fields: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of a message by name, at most `MAX_FIELDS`; fields as tables name them, with units."""
    found: dict[str, float] = {}
    for name, value in _numbers("", fields):
        if len(found) >= MAX_FIELDS:
            break
        if name not in _LEFT_OUT:
            found[name] = value
    return found


def _numbers(place: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, np.ndarray):
        value = value.tolist() if value.size <= MAX_NUMBERS else ()
    if isinstance(value, bool | int | float):
        yield place, float(value)
    elif isinstance(value, Mapping):
        names: Iterator[list[Any]] = (value[name] for name in NAME_FIELDS if isinstance(value.get(name), list))
        listed = next(names, [])
        for name, inner in value.items():
            yield from (
                _numbers_of_list(_joined(place, name), inner, listed)
                if _is_list(inner)
                else _numbers(_joined(place, name), inner)
            )
    elif _is_list(value):
        yield from _numbers_of_list(place, value, [])


def _numbers_of_list(place: str, values: Any, names: list[Any]) -> Iterator[tuple[str, float]]:
    values = values.tolist() if isinstance(values, np.ndarray) else values
    if len(values) > MAX_NUMBERS:
        return
    by_name = len(names) == len(values) and all(isinstance(name, str) for name in names)
    for at, inner in enumerate(values):
        own = next((inner[name] for name in _OWN_NAMES if inner.get(name)), "") if isinstance(inner, Mapping) else ""
        yield from _numbers(str(own) or _joined(place, str(names[at]) if by_name else str(at)), inner)


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple | np.ndarray)


def _joined(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def plot_of(path: Path, key: str = "") -> dict[str, Any]:
    """Return a stream of a recording as JSON values.

    Args:
        key: of the stream, as ``igtl_gateway.open`` has it; "": the input with most messages that has numbers.

    Returns:
        ``streams``: all keys; ``stream``; ``times``: seconds since the begin of the recording; ``fields``: name →
        numbers, None where a message has none; ``every``: 1 if all messages are there, 2 for every second one, …;
        ``messages``: their number; ``problem``: why something is missing.
    """
    found: dict[str, Any] = {"streams": [], "stream": key, "times": [], "fields": {}, "every": 1, "messages": 0}
    try:
        with open_recording(path) as recording, session_of(recording) as file:
            keys = list(recording.streams)
            found["streams"] = keys[:MAX_STREAMS]
            decoder = MessageDecoder(lambda ros_type: file.definitions.get(ros_type, ""))
            usual = sorted(keys, key=lambda each: _usual(recording[each]))[:_MAX_TRIED]
            for each in [key] if key else usual:
                found |= {"stream": each} | _table(recording[each], recording.start_time, decoder)
                if found["fields"]:
                    break
    except KeyError as error:
        found["problem"] = str(error.args[0])
    except (GatewayError, OSError) as error:
        found["problem"] = failure_text(error)
    return found


def _usual(stream: Stream) -> tuple[bool, bool, int]:
    """Return the order of streams in which one is chosen: inputs first, without those of pictures, by their number."""
    pictures = stream.type in BULKY or stream.type.endswith(("Image", "Volume", "PointCloud2", "CompressedImage"))
    return not stream.direction.endswith("_in"), pictures, -stream.count


def _table(stream: Stream, start_ns: int, decoder: MessageDecoder) -> dict[str, Any]:
    every = max(1, -(-stream.count // MAX_POINTS))
    times: list[float] = []
    rows: list[dict[str, float]] = []
    problem, seen, unit = "", 0, stream.unit
    for block in stream.blocks():
        for at in range(-seen % every, len(block), every):
            payload = block.payload(at)
            if len(payload) > _MAX_BYTES:
                problem = f"messages above {_MAX_BYTES >> 20} MiB have no plot"
                continue
            try:
                fields = (
                    name_igtl_fields(describe_content(stream.acceptance.message(payload).content), unit)
                    if stream.direction.startswith("igtl")
                    else name_ros_fields(decoder.store(stream.type), decoder.decode(stream.type, bytes(payload)))
                )
                row = numbers_of(fields)
            except Exception as error:  # decoding raises many types of errors; only this message is left out
                problem = failure_text(error)
                continue
            times.append(round((int(block.times[at]) - start_ns) / NS_PER_S, 6))
            rows.append(row)
        seen += len(block)
    names = list(dict.fromkeys(name for row in rows for name in row))[:MAX_FIELDS]
    fields_of = {name: [_shown(row.get(name)) for row in rows] for name in names}
    return {"times": times, "fields": fields_of, "every": every, "messages": stream.count} | (
        {"problem": problem} if problem else {}
    )


def _shown(value: float | None) -> float | None:
    """Return a number as JSON has it: nothing for one that is not finite."""
    return value if value is not None and isfinite(value) else None
