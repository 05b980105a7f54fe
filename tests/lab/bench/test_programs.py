"""The programs on both sides: their instructions, and the OpenIGTLink side on a real socket."""

from __future__ import annotations

import queue
import socket
import threading
from typing import Any

import pytest

from igtl_gateway_lab.bench import programs
from igtl_gateway_lab.bench.cases import BenchStream, Direction, payload
from igtl_gateway_lab.bench.cutter import Arrivals
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.programs import IgtlTransport


def part(kind: str, index: int = 0) -> JobStream:
    return JobStream(BenchStream(kind, 30.0, index), Direction.ROS_TO_IGTL, "/topic", 10)


def test_a_job_survives_the_command_line() -> None:
    job = Job("igtl", "client", (part("transform"),), (part("image-vga"),), 2.5, "/tmp/x.npz", ("::1", 18944), True)
    assert Job.from_json(job.to_json()) == job


def test_messages_are_found_however_they_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    events: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    monkeypatch.setattr(programs, "print_event", events.put)
    parts = (part("transform"), part("image-xga"), part("string-100"))
    firsts: list[str] = []
    heard = {one.device: Arrivals(lambda _message, name=one.device: firsts.append(name)) for one in parts}  # type: ignore[misc]
    side = IgtlTransport(Job("igtl", "listener", (), parts, 0.0, "", listen=True), heard)
    opening = threading.Thread(target=side.open)
    opening.start()
    place = events.get(timeout=10)
    data = b"".join(
        bytes(payload(one.stream.kind).igtl_maker(one.device)(number)) for number in (0, 1, 2, 3) for one in parts
    )
    with socket.create_connection((place["host"], place["port"])) as peer:
        opening.join(10)
        begin = 0
        for size in (1, 57, 1, 60, 100, 1_500_000, 3, len(data)):
            peer.sendall(data[begin : begin + size])
            begin += size
        peer.shutdown(socket.SHUT_WR)
        side.wait(10)
    side.close()
    assert firsts == [one.device for one in parts]
    for arrivals in heard.values():
        assert list(arrivals.numbers) == [1, 2, 3]  # 0 only knocks
        assert list(arrivals.times) == sorted(arrivals.times)
