"""The percentiles of the native passage."""

from __future__ import annotations

import time
from typing import Any

import pytest

from igtl_gateway.app.passage import PHASES, StreamReports, percentiles, why_not_native
from igtl_gateway.base.clock import ManualClock, SystemClock
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.native.passage import is_compiled
from tests.gateway.fastpath.test_passage_streams import pose, scene, transform, wait_for


def test_percentiles_are_those_of_the_bucket_that_has_them() -> None:
    counts = [(1_000, 500), (2_000, 490), (80_000, 9), (900_000, 1)]
    assert percentiles(counts) == {"p50_us": 1.0, "p99_us": 2.0, "p999_us": 80.0, "max_us": 900.0}
    assert percentiles([(7, 1)]) == dict.fromkeys(("p50_us", "p99_us", "p999_us", "max_us"), 0.007)


def test_a_stream_is_reported_once_and_again_when_it_becomes_native() -> None:
    ledger = Ledger()
    reports = StreamReports(ledger)
    ledger.count("igtl_in", "SENSOR/Force", "converted", 1_000)
    ledger.count("igtl_in", "STATUS/Once", "converted")
    ledger.count("igtl_in", "POLYDATA/Model", "converted", 1_000)
    for rare in ("STATUS", "COMMAND", "GET_IMAGE", "STT_TDATA"):
        ledger.count("igtl_in", f"{rare}/Slicer", "converted", 1_000)
    ledger.count("ros_in", "/denied", "received", 1_000)
    waits = {("igtl_in", "TRANSFORM/Tool"): "/tf waits", ("ros_in", "/robot"): ""}
    passes = dict.fromkeys(waits, "")
    found = [[note.text for note in reports.look(waits)] for _ in range(7)]
    assert found == [
        ["/robot takes the fast way"],
        *([] for _ in range(4)),
        [
            "POLYDATA/Model takes the slower way: surfaces have no fast one",
            "SENSOR/Force takes the slower way: its type or profile has no fast one",
            "TRANSFORM/Tool takes the slower way: /tf waits",
        ],
        [],
    ]
    assert [note.text for note in reports.look(passes)] == ["TRANSFORM/Tool takes the fast way"]
    assert reports.look(passes) == reports.look(waits) == []


def test_a_peer_that_invents_names_does_not_flood_the_terminal() -> None:
    reports = StreamReports(Ledger())
    assert len(reports.look({("igtl_in", f"TRANSFORM/{number}"): "" for number in range(1_000)})) == 200


def test_without_a_native_passage_the_bridge_has_the_cause() -> None:
    clock = SystemClock()
    causes = {"it is turned off": False, "--relay": True, "--view": True}
    if is_compiled():
        assert why_not_native(clock, causes) == "--relay"
        assert why_not_native(clock, dict.fromkeys(causes, False)) == ""
        assert "clock" in why_not_native(ManualClock(), causes)


class CountedLock:
    """The sequence lock, and how often it was taken."""

    def __init__(self, lock: Any) -> None:
        self.taken = 0
        self._lock = lock

    def __enter__(self) -> None:
        self.taken += 1
        self._lock.__enter__()

    def __exit__(self, *error: object) -> None:
        self._lock.__exit__(*error)


@pytest.mark.skipif(not is_compiled(), reason="the package was installed without its native passage")
def test_the_counts_of_many_streams_are_taken_over_in_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        peer = here.connect()
        sent = 0
        while here.native < 10:
            peer.send(b"".join(transform(sent, device=f"Tool{number}") for number in range(10)))
            sent += 10
            time.sleep(0.002)
        peer.send(b"".join(transform(sent, device=f"Tool{number}") for number in range(10)))
        wait_for(lambda: here.received("igtl_in") == sent + 10)
        passage = here.bridge._passage
        assert passage
        lock = CountedLock(passage._passage)
        monkeypatch.setattr(passage, "_passage", lock)
        here.bridge.collect()
        assert lock.taken == 1 + 3  # no more than four streams at a time


@pytest.mark.skipif(not is_compiled(), reason="the package was installed without its native passage")
def test_each_phase_of_a_message_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        peer = here.connect()
        sent = native = 0
        while native < 30:
            peer.send(transform(sent))
            here.send_ros(pose(sent), source_ns=1)
            sent += 1
            native += here.native == 2
            time.sleep(0.002)
        wait_for(lambda: here.received("igtl_in") == sent)
        times = here.bridge.native_times()
    assert list(times["ros_to_igtl"]) == list(PHASES)
    assert list(times["igtl_to_ros"]) == list(PHASES[1:])
    for phases in times.values():
        for found in phases.values():
            assert 0 < found["p50_us"] <= found["p99_us"] <= found["p999_us"] <= found["max_us"]
