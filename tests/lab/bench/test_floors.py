"""What rows are compared with."""

from __future__ import annotations

from igtl_gateway_lab.bench.floors import against_floor, against_hop, against_mixed_floor

FIGURES = {"p50_ms": 2.0, "p99_ms": 6.0, "p999_ms": 8.0, "received_per_s": 30.0}


def test_the_floor_is_the_sum_of_both_hops() -> None:
    told = against_floor({"rate_hz": 30.0} | FIGURES, {"p50_ms": 0.75}, {"p50_ms": 0.25})
    assert (told["floor_p50_ms"], told["ratio"]) == (1.0, 2.0)
    assert against_floor({"rate_hz": 30.0} | FIGURES, {"p50_ms": None}, {"p50_ms": 0.25})["ratio"] is None


def test_the_floor_of_a_flood_is_a_rate() -> None:
    told = against_floor({"rate_hz": None} | FIGURES, {"received_per_s": 60.0}, {"received_per_s": 90.0})
    assert told == {"floor_dds_per_s": 60.0, "floor_tcp_per_s": 90.0}
    told = against_floor({"rate_hz": None} | FIGURES, {"received_per_s": 60.0}, {"received_per_s": 90.0}, "zenoh")
    assert told == {"floor_zenoh_per_s": 60.0, "floor_tcp_per_s": 90.0}


def test_the_mixed_load_has_ratios_of_both_percentiles() -> None:
    told = against_mixed_floor(FIGURES, {"p50_ms": 1.0, "p99_ms": 4.0, "p999_ms": 5.0})
    assert (told["ratio_p50"], told["ratio_p99"], told["floor_p999_ms"]) == (2.0, 1.5, 5.0)


def test_every_bridge_is_compared_with_the_hop() -> None:
    row = {"direction": "ros-to-igtl", "rate_hz": 30.0, "gateway_cpu_us_per_message": 100.0} | FIGURES
    hop = row | {"bridge": "hop", "p50_ms": 1.0, "gateway_cpu_us_per_message": 40.0}
    ours, theirs, same = against_hop([row, row | {"bridge": "x"}, hop])
    assert (ours["ratio_hop"], theirs["ratio_hop"]) == (2.0, 2.0)
    assert (ours["hop_p50_ms"], ours["hop_cpu_us_per_message"]) == (1.0, 40.0)
    assert same == hop


def test_the_hop_of_a_flood_is_a_rate() -> None:
    row = {"direction": "ros-to-igtl", "rate_hz": None} | FIGURES
    ours, _ = against_hop([row, row | {"bridge": "hop", "received_per_s": 50.0}])
    assert ours["hop_per_s"] == 50.0 and "ratio_hop" not in ours
