"""Programs that are slower than their input: a full queue drops what it would drop in ROS, which is reported."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest

from igtl_gateway.addons.resim.report import junit_xml, report_lines
from tests.addons.resim import sessions
from tests.addons.resim.runs import judged, strings

pytestmark = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]

MS = 1_000_000


def numbered(count: int) -> list[sessions.Row]:
    """Strings every 30 ms, and the end of the session."""
    type_ = "std_msgs/msg/String"
    rows = [(30 * MS * n, "/in", type_, sessions.message(type_, data=str(n))) for n in range(count)]
    return [*rows, (2000 * MS, "/end", type_, sessions.message(type_, data="end"))]


def expected(count: int, depth: int) -> list[str]:
    """What a callback of 100 ms takes of them: it begins when the one before ends, with the oldest in the queue."""
    taken, free_ns, arrived = [], 0, 0
    queue: list[int] = []
    while arrived < count or queue:
        if not queue:
            free_ns = max(free_ns, 30 * MS * arrived)
        while arrived < count and 30 * MS * arrived <= free_ns:
            queue = [*queue, arrived][-depth:]
            arrived += 1
        taken.append(str(queue.pop(0)))
        free_ns += 100 * MS
    return taken


@pytest.mark.parametrize("what", ["spin", "threads"])
@pytest.mark.parametrize("depth", [1, 3])
def test_the_oldest_message_is_dropped_and_counted(tmp_path: Path, what: str, depth: int) -> None:
    recording = sessions.write(tmp_path / "in.mcap", numbered(40))
    result, verdict = judged(recording, tmp_path, f"slow {depth} {what}", runs=2)
    assert verdict.line() == "deterministic: 2 of 2 runs equal"
    taken = expected(40, depth)
    assert strings(result.runs[0].outputs, "/out") == taken
    (lost,) = result.runs[0].lost
    assert result.runs[1].lost == [lost]
    assert (lost.name, lost.depth, lost.count) == ("/in", depth, 40 - len(taken))
    first = next(number for number in range(40) if str(number) not in taken)
    first_s = 0.030 * (first + depth)  # the one before which it had to be taken
    line = f"slow: lost {lost.count} messages of /in, the first one at {first_s:.6f} s"
    line += f": its queue of depth {depth} was full"
    assert lost.text(sessions.START_NS) == line
    assert f"  {line}" in report_lines(result, verdict)
    (found,) = ElementTree.fromstring(junit_xml(result, verdict)).iter("property")
    assert found.attrib == {"name": "lost", "value": line}


@pytest.mark.parametrize("what", ["spin", "timer"])
def test_a_queue_that_keeps_all_loses_nothing(tmp_path: Path, what: str) -> None:
    recording = sessions.write(tmp_path / "in.mcap", numbered(15))
    result, _ = judged(recording, tmp_path, f"slow all {what}", runs=1)
    assert strings(result.runs[0].outputs, "/out") == [str(number) for number in range(15)]
    assert result.runs[0].lost == []


def test_messages_of_one_time_are_received_one_after_the_other(tmp_path: Path) -> None:
    """A callback that takes no session time has taken one when the next one comes, also with a queue of depth 1."""
    type_ = "std_msgs/msg/String"
    rows = [(10 * MS, "/in", type_, sessions.message(type_, data=str(number))) for number in range(5)]
    recording = sessions.write(tmp_path / "in.mcap", [*rows, *numbered(0)])
    result, _ = judged(recording, tmp_path, "slow 1 timer", runs=1)
    assert strings(result.runs[0].outputs, "/out") == list("01234")
    assert result.runs[0].lost == []


def test_a_service_keeps_its_last_ten_requests(tmp_path: Path) -> None:
    """As Fast DDS does: of 25 at once, of which it works on the first one, the last ten are left."""
    recording = sessions.write(tmp_path / "in.mcap", numbered(2))
    result, verdict = judged(recording, tmp_path, "slow 1 serve", "slow 1 ask", runs=2)
    assert verdict.line() == "deterministic: 2 of 2 runs equal"
    assert strings(result.runs[0].outputs, "/out") == ["0", *map(str, range(15, 25))]
    assert [(each.name, each.depth, each.count) for each in result.runs[0].lost] == [("/work", 10, 14)]
