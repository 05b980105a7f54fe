"""What a user can set: the names, units and bounds of the options of the bridge and of ``keep``."""

from __future__ import annotations

import pytest

from igtl_gateway.addons.upload.settings import KEEPING, SETTINGS
from igtl_gateway.base.errors import ConfigError

BY_NAME = {each.name: each for each in SETTINGS}
KEPT = {each.name: each for each in KEEPING}


def test_the_bridge_and_keep_have_the_same_options_and_keep_its_patience() -> None:
    assert list(BY_NAME) == ["upload", "upload_rate"]
    assert list(KEPT) == ["upload", "upload_rate", "patience"]
    assert [BY_NAME[name].default for name in BY_NAME] == [KEPT[name].default for name in BY_NAME] == ["", 0.0]
    assert KEPT["patience"].default == 60.0, "a minute, as `keep --help` states"
    assert [each.old for each in KEEPING] == [("--to",), ("--rate",), ()]


@pytest.mark.parametrize("name", [*KEPT])
def test_the_help_of_an_option_is_a_sentence_without_its_name(name: str) -> None:
    for each in (KEPT[name], *([BY_NAME[name]] if name in BY_NAME else [])):
        assert " " in each.about and name not in each.about.split()
        assert each.metavar and " " not in each.metavar


def test_an_upload_needs_a_recording_and_a_rate_an_upload() -> None:
    assert (BY_NAME["upload"].needs, BY_NAME["upload_rate"].needs) == (("record",), ("upload",))
    assert (KEPT["upload"].needs, KEPT["patience"].needs) == ((), ("upload",))
    assert (BY_NAME["upload_rate"].unit, KEPT["patience"].unit) == ("MB/s", "s")


def test_the_place_is_read_as_a_bucket() -> None:
    reads = BY_NAME["upload"].reads
    assert reads
    place = reads("s3://bucket/or1")
    assert str(place) == "s3://bucket/or1"
    with pytest.raises(ConfigError, match="expected"):
        reads("http://bucket")
