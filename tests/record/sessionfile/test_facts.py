"""Session metadata and ledger: the right shapes pass, an error for any other names its field and value."""

from __future__ import annotations

import json
from typing import Any

import pytest

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.record.sessionfile import facts
from tests.tables import table
from tools.mcap_mutations import LEDGER


def test_a_ledger_with_every_section_passes() -> None:
    assert facts.ledger(json.dumps(LEDGER), "a.mcap") == LEDGER


@table(
    ("found", "words"),
    [
        ([], r"a.mcap: ledger: found \[\], expected an object"),
        ({"streams": 5}, r"ledger.streams: found 5, expected an object"),
        (
            {"streams": {"igtl_in": {"a": {"received": "3"}}}},
            'streams.igtl_in.a.received: found "3", expected an integer',
        ),
        ({"streams": {"igtl_in": {"a": {"dropped": 3}}}}, "streams.igtl_in.a.dropped: found 3, expected an object"),
        ({"links": {"1": {"dropped": {"a": True}}}}, "links.1.dropped.a: found true, expected an integer"),
        ({"link_faults": {"a": -1}}, "link_faults.a: found -1, expected an integer of 0 or more"),
        ({"link_faults": {"a": 10**30}}, "found 1000000000000000000000000000000, expected an integer"),
        ({"recorder": {"dropped_entries": 1.5}}, "recorder.dropped_entries: found 1.5"),
        ({"recovered": {"by": "x"}}, "recovered: found no field 'from'"),
        ({"ros_topics": {"/a": []}}, r"ros_topics./a: found \[\], expected an object"),
    ],
)
def test_a_ledger_of_another_shape_is_damage(found: Any, words: str) -> None:
    with pytest.raises(DamagedRecording, match=words):
        facts.ledger(json.dumps(found), "a.mcap")


@pytest.mark.parametrize("found", ["", "{", "[" * 100_000, '{"a":' * 90 + "1" + "}" * 90, "9" * 5000])
def test_a_ledger_that_is_no_json_is_damage(found: str) -> None:
    with pytest.raises(DamagedRecording, match=r"a\.mcap: ledger"):
        facts.ledger(found, "a.mcap")


@table(
    ("item", "value", "expected"),
    [
        ("part", "-1", "a number of at most 64 bits"),
        ("part", "9" * 5000, "a number of at most 64 bits"),
        ("part", "²", "a number of at most 64 bits"),
        ("snapshot_seconds", "soon", "a number of seconds"),
        ("custom_data", '["a"]', "an object"),
        ("custom_data", '{"a": {"b": 1}}', "a string"),
        ("record_include", '{"a": 1}', "an array"),
        ("slice_streams", "[1]", "a string"),
        ("slice_start_ns", str(2**64), "a number of at most 64 bits"),
    ],
)
def test_an_item_of_the_session_of_another_shape_is_damage(item: str, value: str, expected: str) -> None:
    with pytest.raises(DamagedRecording, match=f"a.mcap: session: {item}.*: found .*, expected {expected}"):
        facts.check_session({item: value}, "a.mcap")


def test_a_slice_has_both_its_ends() -> None:
    with pytest.raises(DamagedRecording, match="found no item 'slice_end_ns'"):
        facts.check_session({"slice_of": "a", "slice_start_ns": "1"}, "a.mcap")
    facts.check_session({"slice_of": "a", "slice_start_ns": "1", "slice_end_ns": "2", "unheard_of": "["}, "a.mcap")


@pytest.mark.parametrize("found", ["[]", "5", "{", '"text"', "[" * 5000])
def test_a_configuration_of_another_shape_is_damage(found: str) -> None:
    with pytest.raises(DamagedRecording, match="session: config"):
        facts.configuration({"config": found})
    assert facts.configuration({}) == {}
