"""pyigtl on the side of OpenIGTLink, as a program of ``programs``."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pyigtl

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.wire import decode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.text import String
from igtl_gateway_lab.bench.cases import payload
from igtl_gateway_lab.bench.cutter import Arrivals
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.pace import Send
from igtl_gateway_lab.bench.payloads import EPOCH_S

_LOOK_S = 0.2


class PyigtlTransport:
    """A client of pyigtl's; of one stream."""

    def __init__(self, job: Job, heard: dict[str, Arrivals]) -> None:
        self._job = job
        self._heard = heard
        self._now = SystemClock().monotonic_ns
        self._ended = threading.Event()
        self._client: Any = None
        self._threads: list[threading.Thread] = []

    def open(self) -> None:
        host, port = self._job.address
        self._client = pyigtl.OpenIGTLinkClient(host, port)
        while not self._client.is_connected():
            self._ended.wait(_LOOK_S)
        for part in self._job.hears:
            thread = threading.Thread(target=self._receive, args=(part,), name="igtl-bench-pyigtl", daemon=True)
            self._threads.append(thread)
            thread.start()

    def wait_for_peers(self) -> None:
        """A connection is all."""

    def sender(self, part: JobStream) -> Send:
        make, send_message, now = _maker(part), self._client.send_message, self._now

        def send(first: int, count: int) -> list[int]:
            times = []
            for number in range(first, first + count):
                message = make(number)
                times.append(now())
                send_message(message)
            return times

        return send

    def close(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._client.stop()

    def _receive(self, part: JobStream) -> None:
        heard = self._heard[part.key]
        while not self._ended.is_set():
            message = self._client.wait_for_message(part.device, timeout=_LOOK_S)
            if message is not None:
                at_ns = self._now()
                text = isinstance(message, pyigtl.StringMessage)
                number = int(message.string[:10]) if text else round(message.timestamp) - EPOCH_S
                heard.take(number, at_ns, b"")


def _maker(part: JobStream) -> Callable[[int], Any]:
    """Makes a message by its number, with the content of our own."""
    device = part.device
    content = decode(bytes(payload(part.stream.kind).igtl_maker(device)(0))).content
    match content:
        case String():
            rest = content.data[10:].decode()
            return lambda number: pyigtl.StringMessage(f"{number:010}{rest}", device_name=device)
        case Points():
            positions = content.elements["position"].astype(np.float32)
            return lambda number: pyigtl.PointMessage(
                positions=positions, timestamp=EPOCH_S + number, device_name=device
            )
        case Image():
            columns, rows, slices = content.dimensions
            voxels = np.frombuffer(content.pixels, np.uint8).reshape(slices, rows, columns, content.num_components)
            return lambda number: pyigtl.ImageMessage(voxels, timestamp=EPOCH_S + number, device_name=device)
        case _:
            matrix = np.array(content.rows)  # type: ignore[attr-defined]  # a Transform: no other kind is asked for
            return lambda number: pyigtl.TransformMessage(matrix, timestamp=EPOCH_S + number, device_name=device)
