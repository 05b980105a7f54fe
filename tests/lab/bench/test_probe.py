"""The native loops: they write the same numbers as Python, and keep window, pace and order."""

from __future__ import annotations

import socket
import threading
from pathlib import Path

import pytest

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.wire import decode
from igtl_gateway.wire.text import String
from igtl_gateway_lab.bench import probe
from igtl_gateway_lab.bench.cases import BenchStream, Direction, payload
from igtl_gateway_lab.bench.jobs import JobStream
from igtl_gateway_lab.bench.probe import (
    Flag,
    InStream,
    OutStream,
    Probe,
    compile_probe,
    igtl_bytes,
    lacks_probe,
    ros_bytes,
)
from igtl_gateway_lab.bench.processes import BenchError

pytestmark = pytest.mark.skipif(bool(lacks_probe()), reason=lacks_probe())

#: One of each form of a number.
KINDS = [
    *("transform", "string-100", "points-10", "polydata-600k", "transform-n", "points-1000-n"),
    *("transform-s", "string-100-s", "points-10-s"),
]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled once."""
    return compile_probe(tmp_path_factory.mktemp("probe"))


@pytest.fixture(scope="module")
def loops(library: Path) -> Probe:
    return Probe(library, ros=False)


def test_it_is_compiled_once(library: Path) -> None:
    made = library.stat().st_mtime_ns
    assert compile_probe(library.parent).stat().st_mtime_ns == made


def test_what_cannot_be_compiled_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "broken.c"
    broken.write_text("int main(void) { return nothing; }\n", "ascii")
    monkeypatch.setattr(probe, "SOURCE", broken)
    with pytest.raises(BenchError, match=r"native programs: .*nothing"):
        compile_probe(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_are_those_of_python(kind: str, loops: Probe) -> None:
    made = payload(kind)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        link = loops.link(ours.fileno())
        for data, form in ((ros_bytes(made), made.forms[0]), (igtl_bytes(made, "Tool"), made.forms[1])):
            stream = OutStream(data, form, link=link)
            for number in (1, 4_321, 0):
                sending = threading.Thread(target=loops.send_one, args=(stream, number))
                sending.start()
                with theirs.makefile("rb") as file:
                    message = file.read(len(data))
                sending.join()
                assert form.number(message) == number
                if form is made.forms[1]:
                    decoded = decode(message)  # raises if the CRC is wrong
                    assert decoded.message_id == (number if kind.endswith("-s") else 0)
            assert message == data


def test_a_paced_stream_arrives_in_order(loops: Probe) -> None:
    made, clock = payload("string-100"), SystemClock()
    part = JobStream(BenchStream("string-100", 1000.0), Direction.IGTL_TO_ROS, "", 50)
    ours, theirs = socket.socketpair()
    heard = InStream(made.forms[1], device=part.device)
    other = InStream(made.forms[1], device="other")
    reading = threading.Thread(target=loops.receive_link, args=(theirs.fileno(), [other, heard], Flag()))
    reading.start()
    stream = OutStream(igtl_bytes(made, part.device), made.forms[1], link=loops.link(ours.fileno()))
    loops.send_one(stream, 0)
    stream.pace(part, 0, None)
    begin_ns = clock.monotonic_ns() + 1_000_000
    loops.send([stream], begin_ns, begin_ns, Flag())
    ours.close()
    reading.join(10)
    theirs.close()
    numbers, times = heard.arrivals()
    sent = stream.sent()
    assert list(numbers) == list(range(1, 51)) and other.done == 0
    assert all(at_ns >= begin_ns + 1_000_000 * index for index, at_ns in enumerate(sent))
    assert all(times > sent)
    first = heard.first()
    assert first is not None and isinstance(decode(first).content, String)


def test_a_flood_keeps_its_window(loops: Probe) -> None:
    made, clock = payload("transform"), SystemClock()
    part = JobStream(BenchStream("transform", 0.0), Direction.IGTL_TO_ROS, "", window=8)
    ours, theirs = socket.socketpair()
    shown = memoryview(bytearray(8)).cast("q")
    data = igtl_bytes(made, part.device)
    stream = OutStream(data, made.forms[1], link=loops.link(ours.fileno()))
    stream.pace(part, 0, shown)
    stop = Flag()
    begin_ns = clock.monotonic_ns()
    sending = threading.Thread(target=loops.send, args=([stream], begin_ns, begin_ns + 10**12, stop))
    sending.start()
    with ours, theirs, theirs.makefile("rb") as file:
        for last in (8, 16):  # nothing follows before the progress is shown
            for number in range(last - 7, last + 1):
                assert made.forms[1].number(file.read(len(data))) == number
            theirs.setblocking(False)
            with pytest.raises(BlockingIOError):
                theirs.recv(1)
            theirs.setblocking(True)
            shown[0] = last
        stop.set()
        sending.join(10)
    assert not sending.is_alive()


@pytest.mark.parametrize("kind", ["transform", "transform-n", "points-1000-n", "image-vga-n"])
def test_a_message_is_sent_on_with_its_number(kind: str, loops: Probe) -> None:
    made = payload(kind)
    (a, b), (c, d) = socket.socketpair(), socket.socketpair()
    onward = OutStream(igtl_bytes(made, "There"), made.forms[1], link=loops.link(c.fileno()))
    passing = InStream(made.forms[1], device="Here", forward=onward)
    reading = threading.Thread(target=loops.receive_link, args=(b.fileno(), [passing], Flag()))
    reading.start()
    with a, b, c, d, d.makefile("rb") as file:
        for number in (0, 7):
            a.sendall(made.igtl_maker("Here")(number))
            message = file.read(len(onward.data))
            assert (decode(message).device_name, made.forms[1].number(message)) == ("There", number)
        a.shutdown(socket.SHUT_WR)
        reading.join(10)


def test_a_closed_connection_is_reported(loops: Probe) -> None:
    made = payload("transform")
    ours, theirs = socket.socketpair()
    theirs.close()
    with ours, pytest.raises(BenchError, match="send failed"):
        loops.send_one(OutStream(igtl_bytes(made, "Tool"), made.forms[1], link=loops.link(ours.fileno())), 1)
