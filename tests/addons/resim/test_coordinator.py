"""Services and actions of which the recording is the server, or the client, by the events of introspection."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addon.messages import goal_states
from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addon.writing import SessionWriter
from igtl_gateway.record.sessionfile.definition import Definition
from tests.addons.resim import sessions
from tests.addons.resim.runs import RUNS, judged, published, strings
from tests.calls import Goal, entries_of, rows_of
from tests.exchanges import ABORTED, CANCELED

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


def recorded_goals() -> list[Goal]:
    """By order: succeeds, aborts, rejected, never ends, canceled, its result was not asked for."""
    at = [10 * number * MS for number in range(7)]
    ends: list[dict[str, Any]] = [
        {"ends_ns": 35 * MS, "feedback_ns": (15 * MS, 25 * MS)},
        {"ends_ns": 40 * MS, "status": ABORTED},
        {"accepted": False},
        {},
        {"ends_ns": 63 * MS, "status": CANCELED, "cancel_ns": 55 * MS},
        {"ends_ns": 70 * MS, "asked": False},
    ]
    return [Goal(bytes([order] * 16), order, at[order], **end) for order, end in enumerate(ends, 1)]


def record_action(path: Path, goals: Sequence[Goal], count: int) -> Path:
    """Strings in /in every 10 ms, and these goals of /drive."""
    rows = [(ns, topic, type_, sessions.cdr(type_, content)) for ns, topic, type_, content in sessions.texts(count)]
    writer = SessionWriter(path, {"config": "{}"}, qos_of=lambda _topic, _type: None, overwrite=True)
    for entry in entries_of([*rows, *rows_of("/drive", goals)]):
        writer.write(entry)
    writer.close({})
    return path


@pytest.mark.ros
@pytest.mark.skipif(not find_spec("test_msgs"), reason="needs test_msgs")
def test_an_action_is_answered_from_the_recording(tmp_path: Path) -> None:
    """Acceptance, feedback and results at their recorded times; what is not recorded is rejected and counted."""
    recording = record_action(tmp_path / "in.mcap", recorded_goals(), 20)
    result, verdict = judged(recording, tmp_path, "fibonacci client", lead_ns=1000 * MS)
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert result.roles
    assert (result.roles.played, result.roles.missing, result.roles.unserved) == ({"/drive": 6}, [], [])
    said = strings(result.runs[0].outputs, "/out")
    ends = [text.split(" at ")[0] for text in said if "[" in text]
    assert ends == ["m0 4 [1, 8]", "m1 6 [2, 8]", "m4 5 [5, 8]"]
    assert [text.split(" at ")[0] for text in said if "goes on" in text] == ["m0 goes on 1", "m0 goes on 2"]
    assert [text.split()[0] for text in said if "accepted=True" in text] == ["m0", "m1", "m3", "m4", "m5"]
    assert sum("accepted=False" in text for text in said) == 15
    # goals 7 to 20 are not recorded, and the result of the sixth neither
    assert result.runs[0].unserved == {"/drive": 15}


@pytest.mark.ros
@pytest.mark.skipif(not find_spec("test_msgs"), reason="needs test_msgs")
def test_a_server_gets_the_recorded_goals(tmp_path: Path) -> None:
    """At their times, with requests for results and cancellations; what it publishes is its output."""
    recording = record_action(tmp_path / "in.mcap", recorded_goals(), 20)
    result, verdict = judged(recording, tmp_path, "fibonacci server", lead_ns=1000 * MS)
    assert verdict.between_runs == [] and len({one.outputs for one in result.runs}) == RUNS
    assert result.roles
    assert result.roles.asked == {
        "/drive/_action/send_goal": 6,
        "/drive/_action/get_result": 4,
        "/drive/_action/cancel_goal": 1,
    }
    outputs = result.runs[0].outputs
    ends = dict(state for _, data in published(outputs, "/drive/_action/status") for state in goal_states(data))
    # the fourth is rejected by this server, the third is not; the fifth was canceled after 5 ms
    assert {goal[0]: status for goal, status in ends.items()} == {1: 4, 2: 4, 3: 4, 5: 5, 6: 4}
    times = [time_ns - sessions.START_NS for time_ns, _ in published(outputs, "/drive/_action/feedback")]
    assert times[0] // MS == 10 and len(times) == 4 * 4 + 2


@pytest.mark.ros
@pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")
def test_a_recorded_client_asks_only_if_no_program_does(tmp_path: Path) -> None:
    events = [event for number in range(3) for event in exchange(number, number * MS, True, b"a")]
    recording = record(tmp_path / "in.mcap", *events)
    own = ("/switch/_service_event",)
    for names, inputs, outputs, asked in (
        (("switch",), (), (), 3),
        (("switch", "caller"), (), (), 0),
        (("switch", "caller"), own, (), 3),
        (("switch",), (), own, 0),
    ):
        result, _ = judged(recording, tmp_path, *names, runs=1, inputs=inputs, outputs=outputs)
        assert result.roles and result.roles.asked == ({"/switch": asked} if asked else {})
        assert result.runs[0].delivered.get("/switch", 0) == asked
