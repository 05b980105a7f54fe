"""A client that stops reading: the report of it."""

from __future__ import annotations

import numpy as np

from igtl_gateway_lab.bench.cases import FLOOD, BenchStream
from igtl_gateway_lab.bench.figures import Transmission
from igtl_gateway_lab.bench.stalled import Stall


def test_what_it_got_after_it_went_on() -> None:
    stall = Stall(resumed_ns=30)
    stall.note({"event": "edge_note", "links": [2], "data": {"dropped": {"IMAGE/R0_image_fullhd": 1}}})
    stall.note({"event": "link", "links": [2], "data": {"dropped": {"IMAGE/R0_image_fullhd": 3}}})
    stall.note({"event": "link", "links": [1], "data": {"dropped": {}}})
    stall.note({"event": "edge_note", "links": [], "data": {"dropped": 7}})
    passage = Transmission(np.array([10, 20, 30, 40, 50]), np.array([1, 4]), np.array([11, 60]))
    told = stall.to_row(BenchStream("image-fullhd", FLOOD), passage)
    assert told == {"sent_after_resume": 2, "delivered_after_resume": 1, "gateway_dropped": 3}
    assert stall.to_row(BenchStream("transform", 100.0), passage)["gateway_dropped"] == 0
