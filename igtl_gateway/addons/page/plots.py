"""Numbers of a stream of a recording by their names, over its time, for a plot.

A long stream is thinned: every second, third, … message is decoded, so that a plot needs no more than some of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, GatewayError, failure_text
from igtl_gateway.addon.igtl import BULKY
from igtl_gateway.addon.reading import Stream, open_recording, session_of
from igtl_gateway.addon.streams import FieldReader

#: Messages of a plot, numbers of a message and bytes of one that is decoded, streams that are named.
MAX_POINTS, MAX_FIELDS, MAX_BYTES, MAX_STREAMS = 1_500, 200, 8 << 20, 500
#: Streams that are looked at where none is chosen.
_MAX_TRIED = 8


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
            usual = sorted(keys, key=lambda each: _usual(recording[each]))[:_MAX_TRIED]
            for each in [key] if key else usual:
                found |= {"stream": each} | _table(recording[each], recording.start_time, file.definitions)
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


def _table(stream: Stream, start_ns: int, definitions: Mapping[str, str]) -> dict[str, Any]:
    every = max(1, -(-stream.count // MAX_POINTS))
    reader = FieldReader.of(stream, definitions, most_bytes=MAX_BYTES)
    found = reader.of_blocks(stream.blocks(), every)
    fields = {name: shown(found.fields[name].tolist()) for name in list(found.fields)[:MAX_FIELDS]}
    times = [round((at_ns - start_ns) / NS_PER_S, 6) for at_ns in found.times.tolist()]
    facts = {"times": times, "fields": fields, "every": every, "messages": stream.count}
    return facts | ({"problem": found.problem} if found.problem else {})


def shown(values: list[float]) -> list[float | None]:
    """Return numbers as JSON has them: nothing for one that is not finite."""
    return [value if isfinite(value) else None for value in values]
