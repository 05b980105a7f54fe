"""The loss ledger: its sums close, however many streams there are."""

from __future__ import annotations

from igtl_gateway.gateway.log.ledger import MAX_STREAMS, OTHERS, PEERS, Ledger, gaps


def test_the_sums_of_every_stream_close_beyond_the_limit_too() -> None:
    ledger = Ledger()
    for number in range(MAX_STREAMS + 3):
        ledger.count("igtl_in", f"TRANSFORM/{number}", "received")
        if number % 2:  # the two books fill at a different pace
            ledger.count("igtl_in", f"TRANSFORM/{number}", "converted")
        else:
            ledger.drop("igtl_in", f"TRANSFORM/{number}", "too_many_streams")
    streams = ledger.to_dict()["igtl_in"]
    assert len(streams) == MAX_STREAMS + 1 and streams[OTHERS]["received"] == 3
    for counts in streams.values():
        assert counts["received"] == counts.get("converted", 0) + sum(counts.get("dropped", {}).values())


def test_gaps_are_found_in_streams_peers_and_sums() -> None:
    ledger = Ledger()
    ledger.count("igtl_in", "A", "received", 5)
    ledger.count("igtl_in", "A", "converted", 3)
    ledger.drop("igtl_in", "A", "stale", 2)
    ledger.count("igtl_out", "B", "sent", 7)
    ledger.count(PEERS, "1 host:5", "sent", 7)
    ledger.count(PEERS, "1 host:5", "delivered", 4)
    ledger.drop(PEERS, "1 host:5", "queue", 3)
    link = {"sent_messages": 4, "received_messages": 5, "queued_messages": 0, "dropped": {"B": 2}, "ignored": {"B": 1}}
    assert gaps({"streams": ledger.to_dict(), "links": {"0": link}}) == []
    assert gaps({"streams": ledger.to_dict()}) == gaps({}) == []  # of a scenario, which has no links
    assert gaps({"streams": ledger.to_dict(), "links": {"0": link | {"sent_messages": 5, "received_messages": 6}}}) == [
        "to all peers: sent 7, accounted for 8",
        "from all peers: the links received 6, the gateway 5",
    ]
    ledger.count("igtl_in", "A", "received")
    ledger.count(PEERS, "1 host:5", "sent")
    assert gaps({"streams": ledger.to_dict()}) == [
        "igtl_in A: received 6, accounted for 5",
        "to peer 1 host:5: sent 8, accounted for 7",
    ]


def test_the_totals_by_direction_have_the_streams_with_messages() -> None:
    ledger = Ledger()
    ledger.count("igtl_in", "STATUS/A", "received", 3)
    ledger.count("igtl_out", "STATUS/B", "sent", 2)
    ledger.count("igtl_out", "STATUS/C", "sent")
    ledger.count("ros_out", "/d", "published", 4)
    ledger.count("ros_in", "/e", "converted", 4)
    assert ledger.totals() == {
        "igtl_in": {"STATUS/A": 3},
        "igtl_out": {"STATUS/B": 2, "STATUS/C": 1},
        "ros_out": {"/d": 4},
    }
