"""The verbs as functions give what the command line prints."""

from __future__ import annotations

import inspect
import json
import socket
import threading
from dataclasses import fields
from pathlib import Path

import pytest

import igtl_gateway
from igtl_gateway.addons.review import Thresholds
from igtl_gateway.api.conversation import Wait
from igtl_gateway.app.replay_options import ReplayOptions
from igtl_gateway.app.replay_settings import REPLAY
from igtl_gateway.base.errors import ConfigError, DamagedRecording, GatewayError, UnsupportedRecording
from igtl_gateway.cli import main
from tests.places import ROOT
from tests.tables import table

FIXTURES = ROOT / "fixtures"
STAR = FIXTURES / "star.mcap"
LEGO = FIXTURES / "lego.mcap"


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, object]]:
    code = main([*arguments, "--json"])
    found: dict[str, object] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return code, found


def test_verify(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    result = igtl_gateway.verify(str(LEGO))
    assert printed(capsys, "verify", str(LEGO)) == (0, json.loads(json.dumps(result.to_dict())))
    assert result.good
    assert 0 < result.outputs == result.equal
    config = tmp_path / "other.toml"
    config.write_text('[gateway]\nigtl_unit = "m"\n', "utf-8")
    changed = igtl_gateway.verify(LEGO, config=config)
    assert not changed.good
    assert changed.differences[0].seq > changed.differences[0].cause > 0
    assert changed.config == str(config)


def test_diff(capsys: pytest.CaptureFixture[str]) -> None:
    assert igtl_gateway.diff(LEGO, LEGO).equal
    result = igtl_gateway.diff(LEGO, FIXTURES / "brain.mcap")
    assert printed(capsys, "diff", str(LEGO), str(FIXTURES / "brain.mcap")) == (
        1,
        json.loads(json.dumps(result.to_dict())),
    )
    with pytest.raises(ConfigError, match=r"^tolerance_mm: found -1, expected 0 or more$"):
        igtl_gateway.diff(LEGO, LEGO, tolerance_mm=-1)


@pytest.mark.slow
def test_review() -> None:
    found = igtl_gateway.review(STAR, clouds=2)
    assert found.last.stitches
    with pytest.raises(ConfigError, match=r"^look_mm: found 2.0, expected at most wrong_mm, 1.0$"):
        igtl_gateway.review(STAR, thresholds=Thresholds(look_mm=2.0))
    with pytest.raises(GatewayError, match="lego"):
        igtl_gateway.review(LEGO)


def test_replay_to_a_peer(capsys: pytest.CaptureFixture[str]) -> None:
    lines: list[str] = []
    with igtl_gateway.serve(0, queue_messages=100_000) as server:
        address = (server.host, server.port)
        result = igtl_gateway.replay_recording(LEGO, connect=[address], rate=None, on_line=lines.append)
        server._run(Wait(lambda: server.counts.received >= result.messages or None, 10, "all messages"))
        assert result.complete
        assert result.account is not None
        assert result.account["sent"] == result.messages == sum(result.streams.values()) == server.counts.received
        code, facts = printed(
            capsys,
            "replay",
            str(LEGO),
            "--to",
            "igtl",
            "--connect",
            f"127.0.0.1:{server.port}",
            "--as-fast-as-possible",
        )
    assert (code, facts["sha256"], facts["messages"]) == (0, result.sha256, result.messages)
    assert lines[0].startswith(f"{LEGO}: the recorded bytes")
    assert capsys.readouterr().out == ""


def test_replay_stops() -> None:
    stop = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    threading.Timer(0.1, stop.set).start()
    with pytest.raises(GatewayError, match="stopped before it started"):  # no peer came
        igtl_gateway.replay_recording(LEGO, listen=[("127.0.0.1", port)], stop=stop)


@table(
    ("options", "text"),
    [
        ({"rate": -1.0}, "rate: found -1.0, expected a number above 0"),
        ({"rate": "2"}, "rate: found '2', expected a number"),
        ({"to": "ros", "listen": [("127.0.0.1", 0)]}, "listen: found to='ros', expected to='igtl' or to='both'"),
        ({"to": "rviz"}, "to: found 'rviz', expected one of igtl, ros, both"),
        ({"listen": "127.0.0.1:0"}, "listen: found '127.0.0.1:0', expected a list of pairs"),
        ({"connect": [("127.0.0.1", "18944")]}, r"connect: found \('127.0.0.1', '18944'\), expected a list"),
        ({"clock_hz": 10.0}, "clock_hz: found to='igtl', expected to='ros' or to='both'"),
        ({"wait_peers": -1}, "wait_peers: found -1, expected 0 or more"),
        ({"delay_s": float("nan")}, "delay_s: found nan, expected 0 to 31622400"),
        ({"delay_s": None}, "delay_s: found None, expected a number$"),
        ({"start": 1e5}, "start: found"),
        ({"fault": "luck=1%"}, "fault: .*luck"),
        ({"fault": "clock-step=1s", "restamp": "now"}, "fault: clock-step: found restamp='now', which replaces"),
        ({"rat": 2.0}, "rat: unknown setting, .*did you mean 'rate'"),
        ({"as_fast_as_possible": True}, "as_fast_as_possible: unknown setting"),
        ({"seed": 3}, "seed: found no fault"),
        ({"restamp": "later"}, "restamp: found 'later', expected one of keep, now, shift"),
        ({"ros_args": ["-r", "__ns:=/a"]}, "ros_args: found to='igtl', expected ROS"),
    ],
)
def test_arguments_of_replay(options: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match="^" + text):
        igtl_gateway.replay_recording(LEGO, **options)  # type: ignore[arg-type]


def test_the_signature_of_replay_is_the_table() -> None:
    names = inspect.signature(igtl_gateway.replay_recording).parameters
    assert {row.name for row in REPLAY if row.keyword} <= set(names)
    assert names["rate"].default == 1.0 and "settings" not in names and "step" not in names


def test_the_table_of_replay_and_its_options_have_the_same_names() -> None:
    used = {each.name for each in fields(ReplayOptions)} - {"tls_listen", "tls_connect", "paused", "ros_args"}
    of_the_command_line = {"json", "tls_cert", "tls_key", "tls_ca", "as_fast_as_possible", "start_paused", "step"}
    assert {row.name for row in REPLAY} - of_the_command_line == used


def test_other_files(tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(b"not a recording")
    for call in (igtl_gateway.verify, igtl_gateway.review, igtl_gateway.replay_recording):
        with pytest.raises((UnsupportedRecording, DamagedRecording), match=r"other\.mcap"):
            call(other)
