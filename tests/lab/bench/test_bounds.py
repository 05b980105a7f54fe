"""What should be is looked up in a table."""

from __future__ import annotations

from igtl_gateway_lab.bench import offline
from igtl_gateway_lab.bench.bounds import BOUNDS, shown, with_verdict
from igtl_gateway_lab.bench.cases import CASES
from igtl_gateway_lab.bench.figures import Row
from igtl_gateway_lab.bench.works import WORKS


def row(case: str, rate_hz: float | None = 30.0, **figures: float | str | None) -> Row:
    usual = {"direction": "ros-to-igtl", "sent": 10, "delivered": 10, "p50_ms": 1.0, "p99_ms": 2.0}
    return {"case": case, "rate_hz": rate_hz} | usual | figures


def test_what_is_met_and_what_is_not() -> None:
    good = with_verdict(row("transform", ratio_hop=1.05, gateway_cpu_us_per_message=250.0))
    assert good["bounds"] == {
        "lost <= 0": True,
        "ratio_hop <= 1.1": True,
        "p99/p50 <= 3": True,
        "gateway_cpu_us_per_message <= 300": True,
    }
    assert shown(good) == "met"
    assert shown(with_verdict(row("image-vga", ratio=1.5, delivered=9))) == "not lost <= 0, ratio <= 1.1"
    assert shown(with_verdict(row("points-10000", floor_p50_ms=0.5, p50_ms=2.6))) == "not ms over floor <= 2"


def test_a_flood_is_judged_by_its_rate() -> None:
    flood = row("transform", None, received_per_s=29_000.0, p99_ms=99.0, floor_dds_per_s=34_000.0)
    assert with_verdict(flood)["bounds"] == {
        "lost <= 0": True,
        "received_per_s >= 30000": False,
        "rate/DDS >= 0.85": True,
    }


def test_the_processor_time_of_a_message_depends_on_the_rate() -> None:
    slow, fast = (with_verdict(row("transform", rate, gateway_cpu_us_per_message=90.0)) for rate in (30.0, 1000.0))
    assert shown(slow) == "met"
    assert shown(fast) == "not gateway_cpu_us_per_message <= 60"


def test_the_mixed_load_is_judged_by_its_floor() -> None:
    def mixed(floor_p99_ms: float) -> Row:
        return row("mixed", 100.0, stream="transform", p99_ms=3.5, ratio_p99=1.4, floor_p99_ms=floor_p99_ms)

    assert shown(with_verdict(mixed(2.5))) == "met"
    assert shown(with_verdict(mixed(1.9))) == "not p99_ms where that of the floor is below 2 <= 3"


def test_other_bridges_and_peers_are_not_judged() -> None:
    for mark in ({"bridge": "hop"}, {"peer": "pyigtl"}):
        assert "bounds" not in with_verdict(row("transform", delivered=1) | mark)


def test_of_the_client_that_stopped_only_what_came_after_counts() -> None:
    after = {"sent_after_resume": 5, "delivered_after_resume": 4, "gateway_rss_peak_mb": 300.0}
    found = with_verdict(row("stalled-client", 100.0, stream="transform", delivered=2, **after))["bounds"]
    assert "gateway_rss_peak_mb <= 400" not in with_verdict(row("stalled-client", recording=True, **after))["bounds"]
    assert found == {"gateway_rss_peak_mb <= 400": True, "lost after resume <= 0": False}


def test_nothing_arrived_and_what_is_no_passage() -> None:
    assert shown(with_verdict(row("transform", delivered=0, p50_ms=None, p99_ms=None))) == "not lost <= 0"
    assert shown(with_verdict({"case": "start-up", "port_p50_s": 4.0})) == "not port_p50_s <= 3"
    assert shown(with_verdict({"case": "idle", "gateway_cpu_percent": 0.4})) == "met"
    work = {"case": "verify", "seconds": 1.0}
    assert with_verdict(work) == work and shown(work) == ""


def test_every_row_of_the_table_is_for_some_case() -> None:
    names = [
        (name, kind.kind)
        for name, case in (*CASES.items(), *((name, CASES["transform"]) for name in WORKS))
        for kind in case.streams
    ]
    names += [("offline", stream) for stream in offline.streams()]
    for bound in BOUNDS:
        assert any(
            bound.concerns(row(name, rate, stream=stream)) for name, stream in names for rate in (None, 30.0, 1000.0)
        ), bound
