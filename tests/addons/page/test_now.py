from __future__ import annotations

from typing import Any

from igtl_gateway.addons.page.now import (
    AHEAD_NS,
    ERROR,
    MAX_ROWS,
    OK,
    OLD_NS,
    SILENT,
    WAITING,
    WARNING,
    Now,
    wrong_things,
)
from igtl_gateway.addons.page.sample import WATCHED
from igtl_gateway.doctor import checks
from igtl_gateway.gateway.log.timing import FUTURE_NS

_S = 1_000_000_000


def facts(
    received: dict[str, int],
    *,
    dropped: dict[str, dict[str, int]] | None = None,
    watched: list[list[Any]] | None = None,
    peers: list[dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """A sample of a bridge."""
    return {
        "watched": watched or [],
        "totals": {"igtl_in": received},
        "drops": {"igtl_in": dropped or {}},
        "peers": peers or [],
    }


def watched(stream: str, **changes: Any) -> list[Any]:
    usual = {"link": 1, "stream": stream, "age_ns": 400_000, "jitter_ns": 10_000, "stamped": True, "unset": False}
    found = usual | {"stale": 0, "episodes": []} | changes
    return [found[name] for name in WATCHED]


def peer(number: int, name: str, **changes: Any) -> dict[str, Any]:
    usual = {"link": number, "peer": name, "role": "server", "connected": True, "profile": "", "messages": 0}
    return usual | {"dropped": 0, "queued": 0, "queued_bytes": 0} | changes


def test_what_is_wrong_is_on_top_with_advice() -> None:
    now = Now()
    names = ["TRANSFORM/a", "TRANSFORM/b", "IMAGE/c", "TRANSFORM/d", "TRANSFORM/e"]
    now.rows(facts(dict.fromkeys(names, 0)), _S // 2, 0)
    now.rows(facts(dict.fromkeys(names, 10)), _S, _S)
    sample = facts(
        dict.fromkeys(names, 110) | {"IMAGE/c": 10},
        dropped={"TRANSFORM/b": {"bad_crc": 3}},
        watched=[watched("TRANSFORM/d", episodes=["stamp_future"]), watched("TRANSFORM/e", stale=2)],
    )
    found = now.rows(sample, 11 * _S, 11 * _S)["streams"]
    assert [(row["name"], row["state"]) for row in found] == [
        ("b", ERROR),
        ("e", ERROR),
        ("c", SILENT),
        ("d", WARNING),
        ("a", OK),
    ]
    texts = [row["text"] for row in found]
    assert texts[0] == "3 messages dropped: wrong CRC" and "compute it" not in found[0]["advice"]
    assert found[0]["advice"].startswith("The sender changes the body after computing the CRC")
    assert texts[2] == "no message for 10 s" and texts[3] == "stamps are in the future"
    assert found[3]["advice"] == "Synchronise the clocks of the two machines (NTP, PTP)"
    assert found[-1]["advice"] == "" and found[3]["stamps"] == "in the future"


def test_a_loss_is_a_problem_for_ten_seconds_and_stays_counted() -> None:
    now = Now()
    lost = facts({"TRANSFORM/a": 10}, dropped={"TRANSFORM/a": {"malformed": 1}})
    assert now.rows(lost, _S, _S)["streams"][0]["state"] == ERROR
    row = now.rows(facts({"TRANSFORM/a": 99}, dropped={"TRANSFORM/a": {"malformed": 1}}), 12 * _S, _S)["streams"][0]
    assert (row["state"], row["dropped"]) == (OK, 1)


def test_messages_without_a_reader_are_no_loss() -> None:
    sample = facts({"TRANSFORM/a": 10}, dropped={"TRANSFORM/a": {"no_peer": 5}})
    row = Now().rows(sample, _S, _S)["streams"][0]
    assert (row["state"], row["dropped"]) == (OK, 0)


def test_links() -> None:
    now = Now()
    peers = [
        peer(1, "a:1", messages=5),
        peer(2, "b:2", messages=100, dropped=4, queued=9, queued_bytes=99),
        peer(0, "c:3", role="client", connected=False),
    ]
    sample = facts({}, peers=peers)
    sample["watched"] = [watched("TRANSFORM/a")]
    found = now.rows(sample, _S, 77)["links"]
    assert [(row["peer"], row["state"]) for row in found] == [("b:2", ERROR), ("c:3", WAITING), ("a:1", OK)]
    assert found[0]["text"] == "reads too slowly: 4 messages dropped"
    assert found[0]["advice"].startswith("Send less, or let the peer read faster")
    assert found[2]["latency_ms"] == 0.4 and found[2]["since_ns"] == 77 and found[1]["since_ns"] is None


def test_a_sparkline_has_a_value_each_second() -> None:
    now = Now()
    for tenth in range(1, 36):
        row = now.rows(facts({"TRANSFORM/a": tenth}), tenth * _S // 10 + _S, 0)["streams"][0]
    assert row["spark"] == [9, 10, 10]
    assert (row["gap_s"], row["gap_utc_ns"]) == (0.1, 0)


def test_the_worst_gap_and_when_it_ended() -> None:
    now = Now()
    for second, received in ((1, 0), (2, 20), (3, 40), (10, 41), (11, 61)):
        row = now.rows(facts({"TRANSFORM/a": received}), second * _S, (100 + second) * _S)["streams"][0]
    assert (row["state"], row["gap_s"], row["gap_utc_ns"]) == (OK, 7.0, 110 * _S)


def test_a_clock_that_is_ahead_is_said_in_words() -> None:
    ahead = watched("TRANSFORM/a", age_ns=-2_000_000_000, episodes=["stamp_future"])
    sample = facts({"TRANSFORM/a": 9}, peers=[peer(1, "a:1")], watched=[ahead, watched("TRANSFORM/b", age_ns=-900_000)])
    found = Now().rows(sample, _S, _S)
    (stream,), (link,) = found["streams"], found["links"]
    assert (stream["state"], stream["text"]) == (WARNING, "the sender's clock is ahead by 2.0 s")
    assert (link["state"], link["text"]) == (WARNING, "its clock is ahead by 2.0 s")
    assert stream["advice"] == link["advice"] == "Synchronise the clocks of the two machines (NTP, PTP)"
    assert stream["latency_ms"] is None and (stream["ahead_ms"], link["ahead_ms"]) == (2_000.0, 2_000.0)
    sample["watched"] = [watched("TRANSFORM/a", age_ns=-900_000)]  # below what clocks on one network differ by
    assert Now().rows(sample, _S, _S)["links"][0]["state"] == OK
    sample["watched"] = [watched("TRANSFORM/a", age_ns=400 * 86_400 * _S)]  # a replay has no latency
    assert Now().rows(sample, _S, _S)["links"][0]["latency_ms"] is None


def test_a_peer_has_the_name_of_its_program_and_of_its_devices() -> None:
    peers = [peer(1, "a:1", profile="plus"), peer(2, "b:2", profile="unrecognised"), peer(3, "c:3", profile="slicer")]
    names = ["IMAGE/Probe", "TRANSFORM/Probe", "TRANSFORM/" + "x" * 99, "TRANSFORM/c", "TRANSFORM/d"]
    sample = facts({}, peers=[*peers, peer(4, "d:4")], watched=[watched(name) for name in names])
    sample["watched"] += [watched("TRANSFORM/Arm", link=2)]
    rows = {row["peer"]: row["name"] for row in Now().rows(sample, _S, _S)["links"]}
    assert rows == {"a:1": f"plus: Probe, {'x' * 40}, 2 more", "b:2": "Arm", "c:3": "slicer", "d:4": ""}


def test_a_peer_that_invents_names_does_not_fill_the_page() -> None:
    found = Now().rows(facts({f"TRANSFORM/{number}": 1 for number in range(2_000)}), _S, _S)
    assert len(found["streams"]) == MAX_ROWS and found["more"] == 2_000 - MAX_ROWS


def test_late_messages_and_the_peer_that_sends_them() -> None:
    late = watched("TRANSFORM/a", link=3, age_ns=1_400_000_000)
    sample = facts({"TRANSFORM/a": 9}, peers=[peer(3, "a:1")], watched=[late])
    found = Now().rows(sample, _S, _S)
    (stream,), (link,) = found["streams"], found["links"]
    assert (stream["state"], stream["text"]) == (WARNING, "messages are 1.4 s old on arrival")
    assert (link["state"], link["text"]) == (WARNING, "is late: its messages are 1.4 s old on arrival")
    assert stream["way"] == "from a:1" and stream["advice"] == link["advice"] != ""
    sample["watched"] = [watched("TRANSFORM/a", link=3, age_ns=400 * 86_400 * _S)]  # a replay
    assert Now().rows(sample, _S, _S)["links"][0]["state"] == OK
    assert OLD_NS == checks.OLD_NS and AHEAD_NS == FUTURE_NS


def test_a_peer_that_reads_slowly() -> None:
    sample = facts({}, peers=[peer(1, "a:1", queued=51, queued_bytes=5_406)])
    assert Now().rows(sample, _S, _S)["links"][0]["text"] == "reads slowly: 51 messages wait"


def test_a_late_peer_and_its_stream_are_one_thing() -> None:
    links = [{"peer": "a:1", "state": WARNING, "advice": "clocks"}, {"peer": "b:2", "state": OK, "advice": ""}]
    streams = [
        {"way": way, "state": WARNING, "advice": advice}
        for way, advice in (("from a:1", "clocks"), ("from a:1", "crc"), ("from b:2", "crc"), ("from ROS", "crc"))
    ]
    assert wrong_things({"links": links, "streams": streams}) == 4


def test_without_ros_nothing_goes_to_it() -> None:
    sample = facts({}) | {"ros": False}
    sample["totals"] |= {"ros_out": {"/a": 9}}
    assert Now().rows(sample, _S, _S)["streams"][0]["way"] == "for ROS, which is off"


def test_what_goes_out_is_below_and_is_never_silent() -> None:
    sample = facts({"TRANSFORM/a": 9})
    sample["totals"] |= {"ros_out": {"/a": 9}, "ros_in": {"/b": 1}}
    now = Now()
    now.rows(sample | {"totals": {"ros_in": {"/b": 1}}}, _S // 2, 0)
    now.rows(sample, _S, _S)
    found = now.rows(sample, 30 * _S, 30 * _S, {"/a": "std_msgs/msg/String"})
    assert [(row["name"], row["way"], row["state"]) for row in found["streams"]] == [
        ("a", "from OpenIGTLink", SILENT),
        ("/b", "from ROS", OK),
        ("/a", "to ROS", OK),
    ]
    assert found["streams"][2]["type"] == "std_msgs/msg/String" and found["inputs"] == 2
