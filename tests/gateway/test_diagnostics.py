"""/diagnostics: levels by what happened since the last time, on manual time."""

from __future__ import annotations

from typing import Any

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config, TfOutRow, ToRosRow
from igtl_gateway.convert.common_msgs import DiagnosticArray
from igtl_gateway.convert.rosmsg import DiagnosticStatus
from igtl_gateway.gateway.diagnostics import ERROR, MAX_STREAMS, OK, STALE, WARN, Diagnostics, PeerFacts
from tests.gateway.test_guard import pose, tf_of
from tests.script import Script

STREAM = "igtl_gateway: OpenIGTLink TRANSFORM/Tool"


class Told:
    """A session and its diagnostics."""

    def __init__(self, config: Config) -> None:
        self.script = Script(config)
        self.diagnostics = Diagnostics("host")
        self.peers: list[PeerFacts] = []
        self.recorder: dict[str, Any] | None = None
        self.set_ns = 0  # by how much the host's clock was set

    def __call__(self) -> dict[str, DiagnosticStatus]:
        """The statuses by name, as a subscriber reads them; then a second passes."""
        gateway = self.script.gateway
        streams, watched = gateway.ledger.to_dict(), gateway.guard.items()
        utc_ns = self.script.now_ns + self.set_ns
        array = self.diagnostics.array(utc_ns, self.script.now_ns, streams, watched, self.peers, self.recorder)
        assert DiagnosticArray.unpack(array.pack()) == array
        self.script.now_ns += NS_PER_S
        return {status.name: status for status in array.status}


def test_a_stream_is_ok_then_stale_then_silent() -> None:
    told = Told(Config(watch=True, to_ros=(ToRosRow(max_age_s=0.5),)))
    told.script.up(1)
    told()
    for _ in range(10):
        told.script.igtl(pose(told.script.now_ns - 5_000_000))
    status = told()[STREAM]
    assert (status.level, status.hardware_id) == (OK, "host")
    values = dict(status.values)
    assert (values["received"], values["converted"], values["last_age_ms"]) == ("10", "10", "6.000")
    assert 9.0 < float(values["frequency_hz"]) < 10.0
    told.script.igtl(pose(told.script.now_ns - NS_PER_S))
    assert (told()[STREAM].level, told()[STREAM].level) == (ERROR, ERROR)  # until it is fresh again
    told.script.igtl(pose(told.script.now_ns))
    assert told()[STREAM].level == OK
    for _ in range(3):
        told.script.igtl(pose(told.script.now_ns))
    assert [told()[STREAM].level for _ in range(8)] == [OK] * 5 + [STALE] * 3


def test_a_stream_whose_peer_has_left_is_not_good_at_0_hz() -> None:
    told = Told(Config(watch=True))
    told.script.up(1)
    told()
    for _ in range(3):
        told.script.igtl(pose(told.script.now_ns))
    assert told()[STREAM].level == OK
    told.script.down(1)
    found = told()[STREAM]
    assert (found.level, found.message) == (STALE, "its peer has left")
    told.script.up(2)
    told.script.igtl(pose(told.script.now_ns), link=2)
    assert told()[STREAM].level == OK


def test_a_stream_that_comes_now_and_then_says_since_when_nothing_came() -> None:
    told = Told(Config(watch=True))
    told.script.up(1)
    told()
    told.script.now_ns += 3 * NS_PER_S
    told.script.igtl(pose(told.script.now_ns))
    found = [told()[STREAM] for _ in range(8)]
    assert {each.level for each in found} == {OK} and found[-1].message == "no message for 7 s"


def test_a_host_whose_clock_is_set_knows_all_the_same_how_long_a_stream_is_silent() -> None:
    told = Told(Config(watch=True))
    told()
    for _ in range(10):
        told.script.igtl(pose(told.script.now_ns))
    told()
    told.set_ns = -3600 * NS_PER_S
    assert [told()[STREAM].level for _ in range(7)] == [OK] * 4 + [STALE] * 3
    told.set_ns = 3600 * NS_PER_S
    told.script.igtl(pose(told.script.now_ns))
    (status,) = [each for each in told().values() if each.name == STREAM]
    assert status.level == OK and dict(status.values)["silent_s"] == "0.0"


def test_a_frame_that_is_withheld_is_an_error() -> None:
    told = Told(Config(tf_out=(TfOutRow(frames=("a",), base="base", max_age_s=0.5),)))
    told.script.ros("/tf", tf_of("base", "a", told.script.now_ns))
    assert told()["igtl_gateway: frame a in base"].level == OK
    told.script.ros("/tf", tf_of("base", "a", told.script.now_ns - NS_PER_S))
    assert told()["igtl_gateway: frame a in base"].level == ERROR


def test_what_is_lost_is_an_error_once_and_what_nobody_wants_is_none() -> None:
    told = Told(Config())
    told()
    told.script.igtl(pose(told.script.now_ns, (float("nan"), 0.0, 0.0)))
    status = told()[STREAM]
    assert status.level == ERROR and "not_finite" in status.message
    assert dict(status.values)["dropped.not_finite"] == "1"
    assert told()[STREAM].level == OK


def test_peers_and_the_recorder_have_statuses() -> None:
    told = Told(Config(watch=True))
    told.script.up(1)
    told.script.igtl(pose(told.script.now_ns + NS_PER_S))
    told.peers = [
        PeerFacts(1, "10.0.0.1:5", "server", sent=7, clock_offset="+1 ms"),
        PeerFacts(2, "10.0.0.2:5", "client", dropped=3),
    ]
    told.recorder = {"dropped_entries": 0, "written_entries": 5, "failure": ""}
    by_name = told()
    one, two = by_name["igtl_gateway: peer 1 10.0.0.1:5"], by_name["igtl_gateway: peer 2 10.0.0.2:5"]
    assert (one.level, one.hardware_id, two.level) == (WARN, "10.0.0.1:5", ERROR)
    assert "999 ms ahead of this clock" in dict(one.values)["clock"] and dict(one.values)["sent"] == "7"
    assert dict(one.values)["clock_offset"] == "+1 ms" and "clock_offset" not in dict(two.values)
    assert by_name["igtl_gateway: recorder"].level == OK
    told.recorder = {"dropped_entries": 2, "written_entries": 5, "failure": ""}
    by_name = told()
    assert by_name["igtl_gateway: recorder"].message == "lost 2 entries"
    assert by_name["igtl_gateway: peer 2 10.0.0.2:5"].level == OK  # none since
    told.recorder = {"dropped_entries": 2, "written_entries": 5, "failure": "disk full"}
    assert told()["igtl_gateway: recorder"].message == "disk full"


def test_a_disk_that_fills_and_a_file_that_is_behind_are_warnings() -> None:
    told = Told(Config())
    counts = {"dropped_entries": 0, "written_entries": 5, "failure": "", "behind_s": 0.0}
    for more, level, text in (
        ({"disk_left_s": 1900}, OK, "recording"),
        ({"disk_left_s": 600}, WARN, "the disk is full in 10 min at the present rate"),
        ({"disk_left_s": None, "behind_s": 1.25}, WARN, "the file is 1.25 s behind"),
        ({"disk_left_s": 60, "failure": "disk full"}, ERROR, "disk full"),
    ):
        told.recorder = counts | more
        found = told()["igtl_gateway: recorder"]
        assert (found.level, found.message) == (level, text)


def test_more_streams_than_anybody_reads_are_told_as_one() -> None:
    streams = {"ros_in": {f"/t{number}": {"received": 1} for number in range(MAX_STREAMS + 5)}}
    array = Diagnostics("host").array(NS_PER_S, NS_PER_S, streams, [], [], None)
    assert len(array.status) == MAX_STREAMS + 2
    assert (array.status[-1].level, array.status[-1].message) == (WARN, "5 more streams are not shown")


def test_the_budget_of_a_site() -> None:
    diagnostics = Diagnostics("host")
    found = [diagnostics.array(NS_PER_S, NS_PER_S, {}, [], [], None, None, count).status[-1] for count in (0, 7, 7)]
    assert [(status.level, status.message) for status in found] == [
        (OK, "within the budget"),
        (WARN, "budget exceeded: 7 messages dropped"),
        (OK, "within the budget"),
    ]
