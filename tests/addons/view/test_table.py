"""Every type that the gateway converts has a picture, and is drawn without a complaint."""

from __future__ import annotations

import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.table import PICTURES
from igtl_gateway.convert.table import TO_IGTL, TO_ROS
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.places import FIXTURES

from .conftest import Draw


def test_every_type_of_the_conversion_table_has_a_picture() -> None:
    converted = {row.message.TYPE for row in TO_ROS} | {row.message.TYPE for row in TO_IGTL}
    assert converted - PICTURES.keys() == set()


def test_a_row_stands_under_the_name_of_its_message() -> None:
    assert all(row.message.TYPE == name for name, row in PICTURES.items())


@pytest.mark.slow
@pytest.mark.parametrize("fixture", ["every-type", "paper-types", "star"])
def test_a_recording_read_back_holds_every_message(fixture: str, draw: Draw) -> None:
    with SessionFile.open(FIXTURES / f"{fixture}.mcap") as file:
        expected: dict[str, int] = {}
        for channel in file.channels:
            if channel.kind in (Kind.ROS_IN, Kind.ROS_OUT):
                expected[channel.topic] = expected.get(channel.topic, 0) + channel.count
        drawn = draw(entries=file.entries())
    seen = drawn.view.seen
    assert {shown.topic: drawn.count(shown.path) for shown in seen.shown.values()} == expected
    assert {shown.topic: shown.count for shown in seen.shown.values()} == expected
    assert not drawn.view.counts.refused
    assert not drawn.view.counts.without_picture
