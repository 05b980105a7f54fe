"""The native programs of both sides: the same commands and events as those in Python, several streams at once."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway_lab.bench.cases import BenchStream, Direction
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.native import by_size, connect
from igtl_gateway_lab.bench.peers import Library, command, times_of
from igtl_gateway_lab.bench.probe import compile_probe, lacks_probe
from igtl_gateway_lab.bench.processes import Program

pytestmark = pytest.mark.skipif(bool(lacks_probe()), reason=lacks_probe())

PARTS = tuple(
    JobStream(BenchStream(kind, rate), Direction.ROS_TO_IGTL, f"/bench/{kind.replace('-', '_')}", 20)
    for kind, rate in (("transform", 200.0), ("string-100", 100.0), ("image-vga", 30.0))
)


@pytest.mark.parametrize("side", ["igtl", pytest.param("ros", marks=pytest.mark.ros)])
def test_all_messages_of_all_streams_arrive(side: str, tmp_path: Path) -> None:
    native = str(compile_probe(tmp_path))
    hears = Job(side, "listener", (), PARTS, 0.0, str(tmp_path / "heard.npz"), listen=True, native=native)
    with Program("listener", command(hears, Library(tmp_path))) as hearing:
        address = ("127.0.0.1", 0)
        if side == "igtl":
            place = hearing.wait_for("listening", 60.0)
            address = (place["host"], place["port"])
        sends = Job(side, "sender", PARTS, (), 0.0, str(tmp_path / "sent.npz"), address, native=native)
        with Program("sender", command(sends, Library(tmp_path))) as sending:
            for program in (hearing, sending):
                program.wait_for("ready", 60.0)
            sending.order("knock")
            assert {hearing.wait_for("heard", 60.0)["key"] for _ in PARTS} == {part.device for part in PARTS}
            sending.order("begin")
            assert sending.wait_for("sent", 60.0)["messages"] == 60
            arrived = 0
            while arrived < 60:
                hearing.order("count")
                arrived = hearing.wait_for("count", 60.0)["messages"]
            sending.end()
            hearing.end()
    told = times_of(sends) | times_of(hears)
    for part in PARTS:
        assert list(told[f"numbers {part.device}"]) == list(range(1, 21))
        assert np.all(told[f"received {part.device}"] > told[f"sent {part.device}"])


@pytest.mark.ros
def test_a_flood_and_a_rate_at_once(tmp_path: Path) -> None:
    native = str(compile_probe(tmp_path))
    flood = replace(PARTS[2], stream=BenchStream("image-vga", 0.0), count=0, window=3)
    hears = (PARTS[0], replace(flood, progress=str(tmp_path / "progress")))
    jobs = (
        Job("ros", "listener", (), hears, 0.0, str(tmp_path / "heard.npz"), native=native),
        Job("ros", "sender", hears, (), 0.5, str(tmp_path / "sent.npz"), native=native),
    )
    with ExitStack() as stack:
        hearing, sending = (stack.enter_context(Program(job.name, command(job, Library(tmp_path)))) for job in jobs)
        for program in (hearing, sending):
            program.wait_for("ready", 60.0)
        sending.order("knock")
        assert {hearing.wait_for("heard", 60.0)["key"] for _ in hears} == {part.device for part in hears}
        sending.order("begin")
        sent = sending.wait_for("sent", 60.0)["messages"]
        arrived = 0
        while arrived < sent:
            hearing.order("count")
            arrived = hearing.wait_for("count", 60.0)["messages"]
        sending.end()
        hearing.end()
    assert sent > PARTS[0].count + 3


def test_a_picture_has_a_thread_of_its_own() -> None:
    assert by_size([(100, "pose"), (1_000_000, "picture"), (200, "text")]) == [["pose", "text"], ["picture"]]
    assert by_size([(1_000_000, "picture")]) == [["picture"]]
    assert by_size([]) == []


def test_a_connection_waits_for_the_port() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
    opened = threading.Event()

    def serve() -> None:
        opened.wait(0.2)
        with socket.create_server(address) as late:
            late.accept()[0].close()

    serving = threading.Thread(target=serve)
    serving.start()
    connect(address).close()
    serving.join(10)
    assert not serving.is_alive()
