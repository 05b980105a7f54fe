"""Settings from the command line, from parameters and from a file: who goes before whom, and what is refused."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app import bridge_options
from igtl_gateway.app.bridge_options import addresses
from igtl_gateway.app.setting_values import config_of, declared, of_parameters
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import bridge, main
from igtl_gateway.cli.settings import settled
from igtl_gateway.config.configuration import Config, PeerRow, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.config.setting import GATEWAY, HOST, IGTL, NONE, RECORD, ROWS, Setting
from igtl_gateway.config.settings import all_settings, parameters
from igtl_gateway.config.triggers import Trigger
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from tests.integration.bridge import Bridge, RawPeer, string
from tests.places import ROOT
from tests.tables import table

EXAMPLE = ROOT / "examples" / "operating-room.toml"

#: Options of ``bridge`` without a row: what it prints, how long it runs, where it runs.
NO_SETTINGS = {"help", "ros_args", *(row.name for row in bridge.OPTIONS)}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "or.toml"


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    bridge.add_arguments(parser)
    return parser.parse_args(words)


def values(*words: str, **overrides: Any) -> dict[str, Any]:
    return settled(parsed(*words), overrides)


def test_every_option_that_is_a_setting_is_a_row_and_the_other_way_round() -> None:
    parser = argparse.ArgumentParser()
    bridge.add_arguments(parser)
    options = {action.dest: max(action.option_strings, key=len) for action in parser._actions}
    assert {flag for dest, flag in options.items() if dest not in NO_SETTINGS} == {
        r.flag for r in all_settings() if r.flag
    }


#: Command lines in which a setting has no effect, for each row that needs something.
WITHOUT_EFFECT = {
    "trigger": "--record x --trigger mark",
    "tls_key": "--tls-key a.pem",
    "page_address": "--page-address 8944",
    "allow": "--connect :1 --allow 10.0.0.0/8",
    "max_clients": "--connect :1 --max-clients 3",
    "allow_origin": "--allow-origin https://viewer.clinic",
    "to_igtl": "--no-ros --send /a=A",
    "tf_out": "--relay --connect :1 --tf-out a:b",
    "to_ros": "--no-ros --kinds Probe=transform",
    "allow_in": "--allow-in PSM1/servo_cp",
    "allow_out": "--allow-out PSM1/servo_cp",
    "publish_tf": "--no-ros --no-tf",
    "diagnostics": "--no-ros --no-diagnostics",
    "site": "--no-ros --site or1",
    "site_budget": "--site-budget 100",
    "site_classes": "--site-class /a=poses",
    "overwrite": "--overwrite",
    "file_mode": "--file-mode 0640",
    "record_topics": "--no-ros --record a.mcap --record-topics /a",
    "record_all": "--no-ros --record a.mcap --record-all",
    "record_include": "--record-include /a",
    "record_exclude": "--record-exclude /a",
    "custom_data": "--custom-data a=b",
    "compression": "--compression zstd",
    "flush_interval": "--flush-interval 1",
    "fsync": "--fsync flush",
    "split_size": "--split-size 10",
    "split_duration": "--split-duration 10",
    "snapshot": "--snapshot 5",
    "seal": "--seal key.pem",
    "retention": "--retention 30d",
    "upload": "--upload s3://bucket",
    "upload_rate": "--upload-rate 3",
    "record_wait": "--record-wait",
    "outputs": "--outputs digest",
    "on_record_failure": "--on-record-failure stop",
    "video_codec": "--no-ros --video-codec h264",
    "video_bit_rate": "--video-bit-rate 100",
    "video_key_interval": "--video-key-interval 10",
    "faults": "--fault loss=1%",
    "fault_seed": "--relay --connect :1 --seed 3",
}


def test_the_table_of_settings_without_effect_is_complete() -> None:
    assert set(WITHOUT_EFFECT) == {row.name for row in all_settings() if row.needs and row.flag}


@table("name", WITHOUT_EFFECT)
def test_a_setting_without_effect_is_refused(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    flag = next(row.flag for row in all_settings() if row.name == name)
    assert main(["bridge", *WITHOUT_EFFECT[name].split()]) == 2
    error = capsys.readouterr().err
    assert flag in error and "has no effect here" in error and error.count("\n") == 1


def test_a_file_may_have_settings_for_other_sessions(path: Path) -> None:
    path.write_text('[[to_igtl]]\ntopic = "/a"\n[igtl]\nmax_clients = 2\n')
    found = values("--config", str(path), "--connect", ":1")
    config, _ = bridge_options.bridge_options(found, ros=False, node_name="n", given=["connect", "config"])
    assert config.to_igtl[0].topic == "/a"


def test_a_changed_setting_of_a_recording_is_refused_wherever_it_is(path: Path) -> None:
    path.write_text('[record]\nretention = "30 d"\n')
    with pytest.raises(ConfigError, match="--retention: found no --record FILE, expected it"):
        bridge_options.bridge_options(values("--config", str(path)), ros=True, node_name="n")


def test_triggers_of_a_file_and_of_the_command_line(path: Path) -> None:
    path.write_text(
        '[[trigger]]\nkind = "diagnostics"\npattern = "arm*"\nafter = 5\n[[trigger]]\nkind = "mark"\nbefore = 20\n'
    )
    words = ("--config", str(path), "--record", "x", "--snapshot", "30", "--trigger", "link_down")
    _, options = bridge_options.bridge_options(values(*words), ros=True, node_name="n")
    assert options.recording.triggers == (
        Trigger("link_down"),
        Trigger("diagnostics", "arm*", after_s=5.0),
        Trigger("mark", before_s=20.0),
    )
    assert options.record_topics == ("/diagnostics",)
    for more, error in (
        (("--trigger", "mark,before=31"), "--trigger mark: found before=31, expected at most --snapshot, 30"),
        (("--no-ros",), "--trigger diagnostics: found --no-ros or --relay, expected neither"),
    ):
        with pytest.raises(ConfigError, match=error):
            bridge_options.bridge_options(values(*words, *more), ros="--no-ros" not in more, node_name="n")
    with pytest.raises(ConfigError, match="--trigger: found no --snapshot SECONDS, expected it"):
        bridge_options.bridge_options(
            values("--record", "x", "--trigger", "mark"), ros=True, node_name="n", given=["trigger"]
        )
    path.write_text('[[trigger]]\nkind = "mrak"\n')
    with pytest.raises(ConfigError, match=r"trigger\[0\].kind: found 'mrak'"):
        values("--config", str(path))


def test_a_relay_makes_no_marks_of_messages() -> None:
    found = values("--relay", "--connect", ":1", "--mark-from", "Nurse")
    with pytest.raises(ConfigError, match="--mark-from: found --relay, expected one of them"):
        bridge_options.bridge_options(found, ros=True, node_name="n")


def test_without_anything_it_is_the_default() -> None:
    assert values() == {row.name: row.default for row in all_settings()}
    assert config_of(values()) == Config().watched()
    assert bridge_options.limits(values()) == PeerLimits()


def test_the_command_line_goes_before_the_parameters_and_these_before_the_file(path: Path) -> None:
    path.write_text(
        '[igtl]\nlisten = [":1"]\nidle_s = 60\nstall_s = 5\nqueue_mib = 7\n[gateway]\nbase_frame = "room"\n'
    )
    found = values("--listen", ":3", "--idle-s", "0", config=str(path), stall_s=6, listen=[":2"])
    assert (found["listen"], found["idle_s"], found["stall_s"], found["queue_mib"]) == ((":3",), 0.0, 6.0, 7)
    assert found["base_frame"] == "room"
    assert values("--config", str(path), config="elsewhere.toml")["queue_mib"] == 7


def test_rows_and_denied_types_of_the_command_line_come_first(path: Path) -> None:
    path.write_text('[gateway]\ndeny_in = ["A"]\n[[to_igtl]]\ntopic = "/a"\n')
    found = config_of(values("--config", str(path), "--deny-in", "B", "--send", "/b=B"))
    assert (found.deny_in, [row.topic for row in found.to_igtl]) == (("B", "A"), ["/b", "/a"])
    found = config_of(values("--config", str(path), "--deny-in", "B", deny_in=["C"], to_igtl=["/c"]))
    assert (found.deny_in, [row.topic for row in found.to_igtl]) == (("B", "C"), ["/c"])


def test_rows_as_parameters() -> None:
    found = config_of(
        values(
            to_igtl=['{"topic": "/camera", "device": "Camera", "max_age_s": 0.5}', "/tool=Tool:TRANSFORM"],
            to_ros=["Probe*=+slices", '{"device": "Arm", "frame_id": "room"}'],
            tf_out=["tool0:base_link"],
            peers=["127.0.0.1:1=plus"],
        )
    )
    assert {
        ToIgtlRow(topic="/camera", device="Camera", max_age_s=0.5),
        ToIgtlRow(topic="/tool", device="Tool", type="TRANSFORM"),
    } == set(found.to_igtl)
    assert found.to_ros == (ToRosRow(device="Probe*", kinds=("+slices",)), ToRosRow(device="Arm", frame_id="room"))
    assert found.tf_out == (TfOutRow(frames=("tool0",), base="base_link", device="tool0Tobase_link", type="TRANSFORM"),)
    assert found.peers == (PeerRow(at="127.0.0.1:1", profile="plus"),)


def test_what_is_declared_gives_the_same_session_again() -> None:
    first = values(
        "--deny-in", "COMMAND", "--send", "/a=B", "--tf-out", "t:b", "--kinds", "P=+slices", "--stall-s", "3"
    )
    shown = declared(first, config_of(first))
    assert set(shown) == set(parameters())
    again = values(
        **{name: list(value) if isinstance(value, tuple) else value for name, value in shown.items() if value != ""}
    )
    assert config_of(again) == config_of(first) and again["stall_s"] == 3.0


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"deny": ["A"]}, "parameter deny: unknown setting, expected one of config, listen"),
        ({"relay": True}, "parameter relay: unknown setting"),
        ({"max_clients": "2"}, "parameter max_clients: found '2', expected an integer"),
        ({"to_igtl": ["camera"]}, "parameter to_igtl: --send: found 'camera', expected /topic"),
        ({"to_igtl": ['{"topic": "/a", "devise": "A"}']}, "parameter to_igtl[0].devise: unknown setting"),
        ({"to_ros": ["{"]}, "parameter to_ros: found '{', expected a JSON object"),
    ],
)
def test_wrong_parameters(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as error:
        of_parameters(overrides)
    assert str(error.value).startswith(words)


def test_an_empty_list_has_no_type_in_ros() -> None:
    assert of_parameters({"deny_in": None, "allow": [], "listen": b""}) == {"deny_in": (), "allow": (), "listen": ()}


#: Kind of default → a value of another kind.
WRONG_TYPES: dict[type, object] = {bool: "x", int: "x", float: "x", str: 5, tuple: 5}


#: No address, size, rule or glob, and the name of another format than MCAP.
UNREADABLE = "=:70000 x.png"


def mistakes(row: Setting) -> list[object]:
    """Values that a setting may not have: of another type, outside of its range or its choices, unreadable."""
    found = [WRONG_TYPES[type(row.default)]]
    if row.least is not None and row.most is not None:
        found += [row.least - 1, row.most + 1]
    if row.choices:
        found.append("x y")
    if row.reads:
        found.append([UNREADABLE] if row.is_list else UNREADABLE)
    return found


def told(row: Setting, value: object) -> str:
    with pytest.raises(ConfigError) as error:
        row.check(value)
    return str(error.value)


CASES = [(row, value) for row in all_settings() for value in mistakes(row)]


@table(("row", "value"), CASES, ids=[f"{row.name}={value}" for row, value in CASES])
def test_a_mistake_has_the_same_message_everywhere(
    row: Setting, value: Any, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = told(row, value)
    if row.table in (GATEWAY, IGTL, HOST) and row.name != "max_body":  # a table in a file
        path.write_text(f"[{row.table}]\n{row.name} = {json.dumps(value)}\n")
        with pytest.raises(ConfigError) as error:
            values("--config", str(path))
        assert str(error.value) == f"{path}: {row.table}.{row.name}: {words}"
    if row.parameter:
        with pytest.raises(ConfigError) as error:
            of_parameters({row.name: value})
        assert str(error.value) == f"parameter {row.name}: {words}"
    text = value[0] if isinstance(value, list) else value
    if row.flag and row.table != ROWS and not isinstance(row.default, bool) and not (row.name, text) == ("listen", 5):
        if type(row.default) in (str, tuple) and not isinstance(text, str):
            return  # each word is a string
        with pytest.raises(SystemExit):
            parsed(f"{row.flag}={text}")
        assert capsys.readouterr().err.endswith(f"error: argument {row.flag}: {words}\n")


def test_the_keys_of_a_file_are_those_of_the_table(path: Path) -> None:
    for each in (GATEWAY, IGTL, HOST, RECORD):
        path.write_text(f"[{each}]\nno_such_key = 1\n")
        with pytest.raises(ConfigError) as error:
            values("--config", str(path))
        place, _, names = str(error.value).partition(": unknown setting, expected one of ")
        assert place == f"{path}: {each}.no_such_key"
        named = set(names.split(", "))
        rows = {row.name for row in all_settings() if row.table == each or (each == GATEWAY and row.table == ROWS)}
        assert named == rows
    assert {row.table for row in all_settings()} == {GATEWAY, IGTL, HOST, RECORD, ROWS, NONE}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[igtl]\nlisten = ':1'", "igtl.listen: found ':1', expected strings such as"),
        ("[igtl]\nlisten = ['http://:1']", "igtl.listen: found 'http://:1', expected tls://HOST:PORT"),
        ("[igtl]\nmax_body = 4", "igtl.max_body: found 4, expected a table such as { STRING = 4 }"),
        ("[igtl]\nmax_body = { STRING = -1 }", "igtl.max_body: found 'STRING=-1', expected TYPE=MIB"),
        ("igtl = 4", "found igtl = 4, expected a table [igtl]"),
        ("host = 1", "found host = 1, expected a table [host]"),
        ("connect = ['h:1']", "connect: found above all tables, expected in [igtl]"),
        ("[gateway]\nlisten = []", "gateway.listen: found in [gateway], expected in [igtl]"),
        ("[igtl]\nros_unit = 'm'", "igtl.ros_unit: found in [igtl], expected in [gateway]"),
        ("[host]\nstamp = 'source'", "host.stamp: found in [host], expected in [gateway]"),
        ("[[peers]]\nadress = 'h:1'", "peers[0].adress: unknown setting, expected one of at, profile"),
        ("[[to_ros]]\ndevise = 'A'", "to_ros[0].devise: unknown setting, expected one of "),
        ("[edge]\nlisten = []", "found [edge], expected [gateway], [host], [igtl], [record], [[crtk]], [[peers]]"),
    ],
)
def test_what_is_wrong_in_a_file_is_named_with_its_place(path: Path, text: str, words: str) -> None:
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        values("--config", str(path))
    assert str(error.value).startswith(f"{path}: {words}")


@pytest.mark.parametrize(
    ("text", "near"),
    [
        ("[gatway]", "gateway"),
        ("[[peer]]", "peers"),
        ("[[to_ros]]\ndevise = 'A'", "device"),
        ("[gateway]\nbas_frame = 'A'", "base_frame"),
    ],
)
def test_what_is_misspelt_in_a_file_is_answered_with_the_nearest_name(path: Path, text: str, near: str) -> None:
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"; did you mean '{near}'"):
        values("--config", str(path))


def test_files_of_tls_are_seen_from_the_folder_of_the_file(path: Path) -> None:
    path.write_text('[igtl]\ntls = true\ntls_cert = "or1.pem"\ntls_ca = "/clinic.pem"\n')
    found = values("--config", str(path), "--tls-key", "own.key")
    assert bridge_options.tls(found) == TlsFiles(path.parent / "or1.pem", Path("own.key"), Path("/clinic.pem"))


def test_the_session_does_not_know_of_the_edge(path: Path) -> None:
    path.write_text('[gateway]\nbase_frame = "room"\n[igtl]\nmax_clients = 2\n[host]\nlock_memory = true\n')
    assert Config.from_toml(path) == Config(base_frame="room")


def test_the_example_is_one() -> None:
    found = values("--config", str(EXAMPLE))
    assert Config.from_toml(EXAMPLE).deny_in and found["allow"] and bridge_options.limits(found) != PeerLimits()
    bridge_options.secured(found, *addresses(found["listen"], found["connect"]))


def test_a_bridge_keeps_to_it(path: Path) -> None:
    path.write_text('[igtl]\nlisten = ["127.0.0.1:0"]\nmax_clients = 1\nmax_body = { STRING = 0.001 }\n')
    bridge = Bridge("--no-ros", "--config", str(path), listen=False)
    try:
        (place,) = bridge.events[0]["listen"]
        with RawPeer(place["port"]) as first, RawPeer(place["port"]) as second:
            assert second.closed_by_peer() or first.closed_by_peer()
            told = bridge.wait_code("refused")
            assert "1 client is connected already" in json.dumps(told)
        with RawPeer(place["port"]) as peer:
            bridge.wait_code("link_up", 2)
            peer.send(string("x" * 2000))
            bridge.wait_code("too_large")
        assert bridge.end().code == 0
    finally:
        bridge.close()
