"""The table of settings: whole, in agreement with the places where the values go, and strict."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys

import pytest

from igtl_gateway.base import addons
from igtl_gateway.base.addons import ADDON_SETTINGS, part_of
from igtl_gateway.base.errors import ConfigError, MissingAddon
from igtl_gateway.base.realtime import PRIORITIES
from igtl_gateway.config.configuration import FITTING, LIVE, NAMING, Config
from igtl_gateway.config.setting import GATEWAY, HOST, NONE, RECORD, ROWS, Setting
from igtl_gateway.config.settings import SETTINGS, VIDEO_CODECS, all_settings, check_values, of_table, parameters
from igtl_gateway.edges.tcp import PeerLimits
from igtl_gateway.edges.video import CODECS, VideoOptions
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.wire.header import READING
from tests.tables import table

_ROWS = {row.name: row for row in all_settings()}


def test_the_table_has_the_fields_of_the_configuration_with_their_defaults() -> None:
    fields = {field.name: field.default for field in dataclasses.fields(Config)}
    rules = [fields.pop(name) for name in ("naming", "fitting", "reading")]
    assert rules == [NAMING, FITTING, READING]  # of the program, and no settings
    assert {*of_table(GATEWAY), *of_table(ROWS)} == set(fields)
    assert {fields.pop(name) for name in LIVE} == {None}  # of sessions that are not live
    assert {name: _ROWS[name].default for name in LIVE} == LIVE
    assert {name: _ROWS[name].default for name in fields} == fields


def test_the_defaults_are_those_of_the_parts() -> None:
    value = {row.name: row.default for row in all_settings()}
    limits, video, recording = PeerLimits(), VideoOptions(), RecordOptions()
    assert (value["max_clients"], value["queue_messages"]) == (limits.max_clients, limits.queue_messages)
    assert (value["queue_mib"], value["max_body_mib"]) == (limits.queue_bytes >> 20, limits.max_body >> 20)
    assert (value["max_messages"], value["stall_s"]) == (limits.messages_per_s, limits.stall_s)
    assert (value["min_rate_kib"], value["idle_s"]) == (limits.min_rate / 2**10, limits.idle_s)
    assert VIDEO_CODECS == CODECS
    assert (value["video_bit_rate"], value["video_key_interval"]) == (video.bit_rate // 1000, video.key_frame_interval)
    assert (value["compression"], value["flush_interval"]) == (recording.compression, recording.flush_s)
    assert value["fsync"] == recording.fsync
    assert _ROWS["realtime_priority"].most == PRIORITIES[-1]


@table("row", all_settings(), ids=lambda row: str(row.name))
def test_every_row_is_whole(row: Setting) -> None:
    assert _ROWS[row.name] is row  # no name is there twice
    assert row.check(row.default) == row.default
    assert row.about and not row.about.endswith(".")
    if isinstance(row.default, int | float) and not isinstance(row.default, bool) and row.parameter:
        assert row.range_text
    if row.name.endswith("_s"):
        assert row.unit == "s"
    for wrong in (None, {"a": 1}, ("a", 1), b"x"):
        with pytest.raises(ConfigError, match=r"found .*, expected "):
            row.check(wrong)


def test_numbers() -> None:
    stall, clients = _ROWS["stall_s"], _ROWS["max_clients"]
    assert stall.check(5) == 5.0 and isinstance(stall.check(5), float)
    assert clients.parse("7") == 7
    for text, words in {
        "x": "found 'x', expected an integer",
        "1.5": "found 1.5, expected an integer",
        "0": "found 0, expected 1 to 1000000",
    }.items():
        with pytest.raises(ConfigError) as error:
            clients.parse(text)
        assert str(error.value) == words
    for wrong in (math.nan, math.inf, -1, 0):
        with pytest.raises(ConfigError, match=r"expected 0\.001 to 31536000"):
            stall.check(wrong)
    with pytest.raises(ConfigError, match="found True, expected an integer"):
        clients.check(True)
    with pytest.raises(ConfigError, match="found 0, expected more than 0 and less than 86400"):
        _ROWS["command_timeout_s"].check(0)


def test_texts_and_lists() -> None:
    assert _ROWS["deny_in"].check(["GET_*"]) == ("GET_*",)
    assert _ROWS["video_codec"].check("") == ""
    with pytest.raises(ConfigError, match="found 'zip', expected one of auto, none, lz4, zstd"):
        _ROWS["compression"].check("zip")
    with pytest.raises(ConfigError, match="found 'A B', expected a type or a glob"):
        _ROWS["deny_in"].check(["GET_*", "A B"])


def test_the_settings_of_a_relay_are_no_parameters() -> None:
    # and the middleware, which has to be known before there is a node
    assert {row.name for row in all_settings()} - set(parameters()) == {
        "relay", "faults", "fault_seed", "ros", "site", "site_budget", "site_classes", "view",
    }  # fmt: skip


def test_settings_of_addons_are_those_that_the_core_knows_them_by() -> None:
    for addon, names in ADDON_SETTINGS.items():
        rows = part_of(addon, "settings:SETTINGS")
        assert {row.name: row.flag for row in rows} == names
        assert {row.table for row in rows} <= {HOST, RECORD, NONE}, "a recording does not need an add-on"
    assert {row.group for row in all_settings()} == {row.group for row in SETTINGS}


def test_settings_of_addons_load_nothing_else() -> None:
    program = (
        "import sys; from igtl_gateway.config import settings; before = set(sys.modules); settings.all_settings(); "
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    own = {f"igtl_gateway.addons.{addon}" for addon in ADDON_SETTINGS}
    parts = {f"{addon}.{part}" for addon in own for part in ("settings", "notation", "place")}
    door = {f"igtl_gateway.addon{group}" for group in ("", ".loading", ".settings", ".untrusted")}
    assert set(done.stdout.split()) <= {*door, "igtl_gateway.addons", *own, *parts}


def test_a_setting_of_an_absent_addon_is_reported_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(addons, "is_present", lambda _addon: False)
    with pytest.raises(MissingAddon, match="found no add-on 'view'"):
        check_values("record", RECORD, {"view": True})
