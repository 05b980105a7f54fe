"""The table of cases."""

from __future__ import annotations

from igtl_gateway_lab.bench.cases import CASES, FLOOD, PAYLOADS, SLICER, TABLE_1, Direction
from tests.tables import table


@table("name", CASES)
def test_every_stream_has_a_name_of_its_own(name: str) -> None:
    streams = CASES[name].streams
    devices = [stream.device(direction) for stream in streams for direction in Direction]
    assert len(set(devices)) == 2 * len(streams)
    assert all(len(device) <= 20 for device in devices)  # the field of the header
    assert all(stream.kind in {*PAYLOADS, *SLICER.values()} for stream in streams)


def test_the_surgical_load_is_what_it_says() -> None:
    rates: dict[str, float] = {}
    for stream in CASES["mixed"].streams:
        rates[stream.kind] = rates.get(stream.kind, 0.0) + stream.rate_hz
    assert rates == {"transform": 1000.0, "image-vga": 30.0, "cloud-30k": 10.0, "string-100": 20.0}
    assert CASES["mixed"].together


def test_the_papers_table_is_made_of_cases() -> None:
    assert set(TABLE_1) <= CASES.keys()
    assert len(TABLE_1) == 11


def test_a_case_at_another_rate() -> None:
    flood = CASES["transform"].at(FLOOD)
    assert [stream.rate_hz for stream in flood.streams] == [0.0]
    assert flood.name == "transform"
