"""Services whose server is only in the recording: answered with what the events of service introspection have."""

from __future__ import annotations

import struct
from importlib.util import find_spec
from pathlib import Path

import pytest

from igtl_gateway.addon.reading import Entry, Kind, SessionFile
from igtl_gateway.addon.writing import SessionWriter
from igtl_gateway.addons.resim.services import RecordedAnswer, RecordedService, recorded_services
from igtl_gateway.record.sessionfile.definition import Definition
from tests.addons.resim import sessions
from tests.addons.resim.runs import RUNS, judged, published, strings

MS = sessions.MS
SWITCH = "std_srvs/srv/SetBool"
DEFINITION = "bool data\n---\nbool success\nstring message\n"


def event(kind: int, ns: int, number: int, request: bytes = b"", response: bytes = b"") -> bytes:
    """CDR of an event; the contents as they are in it."""
    time_ns = sessions.START_NS + ns
    data = struct.pack("<B3xiI16s4xq", kind, time_ns // 10**9, time_ns % 10**9, b"client", number)
    data += struct.pack("<I", bool(request)) + request
    data += bytes(-len(data) % 4) + struct.pack("<I", bool(response)) + response
    return b"\0\1\0\0" + data


def exchange(number: int, ns: int, data: bool, text: bytes, latency_ns: int = 3 * MS) -> list[bytes]:
    """A request of a client and the response that it got."""
    response = struct.pack("<?3xI", data, len(text) + 1) + text + b"\0"
    return [event(0, ns, number, request=struct.pack("<?", data)), event(3, ns + latency_ns, number, response=response)]


def record(path: Path, *events: bytes) -> Path:
    """20 strings in /in, and these events of /switch."""
    facts = {"config": "{}", "igtl_gateway_version": "1"}
    writer = SessionWriter(
        path, facts, qos_of=lambda _topic, _type: None, overwrite=True,
        definition_of=lambda name: Definition(DEFINITION.encode()) if name.endswith("_Event") else None,
    )  # fmt: skip
    rows = [(ns, topic, type_, sessions.cdr(type_, content)) for ns, topic, type_, content in sessions.texts(20)]
    rows += [(0, "/switch/_service_event", f"{SWITCH}_Event", each) for each in events]
    for number, (ns, topic, type_, data) in enumerate(sorted(rows, key=lambda row: row[0]), 1):
        writer.write(Entry(number, sessions.START_NS + ns + number, Kind.ROS_IN, topic, type_, (data,)))
    writer.close({})
    return path


def test_answers_are_found_by_what_is_asked() -> None:
    definition = Definition(b"int32 a\nfloat64 b\nstring c\n---\nbool done\n").text("robot/srv/Plan_Event")
    service = RecordedService("/plan", "robot/srv/Plan", definition)
    alone = b"\0\1\0\0" + struct.pack("<i4xdI3s", 5, 0.5, 3, b"ab\0")
    answers = [RecordedAnswer(b"one", 1), RecordedAnswer(b"two", 2)]
    for answer in answers:  # in an event there are other bytes between the values, and after them
        service.add(event(0, 0, 1, request=struct.pack("<idI3sx", 5, 0.5, 3, b"ab\0")), answer)
    assert service.take(b"\0\1\0\0" + struct.pack("<i4xdI3s", 0, 0.5, 3, b"ab\0")) is None
    assert [service.take(alone), service.take(alone), service.take(alone)] == [*answers, None]


def test_events_without_contents_are_no_answers(tmp_path: Path) -> None:
    path = record(tmp_path / "in.mcap", event(0, 0, 1), event(3, MS, 1))
    with SessionFile.open(path) as file:
        assert recorded_services(file) == {}
    path = record(tmp_path / "in.mcap", *exchange(1, 0, True, b"on"), event(0, 0, 2, b"\1"))
    with SessionFile.open(path) as file:
        assert [each.count for each in recorded_services(file).values()] == [1]


@pytest.mark.ros
@pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")
def test_a_service_is_answered_from_the_recording(tmp_path: Path) -> None:
    events = [exchange(number, 10 * number * MS, number % 2 == 0, b"t%d" % number) for number in range(1, 21)]
    recording = record(tmp_path / "in.mcap", *(each for pair in events[:18] for each in pair))
    result, verdict = judged(recording, tmp_path, "caller", lead_ns=1000 * MS)
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert result.roles
    assert (result.roles.answered, result.roles.unserved) == ({"/switch": 18}, ["/switch/set_parameters"])
    # each of the two contents has its own answers, in their order; the last two requests have none
    said = strings(result.runs[0].outputs, "/answers")
    assert said == [f"m{number}: {number % 2 == 1} t{number + 1} True" for number in range(18)]
    assert result.runs[0].unserved == {"/switch": 2, "/switch/set_parameters": 1}
    asked = [time_ns for time_ns, _ in published(recording, "/in")][:18]
    came = [time_ns for time_ns, _ in published(result.runs[0].outputs, "/answers")]
    assert [after - before for before, after in zip(asked, came, strict=True)] == [3 * MS] * 18
