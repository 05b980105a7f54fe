"""When configured sources that do not come are reported."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from igtl_gateway.app.awaited_sources import AwaitedSources
from igtl_gateway.app.bridge import Bridge as LiveBridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.gateway.expected import ExpectedSource, PresentSources, expected_sources
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note

EXPECTED = expected_sources(Config(to_igtl=(ToIgtlRow(topic="/tol"),), to_ros=(ToRosRow(device="Prob"),)))


class Bridge:
    def __init__(self, expected: list[ExpectedSource] = EXPECTED) -> None:
        self.present = PresentSources(topics=(), devices=None)
        self.notes: list[Note] = []
        self.looks = self.second = 0
        self.awaited = AwaitedSources(expected, self._now, self.notes.append)

    def _now(self) -> PresentSources:
        self.looks += 1
        return self.present

    def until(self, seconds: int) -> list[str]:
        for second in range(self.second, seconds):
            self.awaited.look(100 * NS_PER_S + second * NS_PER_S)
        self.second = seconds
        return [each.source.name for each in self.awaited.missing]


def test_a_source_that_does_not_come_is_reported_once_after_five_seconds() -> None:
    bridge = Bridge()
    assert bridge.until(5) == [] and not bridge.looks
    assert bridge.until(6) == ["/tol"]
    assert bridge.until(30) == ["/tol"]
    assert [(note.stream, note.level) for note in bridge.notes] == [("/tol", Level.WARN)]


def test_a_device_is_missed_once_its_peer_has_sent_for_some_seconds() -> None:
    bridge = Bridge()
    bridge.present = PresentSources(topics=("/tol",), devices=("Probe",))
    assert bridge.until(8) == [], "the peers have sent for some seconds only"
    assert bridge.until(14) == ["Prob"]


def test_a_device_is_missed_where_no_peer_comes() -> None:
    bridge = Bridge()
    bridge.present = PresentSources(topics=("/tol",), devices=(), connected=0)
    assert bridge.until(8) == ["Prob"]
    bridge.present = PresentSources(topics=("/tol",), devices=("Probe",), connected=1)
    assert bridge.until(11) == [], "the peer may send it as its next message"
    assert bridge.until(30) == ["Prob"]
    assert [note.text for note in bridge.notes] == [
        "device Prob: no peer is connected (to_ros[0])",
        "device Prob: no peer sends it; did you mean 'Probe'? (to_ros[0])",
    ]


def test_a_peer_that_has_just_come_is_not_missed() -> None:
    bridge = Bridge()
    bridge.present = PresentSources(topics=("/tol",), devices=(), connected=0)
    assert bridge.until(8) == ["Prob"]
    bridge.present = PresentSources(topics=("/tol",), devices=(), connected=1)
    assert bridge.until(12) == [], "its first message is on its way"
    assert bridge.until(16) == ["Prob"]
    assert bridge.notes[-1].text == "device Prob: no peer sends anything (to_ros[0])"


def test_an_address_that_only_a_connected_peer_has_neither_comes_nor_leaves_without_one() -> None:
    bridge = Bridge(expected_sources(Config(), clock_from=["10.0.0.1:*"]))
    for peers, second, missing in (((), 8, []), (("192.168.7.4:4",), 16, ["10.0.0.1:*"]), ((), 24, [])):
        bridge.present = PresentSources(topics=(), devices=None, peers=peers, connected=len(peers))
        assert bridge.until(second) == missing
    assert [note.text for note in bridge.notes] == ["peer 10.0.0.1:*: no such peer (--clock-from)"]


def test_a_source_that_comes_late_withdraws_its_line_and_one_that_leaves_is_missed_again() -> None:
    bridge = Bridge()
    assert bridge.until(7) == ["/tol"]
    bridge.present = PresentSources(topics=("/tol",), devices=("Prob",))
    assert bridge.until(20) == []
    assert [(note.code, note.text) for note in bridge.notes[1:]] == [
        ("source_came", "topic /tol: now arrives (to_igtl[0])")
    ]
    bridge.present = PresentSources(topics=("/tool",), devices=("Prob",))
    assert bridge.until(24) == [], "a program that is started again leaves for a moment"
    assert bridge.until(40) == ["/tol"]
    assert [note.text for note in bridge.notes[2:]] == ["topic /tol: no publisher any more (to_igtl[0])"]
    bridge.present = PresentSources(topics=("/tol",), devices=("Prob",))
    assert bridge.until(60) == []
    assert [note.code for note in bridge.notes[3:]] == ["source_came"]


def test_sources_that_cannot_be_seen_to_leave_are_not_looked_for_once_they_came() -> None:
    bridge = Bridge([each for each in EXPECTED if each.kind == "device"])
    bridge.present = PresentSources(topics=(), devices=("Prob",))
    assert bridge.until(20) == []
    looks = bridge.looks
    bridge.until(60)
    assert bridge.looks == looks and not bridge.notes


def test_a_link_has_notes_of_its_own() -> None:
    bridge = Bridge(expected_sources(Config(), connect=["10.0.0.5:18944"]))
    bridge.present = PresentSources(links=())
    assert bridge.until(20) == ["10.0.0.5:18944"] and not bridge.notes


def test_a_type_that_does_not_fit_has_a_row_and_the_note_of_its_subscription() -> None:
    bridge = Bridge()
    bridge.until(7)
    bridge.present = PresentSources(topics={"/tol": ["x_msgs/msg/Y"]})
    assert bridge.until(30) == ["/tol"] and len(bridge.notes) == 1
    assert bridge.awaited.missing[0].text == "topic /tol: x_msgs/msg/Y has no conversion (to_igtl[0])"
    bridge.present = PresentSources(topics={"/tol": ["std_msgs/msg/String"]})
    assert bridge.until(40) == [] and bridge.notes[1].code == "source_came"


def wait_until(is_so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not is_so():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.ros
def test_a_node_of_ros_that_comes_late() -> None:
    """A bridge on a real graph; the five seconds are those of a manual clock."""
    from rclpy.context import Context
    from rclpy.node import Node
    from std_msgs.msg import String

    notes: list[Note] = []

    def seen(entry: Entry) -> None:
        if entry.kind is Kind.EDGE_NOTE:
            notes.append(Note.of(entry.data()))

    config = Config(to_igtl=(ToIgtlRow(topic="/wrods"), ToIgtlRow(topic="/odd", type="IMAGE")))
    bridge = LiveBridge(config, BridgeOptions((("127.0.0.1", 0),)), SystemClock(), seen)
    context = Context()
    context.init(args=[])
    node = Node("robot", context=context)
    bridge.start()
    try:
        for topic in ("/words", "/odd"):
            node.create_publisher(String, topic, 1)
        now_ns = SystemClock().monotonic_ns()

        def missing(*expected: str) -> bool:
            nonlocal now_ns
            now_ns += 6 * NS_PER_S
            bridge.awaited.look(now_ns)
            return [each.text for each in bridge.awaited.missing] == [*expected]

        odd = "topic /odd: std_msgs/msg/String has no conversion to IMAGE (to_igtl[1])"
        wait_until(lambda: missing("topic /wrods: no publisher; did you mean '/words'? (to_igtl[0])", odd))
        node.create_publisher(String, "/wrods", 1)
        wait_until(lambda: missing(odd))
    finally:
        node.destroy_node()
        context.try_shutdown()
        bridge.stop()
    assert [(note.code, note.stream) for note in notes if note.code == "source_came"] == [("source_came", "/wrods")]
