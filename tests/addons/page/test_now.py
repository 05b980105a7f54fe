from __future__ import annotations

import json
from typing import Any

from igtl_gateway.addons.page.now import MAX_ROWS, Now, headline, others, slowest, with_names, wrong_things
from igtl_gateway.addons.page.sample import WATCHED
from igtl_gateway.addons.page.trouble import AHEAD_NS, ERROR, OFF, OK, SILENT, WAITING, WARNING
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
    found = usual | {"stale": 0, "episodes": [], "looks": 0, "silent_ns": None, "pause": (0, 0)} | changes
    return [found[name] for name in WATCHED]


def peer(number: int, name: str, **changes: Any) -> dict[str, Any]:
    usual = {"link": number, "peer": name, "role": "server", "connected": True, "profile": "", "received": 0, "sent": 0}
    return usual | {"dropped": 0, "queued": 0, "queued_bytes": 0, "unconfirmed_bytes": 0} | changes


def regular(now: Now, names: list[str], until_s: int = 10) -> dict[str, int]:
    """Streams of 10 Hz each, from 1 s on; return the counts of the last sample."""
    for half in range(2, 2 * until_s + 1):
        now.rows(facts(dict.fromkeys(names, 5 * half)), half * _S // 2, half * _S // 2)
    return dict.fromkeys(names, 10 * until_s)


def test_what_is_wrong_is_on_top_with_advice() -> None:
    now = Now()
    counts = regular(now, ["TRANSFORM/a", "TRANSFORM/b", "IMAGE/c", "TRANSFORM/d", "TRANSFORM/e"])
    sample = facts(
        {name: number + 100 for name, number in counts.items()} | {"IMAGE/c": counts["IMAGE/c"]},
        dropped={"TRANSFORM/b": {"bad_crc": 3}},
        watched=[watched("TRANSFORM/d", episodes=["stamp_future"]), watched("TRANSFORM/e", stale=2)],
    )
    found = now.rows(sample, 20 * _S, 20 * _S)["streams"]
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
    assert texts[2] == "silent for 10 s" and texts[3] == "stamps are in the future"
    assert found[3]["advice"] == "Synchronise the clocks of the two machines (NTP, PTP)"
    assert found[-1]["advice"] == "" and found[3]["stamps"] == "in the future"


def test_a_peer_that_is_silent_again_and_again_is_named() -> None:
    """5 Hz, and 4 s of each 14 silent: the guard's looks at each message, and samples twice a second."""
    now, looks, arrived, pause = Now(), 0, 0, (0, 0)
    states: list[tuple[float, str, str, str]] = []
    for step in range(1, 70 * 10 + 1):  # tenths of a second
        at_ns = step * _S // 10
        if step % 2 == 0 and at_ns % (14 * _S) <= 10 * _S:
            if arrived and at_ns - arrived >= _S // 2:
                pause = at_ns, at_ns - arrived
            looks, arrived = looks + 1, at_ns
        if step % 5 == 0:
            row = watched("TRANSFORM/Tracker", looks=looks, silent_ns=at_ns - arrived, pause=pause)
            sample = facts({"TRANSFORM/Tracker": looks}, peers=[peer(1, "a:1", received=looks)], watched=[row])
            rows = now.rows(sample, at_ns, at_ns)
            (link,), (stream,) = rows["links"], rows["streams"]
            states.append((at_ns / _S, link["state"], stream["state"], headline(rows)))
            assert len(wrong_things(rows)) == int(link["state"] != OK)
    by_time = {at_s: tuple(found) for at_s, *found in states}
    assert by_time[10.0] == (OK, OK, "")
    assert by_time[11.0] == (SILENT, SILENT, "peer of Tracker: silent for 1 s")
    assert by_time[16.0] == (WARNING, WARNING, "peer of Tracker: silent for 4 s, once in the last minute")
    assert by_time[26.0][2] == "peer of Tracker: silent for 2 s, and once before that in the last minute"
    assert by_time[60.0][2] == "peer of Tracker: silent for up to 4 s, 4 times in the last minute"
    assert (stream["gap_s"], stream["gap_utc_ns"]) == (4.0, 14 * _S)


def test_a_stream_that_the_guard_does_not_see_is_not_silent() -> None:
    """No peer takes it for 30 s, it is denied, or the gateway is not active; then a peer comes back."""
    now, looks, arrived, pause = Now(), 0, 0, (0, 0)
    for step in range(1, 60 * 10 + 1):  # tenths of a second
        at_ns = step * _S // 10
        if not 15 * _S < at_ns <= 45 * _S:
            if at_ns - arrived >= _S:
                pause = at_ns, at_ns - arrived
            looks, arrived = looks + 1, at_ns
        if step % 5 == 0:
            row = watched("IMAGE/Probe", looks=looks, silent_ns=at_ns - arrived, pause=pause)
            sample = facts({"IMAGE/Probe": step}, peers=[peer(1, "a:1", received=step)], watched=[row])
            rows = now.rows(sample, at_ns, at_ns)
            assert (rows["links"][0]["state"], rows["streams"][0]["state"]) == (OK, OK), at_ns / _S
            assert rows["streams"][0]["age_s"] < 1


def test_the_headline_names_the_worst_first() -> None:
    now = Now()
    counts = regular(now, ["TRANSFORM/a", "TRANSFORM/b"])
    found = now.rows(facts(counts | {"TRANSFORM/a": 150}, peers=[peer(0, "c:3", connected=False)]), 13 * _S, 0)
    assert (headline(found), others(found)) == ("b: silent for 3 s", "also peer c:3")
    found = now.rows(facts({}, peers=[peer(0, "c:3", connected=False)]), 13 * _S, 0)
    assert headline(Now().rows(facts({"TRANSFORM/a": 1}), _S, 0)) == ""
    rows = Now().rows(facts({}, peers=[peer(0, "c:3", connected=False)]), _S, 0)
    assert headline(rows) == "peer c:3: not connected; the bridge tries again"


def test_the_slowest_of_several_streams() -> None:
    now, names = Now(), {1: "Arm", 2: "Tracker"}
    for half in range(2, 20):
        counts = {f"TRANSFORM/{name}": half * 20 // number**2 for number, name in names.items()} | {"STRING/Rare": 1}
        ones = [watched(f"TRANSFORM/{name}", link=link, age_ns=link**8 * 7_000_000) for link, name in names.items()]
        rows = now.rows(facts(counts, watched=ones), half * _S // 2, 0)
    assert slowest(rows) == ["lowest rate: Tracker, 10 Hz", "highest latency: Tracker, 1,792 ms"]
    assert slowest(Now().rows(facts(counts), _S, 0)) == []


def test_a_stream_that_has_become_slower_is_named() -> None:
    now, received = Now(), 0
    for half in range(1, 121):
        received += 15 if half <= 80 else 3
        row = now.rows(facts({"TRANSFORM/a": received}), half * _S // 2, 0)["streams"][0]
        if half == 80:
            assert row["state"] == OK
    assert (row["state"], row["text"]) == (WARNING, "6 messages a second, 30 before")


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
        peer(1, "a:1", received=5),
        peer(2, "b:2", received=100, dropped=4, queued=9, queued_bytes=99),
        peer(0, "c:3", role="client", connected=False),
    ]
    sample = facts({}, peers=peers)
    sample["watched"] = [watched("TRANSFORM/a")]
    found = now.rows(sample, _S, 77)["links"]
    assert [(row["peer"], row["state"]) for row in found] == [("b:2", ERROR), ("c:3", WAITING), ("a:1", OK)]
    assert found[0]["text"] == "reads too slowly: 4 messages dropped"
    assert found[0]["advice"].startswith("Send less, or let the peer read faster")
    assert found[2]["latency_ms"] == 0.4 and found[2]["since_ns"] == 77 and found[1]["since_ns"] is None


def test_a_clock_that_is_ahead_is_said_in_words() -> None:
    ahead = watched("TRANSFORM/a", age_ns=-2_000_000_000, episodes=["stamp_future"])
    sample = facts({"TRANSFORM/a": 9}, peers=[peer(1, "a:1")], watched=[ahead, watched("TRANSFORM/b", age_ns=-900_000)])
    found = Now().rows(sample, _S, _S)
    (stream,), (link,) = found["streams"], found["links"]
    assert (stream["state"], stream["text"]) == (WARNING, "the sender's clock is ahead by 2 s")
    assert (link["state"], link["text"]) == (WARNING, "its clock is ahead by 2 s")
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
    assert (stream["state"], stream["text"]) == (WARNING, "messages are 1.40 s old on arrival")
    assert (link["state"], link["text"]) == (WARNING, "its messages are 1.40 s old on arrival")
    assert stream["way"] == "from a:1" and stream["advice"] == link["advice"] != ""
    sample["watched"] = [watched("TRANSFORM/a", link=3, age_ns=400 * 86_400 * _S)]  # a replay
    assert Now().rows(sample, _S, _S)["links"][0]["state"] == OK
    assert AHEAD_NS == FUTURE_NS


def test_one_late_message_makes_no_peer_late() -> None:
    now = Now()
    for looks, age_ns in enumerate((1_000_000, 1_000_000, 900_000_000, 900_000_000, 900_000_000), start=1):
        sample = facts({}, peers=[peer(1, "a:1")], watched=[watched("TRANSFORM/a", looks=looks, age_ns=age_ns)])
        state = now.rows(sample, looks * _S, 0)["links"][0]["state"]
        assert state == (WARNING if looks == 5 else OK)


def test_a_peer_that_reads_slowly() -> None:
    sample = facts({}, peers=[peer(1, "a:1", queued=51, queued_bytes=5_406)])
    assert Now().rows(sample, _S, _S)["links"][0]["text"] == "reads slowly: 51 messages wait"
    now, texts = Now(), []
    for half, waits in enumerate((20_000, 0, *[70_000] * 7, 60_500, 0), start=2):
        found = now.rows(facts({}, peers=[peer(1, "a:1", unconfirmed_bytes=waits)]), half * _S // 2, 0)
        texts.append(found["links"][0]["text"])
    assert texts == [*[""] * 9, "reads slowly: 60.0 kB wait", ""]


def test_a_late_peer_and_its_stream_are_one_thing() -> None:
    links = [
        {"name": "", "called": "peer a:1", "peer": "a:1", "state": WARNING, "advice": "clocks"},
        {"peer": "b:2", "state": OK},
    ]
    streams = [
        {"name": f"n{number}", "way": way, "state": WARNING, "advice": advice}
        for number, (way, advice) in enumerate(
            (("from a:1", "clocks"), ("from a:1", "crc"), ("from b:2", "crc"), ("from ROS", "crc"), ("from ROS", "x"))
        )
    ]
    rows = {"links": links, "streams": streams}
    assert len(wrong_things(rows)) == 5 and others(rows) == "also streams n1, n2, n3 and 1 more"


def test_a_peer_that_has_left_keeps_its_row_and_its_streams_say_it() -> None:
    now, utc_ns = Now(), 1_000 * _S

    def rows(half: int, links: dict[int, str]) -> dict[str, Any]:
        received = 5 * min(half, 20)
        peers = [peer(link, address, received=10, sent=5 * half) for link, address in links.items()]
        looks = [watched("TRANSFORM/Tracker", link=link, looks=received, silent_ns=0) for link in links if link != 2]
        sample = facts({"TRANSFORM/Tracker": received}, peers=peers, watched=looks)
        return now.rows(sample, half * _S // 2, utc_ns + half * _S // 2)

    for half in range(2, 21):
        rows(half, {1: "a:1", 2: "b:2"})
    for half in range(21, 32):
        found = rows(half, {2: "b:2"})
    link, stream = found["links"][0], found["streams"][0]
    assert (link["name"], link["text"], link["left_ns"]) == ("Tracker", "left 5 s ago", utc_ns + 21 * _S // 2)
    assert (stream["text"], stream["way"]) == ("its peer has left", "from a:1, which has left")
    assert link["advice"] == stream["advice"] == "Start its program again, or look at its network"
    assert headline(found) == "peer of Tracker: left 5 s ago" and len(wrong_things(found)) == 1
    assert json.dumps(found)
    back = rows(32, {2: "b:2", 3: "a:7"})
    assert [row["peer"] for row in back["links"]] == ["b:2", "a:7"]
    assert "left" not in headline(back) and back["streams"][0]["way"] == "from a:7"
    for half in range(33, 250):
        found = rows(half, {2: "b:2"})
    assert [row["peer"] for row in found["links"]] == ["b:2"] and headline(found) == "Tracker: its peer has left"


def test_no_stream_is_good_whose_peer_has_left_or_that_pauses() -> None:
    """Streams of peers that left were good at 0.00 Hz: a STRING, a query, and what the gateway made of them."""
    now = Now()
    counts = {"STRING/Plan": 1, "GET_STATUS/": 2, "STATUS/Robot": 3}

    def rows(half: int, links: list[int], counts: dict[str, int]) -> dict[str, dict[str, Any]]:
        peers = [peer(link, f"a:{link}", received=6, sent=9) for link in links]
        seen = [watched("STRING/Plan", link=link, looks=1, silent_ns=half * _S // 2) for link in links if link == 1]
        sample = facts(counts, peers=peers, watched=seen)
        sample["totals"] |= {"igtl_out": {"STATUS/": 4}, "ros_out": {"/plan": 1}, "ros_in": {"/pose": 2}}
        return {row["key"]: row for row in now.rows(sample, half * _S // 2, 0)["streams"]}

    for half in range(2, 6):
        found = rows(half, [1, 2], counts)
    assert {row["state"] for row in found.values()} == {OK}
    for half in range(6, 20):
        found = rows(half, [2], counts)
    assert {key: row["word"] for key, row in found.items()} == {
        "igtl_in STRING/Plan": "left",
        "igtl_in GET_STATUS/": "quiet",
        "igtl_in STATUS/Robot": "quiet",
        "ros_in /pose": "quiet",
        "igtl_out STATUS/": "quiet",
        "ros_out /plan": "quiet",
    }
    for half in range(20, 30):
        found = rows(half, [], counts)
    assert {row["state"] for row in found.values()} == {OFF} and found["igtl_in GET_STATUS/"]["word"] == "left"
    assert not any(row["rate_hz"] for row in found.values())
    shown = now.rows(facts(counts), 15 * _S, 0)
    assert (shown["inputs"], shown["arriving"]) == (3, 0) and not [row for row in wrong_things(shown) if "way" in row]
    back = rows(32, [3], counts | {"STATUS/Robot": 9})
    assert back["igtl_in STATUS/Robot"]["state"] == OK


def test_a_message_without_a_device_name_has_the_name_of_its_type() -> None:
    (row,) = Now().rows(facts({"GET_STATUS/": 2}), _S, 0)["streams"]
    assert (row["name"], row["type"]) == ("GET_STATUS", "without a device name,")


def test_a_peer_that_only_receives_has_left_though_another_one_is_there() -> None:
    now = Now()
    peers = [peer(number, f"127.0.0.1:{number}", sent=9) for number in (1, 2)]
    now.rows(facts({}, peers=peers), _S, 0)
    found = now.rows(facts({}, peers=peers[1:]), 2 * _S, 0)
    assert [(row["peer"], row["text"]) for row in found["links"]] == [
        ("127.0.0.1:1", "left 0 s ago"),
        ("127.0.0.1:2", ""),
    ]
    found = now.rows(facts({}, peers=[peers[1], peer(3, "127.0.0.1:3", sent=1)]), 3 * _S, 0)
    assert [row["peer"] for row in found["links"]] == ["127.0.0.1:2", "127.0.0.1:3"]


def test_a_note_has_the_name_of_the_peer() -> None:
    names = {"127.0.0.1:4031": "Tracker", "[::1]:80": "slicer"}
    texts = ["127.0.0.1:4031 dropped 7", "to 127.0.0.1:40312", "link 2 [::1]:80 is closed", "at 12:30:4031: x"]
    found = with_names([{"text": text, "code": "x"} for text in texts], names)
    assert [note["text"] for note in found] == [
        "Tracker (127.0.0.1:4031) dropped 7",
        "to 127.0.0.1:40312",
        "link 2 slicer ([::1]:80) is closed",
        "at 12:30:4031: x",
    ]


def test_those_who_have_left_are_bounded_and_a_port_scan_leaves_none() -> None:
    now = Now()
    now.rows(facts({}, peers=[peer(link, f"a:{link}", received=link % 2) for link in range(1, 100)]), _S, 0)
    found = now.rows(facts({}), 2 * _S, 0)
    assert len(found["links"]) == 12 and {row["state"] for row in found["links"]} == {WAITING}
    assert all(int(row["peer"][2:]) % 2 for row in found["links"])


def test_rates_are_per_direction_and_per_message() -> None:
    now = Now()
    for half in range(2, 20):
        peers = [peer(link, f"a:{link}", received=15 * half * (link == 1), sent=40 * half) for link in range(1, 6)]
        sample = facts({"TRANSFORM/a": 15 * half}, peers=peers)
        sample["totals"]["igtl_out"] = {"TRANSFORM/b": 200 * half}
        found = now.rows(sample, half * _S // 2, 0)
    assert [(row["from_hz"], row["to_hz"]) for row in found["links"]] == [(30, 80), *[(0, 80)] * 4]
    out = found["streams"][1]
    assert (out["name"], out["rate_hz"], out["way"]) == ("b", 80, "to 5 peers")
    for half in range(20, 40):
        peers = [peer(link, f"a:{link}", sent=(40 * link * half)) for link in range(1, 3)]
        sample["totals"]["igtl_out"] = {"TRANSFORM/b": 120 * half}
        found = now.rows(sample | {"peers": peers}, half * _S // 2, 0)
    out = next(row for row in found["streams"] if row["name"] == "b")
    assert (out["rate_hz"], out["way"]) == (240, "to 2 peers, all together")
    for receivers, rate, way in ((1, 240, "to 1 of 2 peers"), (2, 120, "to 2 peers")):
        found = now.rows(sample | {"peers": peers, "receivers": {"TRANSFORM/b": receivers}}, half * _S // 2, 0)
        out = next(row for row in found["streams"] if row["name"] == "b")
        assert (out["rate_hz"], out["way"]) == (rate, way)


def test_without_ros_nothing_goes_to_it() -> None:
    sample = facts({"TRANSFORM/a": 9}) | {"ros": False}
    sample["totals"] |= {"ros_out": {"/a": 9}}
    found = Now().rows(sample, _S, _S)
    assert ([row["side"] for row in found["streams"]], found["unsent"]) == (["igtl_in"], 1)


def test_what_goes_out_is_below_and_is_never_silent() -> None:
    now = Now()
    counts = regular(now, ["TRANSFORM/a"])
    sample = facts(counts)
    sample["totals"] |= {"ros_out": {"/a": 9}, "ros_in": {"/b": 1}}
    found = now.rows(sample, 30 * _S, 30 * _S, {"/a": "std_msgs/msg/String"})
    assert [(row["name"], row["way"], row["state"]) for row in found["streams"]] == [
        ("a", "from OpenIGTLink", SILENT),
        ("/b", "from ROS", OK),
        ("/a", "to ROS", OK),
    ]
    assert found["streams"][2]["type"] == "std_msgs/msg/String" and found["inputs"] == 2
