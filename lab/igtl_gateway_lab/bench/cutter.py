"""Cuts the bytes of an OpenIGTLink connection into messages, at as little cost per message as Python allows.

Many small messages that arrive at once, of one device and one size, are looked at as one array.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.wire.header import BODY_SIZE, BODY_SIZE_AT, CRC_AT, DEVICE_NAME_AT, HEADER_SIZE, NAMES, TICKS_AT
from igtl_gateway_lab.bench.payloads import Form, Numbers
from igtl_gateway_lab.bench.window import progress

_BUFFER_BYTES = 1 << 20
_MANY = 8  # messages from which on an array is cheaper


class Arrivals:
    """Arrivals of one stream: sequence numbers and times.

    Args:
        first: called with the first knock.
        shown: where the last number is stored, see ``window.progress``.
    """

    def __init__(self, first: Callable[[Buffer], None], shown: memoryview | None = None) -> None:
        self.numbers = array("q")
        self.times = array("q")
        self._first: Callable[[Buffer], None] | None = first
        self._shown = progress() if shown is None else shown

    def take(self, number: int, at_ns: int, message: Buffer) -> None:
        if number:
            self.numbers.append(number)
            self.times.append(at_ns)
            self._shown[0] = number
        elif self._first:
            self._first(message)
            self._first = None

    def take_many(self, numbers: Numbers, at_ns: int) -> None:
        """Messages that arrived together, none of them a knock."""
        self.numbers.frombytes(numbers.tobytes())
        self.times.frombytes(np.full(len(numbers), at_ns, np.int64).tobytes())
        self._shown[0] = int(numbers[-1])


class Cutter:
    """Of one connection.

    Args:
        readers: device name, filled up to 20 bytes → where its numbers are, and who keeps them.
    """

    def __init__(self, readers: Mapping[bytes, tuple[Form, Arrivals]]) -> None:
        self._readers = readers
        self._view = memoryview(bytearray(_BUFFER_BYTES))
        self._filled = 0

    def room(self) -> memoryview:
        """Where the next bytes belong; never empty."""
        return self._view[self._filled :]

    def take(self, got: int, at_ns: int) -> None:
        """Handle ``got`` received bytes.  A message has arrived when its last byte has."""
        self._filled += got
        view, filled, begin = self._view, self._filled, 0
        while filled - begin >= HEADER_SIZE:
            size = HEADER_SIZE + int.from_bytes(view[begin + BODY_SIZE_AT : begin + CRC_AT], "big")
            if size > filled - begin:
                if size > len(view):
                    self._view = memoryview(bytearray(size))
                break
            reader = self._readers.get(bytes(view[begin + DEVICE_NAME_AT : begin + TICKS_AT]))
            if reader is None:
                begin += size
                continue
            form, heard = reader
            if (filled - begin) // size >= _MANY and (run := self._run(form, heard, begin, size, at_ns)):
                begin += run * size
                continue
            message = view[begin : begin + size]
            heard.take(form.number(message), at_ns, message)
            begin += size
        if begin or self._view is not view:
            self._view[: filled - begin] = bytes(view[begin:filled])
            self._filled = filled - begin

    def _run(self, form: Form, heard: Arrivals, begin: int, size: int, at_ns: int) -> int:
        """Take all that are like the first, up to the next knock; how many."""
        count = (self._filled - begin) // size
        rows = np.frombuffer(self._view, np.uint8, count * size, begin).reshape(count, size)
        like = (rows[:, NAMES] == rows[0, NAMES]).all(1) & (rows[:, BODY_SIZE] == rows[0, BODY_SIZE]).all(1)
        run = _leading(like)
        at = form.place(rows[0].data)
        numbers = form.numbers(np.ascontiguousarray(rows[:run, at : at + form.size]))
        run = _leading(numbers != 0)
        if run:
            heard.take_many(numbers[:run], at_ns)
        return run


def _leading(true: npt.NDArray[np.bool_]) -> int:
    """How many are true, up to the first that is not."""
    return len(true) if true.all() else int(np.argmin(true))
