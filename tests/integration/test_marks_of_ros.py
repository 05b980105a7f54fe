"""Marks on the topic of the node."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

import igtl_gateway
from igtl_gateway import Bridge
from tests import domains
from tests.edges.tcp.world import until
from tests.integration.bridge import RosClient

LOCAL = ["127.0.0.1:0"]
TOPIC = "/or1/igtl_gateway/mark"


@pytest.mark.ros
@pytest.mark.slow
def test_a_text_on_the_topic_is_a_mark(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    arguments = ["-r", "__ns:=/or1"]
    with (
        RosClient("other", domain=domains.OWN) as other,
        Bridge(listen=LOCAL, record=out, record_all=True, ros_args=arguments) as bridge,
    ):
        other.advertise(TOPIC, "std_msgs/msg/String")
        other.wait_readers(TOPIC)
        for text in ("+suture: first", "-other", "-suture", ""):
            other.publish(TOPIC, {"data": text})
        until(lambda: sum("mark" in note.code for note in bridge.notes) == 4)
    with igtl_gateway.open(out) as recording:
        assert [(mark.label, mark.text, mark.who, mark.is_open) for mark in recording.marks] == [
            ("suture", "first", "ros", False)
        ]
        refused = [note.text for note in recording.notes if note.code == "mark_refused"]
        assert refused[0].startswith("mark: found the end of 'other'")
        assert refused[1].startswith("mark: found label ''")
    assert igtl_gateway.verify(out).good


@pytest.mark.ros
@pytest.mark.slow
def test_a_call_of_the_service_is_a_mark(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with RosClient("other", domain=domains.OWN) as other, Bridge(listen=LOCAL, record=out):
        time.sleep(0.3)
        seconds, rest = divmod(moment_ns := time.time_ns() - 200_000_000, 10**9)
        answers = []
        for fields in (
            {"label": "suture", "text": "first", "who": "Kim", "phase": "begin"},
            {"label": "suture", "phase": "end"},
            {"label": "suture", "phase": "end"},
            {"label": "slip", "stamp": {"sec": seconds, "nanosec": rest}},
            {"label": "slip", "stamp": {"sec": seconds + 60}},
            {"label": "slip", "stamp": {"sec": seconds - 60}},
        ):
            other.call("/igtl_gateway/mark", "igtl_msgs/srv/Mark", fields)
            answers.append(other.receive("/igtl_gateway/mark"))
    assert [answer["success"] for answer in answers] == [True, True, False, True, False, False]
    assert answers[2]["message"].startswith("mark: found the end of 'suture'")
    assert " ahead of the bridge's clock" in answers[4]["message"]
    assert " ago, expected at most the" in answers[5]["message"]
    with igtl_gateway.open(out) as recording:
        assert {(mark.label, mark.text, mark.who, mark.is_open) for mark in recording.marks} == {
            ("suture", "first", "Kim", False),
            ("slip", "", "ros", False),
        }
        (slip,) = [mark for mark in recording.marks if mark.label == "slip"]
        assert abs(slip.time_ns - moment_ns) < 100_000_000
