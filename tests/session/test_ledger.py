"""The loss ledger: its sums close, however many streams there are."""

from __future__ import annotations

from igtl_gateway.session.ledger import MAX_STREAMS, OTHERS, Ledger


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
