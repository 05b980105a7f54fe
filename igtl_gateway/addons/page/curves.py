"""The last minute of a number of a running bridge, in the process of the page: read when a browser asks for it."""

from __future__ import annotations

import base64
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, failure_text
from igtl_gateway.addon.settings import Acceptance
from igtl_gateway.addon.streams import FieldReader
from igtl_gateway.addon.untrusted import MessageDecoder
from igtl_gateway.addon.writing import RosTypes
from igtl_gateway.addons.page.live_numbers import MAX_STREAMS
from igtl_gateway.addons.page.plot_field import usual_field
from igtl_gateway.addons.page.plots import MAX_FIELDS, shown
from igtl_gateway.addons.page.results import keep_newest

#: What a curve shows, s, and its most messages.
SPAN_S, MAX_POINTS = 60, 1_500

#: Side and stream → the messages since the last call, as ``BridgeSource.numbers`` has them.
Take = Callable[[str, str], dict[str, Any]]


class _Curve:
    """The numbers of a stream."""

    def __init__(self) -> None:
        self.reader: FieldReader | None = None
        self.problem = ""
        self.now_ns = 0  # gateway time, UTC
        self._places: dict[str, int] = {}  # name → place in a row
        self._rows: deque[tuple[int, npt.NDArray[np.float64]]] = deque(maxlen=MAX_POINTS)

    def add(self, at_ns: int, numbers: dict[str, float]) -> None:
        for name in numbers:
            if len(self._places) < MAX_FIELDS:
                self._places.setdefault(name, len(self._places))
        row = np.full(len(self._places), np.nan)
        for name, value in numbers.items():
            if name in self._places:
                row[self._places[name]] = value
        self._rows.append((at_ns, row))

    def shown(self, field: str) -> dict[str, Any]:
        """Return what the page shows of a field; "" is one that changes."""
        while self._rows and self.now_ns - self._rows[0][0] > SPAN_S * NS_PER_S:
            self._rows.popleft()
        names = list(self._places)
        if field not in self._places:
            field = usual_field({name: self._values(name) for name in names})
        times = [round((at_ns - self.now_ns) / NS_PER_S, 4) for at_ns, _ in self._rows]
        return {"fields": names, "field": field, "times": times, "values": self._values(field)}

    def _values(self, name: str) -> list[float | None]:
        place = self._places.get(name, MAX_FIELDS)
        return shown([float(row[place]) if place < len(row) else np.nan for _, row in self._rows])


class Curves:
    """The numbers that browsers look at; any thread may use it.

    Args:
        take: takes messages from the bridge.
    """

    def __init__(self, take: Take) -> None:
        self._take = take
        self._lock = threading.Lock()
        self._types: RosTypes | None = None
        self._curves: dict[tuple[str, str], _Curve] = {}

    def read(self, side: str, stream: str, field: str) -> dict[str, Any]:
        """Return a number of a stream in the last minute, as JSON values.

        Args:
            field: its name; "": one that changes.

        Returns:
            ``fields``: the names of all; ``field``; ``times``: of the messages, s, negative: before now; ``values``:
            of the field in each, None where a message has none; ``span_s``: what is shown, s; ``problem``: why.
        """
        with self._lock:
            found = self._take(side, stream)
            curve = self._curves.pop((side, stream), None) or _Curve()
            self._curves[side, stream] = curve
            keep_newest(self._curves, MAX_STREAMS)
            curve.problem = str(found.get("problem", ""))
            curve.now_ns = int(found.get("now_ns", curve.now_ns))
            for at_ns, data in found["messages"]:
                self._add(curve, side, found, int(at_ns), base64.b64decode(data))
            problem = {"problem": curve.problem} if curve.problem else {}
            return {"side": side, "stream": stream, "span_s": SPAN_S, **curve.shown(field), **problem}

    def _add(self, curve: _Curve, side: str, found: dict[str, Any], at_ns: int, data: bytes) -> None:
        is_igtl, kind, unit = side.startswith("igtl"), str(found["type"]), str(found["unit"])
        reader = curve.reader
        if reader is None or (reader.type, reader.unit) != (kind, unit):
            acceptance = Acceptance(bool(found["crc"]))
            reader = curve.reader = FieldReader(is_igtl, kind, MessageDecoder(self._definition), unit, acceptance)
        try:
            curve.add(at_ns, reader.numbers(data))
        except Exception as error:  # decoding raises many types of errors; only this message is left out
            curve.problem = failure_text(error)

    def _definition(self, ros_type: str) -> str:
        self._types = self._types or RosTypes()
        found = self._types.find(ros_type)
        return found.text(ros_type) if found else ""
