"""A bridge inside a program: settings, peers, recording, changes while it runs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway import Bridge
from igtl_gateway.base.errors import ConfigError, NoReply, RecordingError, Refused, Unavailable
from igtl_gateway.gateway.log.note import Note
from tests.addons.zenoh.routers import free_port, router
from tests.tables import table

LOCAL = ["127.0.0.1:0"]


def test_ros_over_zenoh(tmp_path: Path) -> None:
    port = free_port()
    with router(port), Bridge(listen=LOCAL, ros=f"zenoh:127.0.0.1:{port}", record=tmp_path / "out.mcap") as bridge:
        assert [note.code for note in bridge.notes] == ["zenoh_connected"]
        bridge.change(max_age_s=1.0)
    with pytest.raises(ConfigError, match="ros: found 'nothing', expected dds, zenoh or zenoh:ENDPOINT"):
        Bridge(listen=LOCAL, ros="nothing")
    with pytest.raises(ConfigError, match="ros_args: found ros='zenoh', expected ROS"):
        Bridge(listen=LOCAL, ros="zenoh", ros_args=["-r", "__ns:=/or1"])
    with pytest.raises(ConfigError, match="--node-name"):
        Bridge(listen=LOCAL, ros="zenoh", node_name="a b").start()


def test_zenoh_in_a_file_waits_for_ros(tmp_path: Path) -> None:
    file = tmp_path / "room.toml"
    file.write_text('[host]\nros = "zenoh:nowhere:1"\n')
    with Bridge(config=file, listen=LOCAL, ros=False) as bridge:
        assert bridge.addresses and not bridge.notes


def test_peers_record_and_verify(tmp_path: Path) -> None:
    notes: list[Note] = []
    out = tmp_path / "out.mcap"
    with Bridge(listen=LOCAL, ros=False, record=out, on_note=notes.append) as bridge:
        host, port = bridge.addresses[0]
        with igtl_gateway.connect(host, port) as peer:
            bridge.wait_peers()
            assert "TRANSFORM" in peer.query("CAPABILITY").describe()["types"]
            peer.send("TRANSFORM", "Tool", np.eye(4))
            bridge.change(deny_in=["STRING"])
            peer.send("STRING", "Text", "denied")
            assert peer.query("STATUS").describe()["code"] == 1  # after the others
            assert [link.connected for link in bridge.peers] == [True]
            with pytest.raises(ConfigError, match="expected"):
                bridge.change(deny_in="STRING")
        bridge.pause_recording()
        bridge.resume_recording()
        with pytest.raises(RecordingError, match="found no buffer"):
            bridge.save_snapshot()
        counts = bridge.counts
    assert counts.entries["igtl_in"] == 4
    assert counts.streams["igtl_in"]["STRING/Text"]["dropped"] == {"denied": 1}
    assert {"link_up", "link_down"} <= {note.code for note in notes}
    assert list(bridge.notes) == notes[-100:]
    assert bridge.recording is not None
    assert (bridge.recording.files, bridge.recording.failure) == ((out,), "")
    result = igtl_gateway.verify(out)
    assert result.good
    assert result.inputs > 4


def test_marks_are_recorded_also_while_the_recording_is_paused(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    bridge = Bridge(listen=LOCAL, ros=False, record=out)
    with pytest.raises(Unavailable, match="mark: found a bridge that does not run"):
        bridge.mark("early")
    with bridge:
        bridge.mark("start", "of the session", who="Kim")
        with bridge.phase("suture", "first"):
            bridge.pause_recording()
            bridge.mark("slip")
            with pytest.raises(ConfigError, match="found the phase 'suture' open already"):
                bridge.mark("suture", phase="begin")
            bridge.resume_recording()
        with pytest.raises(ConfigError, match="found the end of 'suture'"):
            bridge.mark("suture", phase="end")
        with pytest.raises(ConfigError, match="found label 'two: words'"):
            bridge.mark("two: words")
    with pytest.raises(Unavailable):
        bridge.mark("late")
    with igtl_gateway.open(out) as recording:
        assert [(mark.label, mark.text, mark.who, bool(mark.end_ns)) for mark in recording.marks] == [
            ("start", "of the session", "Kim", False),
            ("suture", "first", "", True),
            ("slip", "", "", False),
        ]
        assert not recording.marks[1].is_open
    assert igtl_gateway.verify(out).good


def test_a_mark_may_be_of_an_earlier_moment_of_the_session(tmp_path: Path) -> None:
    before_ns = time.time_ns()
    with Bridge(listen=LOCAL, ros=False, record=tmp_path / "a.mcap") as bridge:
        time.sleep(0.2)
        bridge.mark("early", ago_s=0.15)
        with pytest.raises(ConfigError, match=r"found 1 min ago, expected at most the "):
            bridge.mark("before", ago_s=60)
        now_ns = time.time_ns()
    with igtl_gateway.open(tmp_path / "a.mcap") as found:
        (mark,) = found.marks
    assert before_ns < mark.time_ns <= now_ns - 150_000_000


def test_marks_of_peers(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with Bridge(listen=LOCAL, ros=False, record=out, mark_from=["Nurse*"]) as bridge:
        with igtl_gateway.connect(*bridge.addresses[0], header_version=2) as peer:
            bridge.wait_peers()
            peer.send("STRING", "NurseNotes", "+suture: first")
            peer.send("STRING", "Other", "no mark")
            peer.send("STRING", "NurseNotes", "+suture")  # open already
            peer.command("Mark", "-suture", device="NurseNotes")
            answer = peer.command("Mark", "-suture", device="NurseNotes")
            assert not answer.succeeded and answer.reason.startswith("mark: found the end of 'suture'")
    with igtl_gateway.open(out) as recording:
        assert [(mark.label, mark.text, mark.who, mark.is_open) for mark in recording.marks] == [
            ("suture", "first", "NurseNotes", False)
        ]
        assert [note.code for note in recording.notes if "mark" in note.code] == [
            "mark",
            "mark_refused",
            "mark",
            "mark_refused",
        ]
        assert recording.ledger is not None
        counts = recording.ledger["streams"]["igtl_in"]
        assert counts["STRING/NurseNotes"]["converted"] == 2
        assert not recording.ledger["gaps"]
    assert igtl_gateway.verify(out).good


def test_a_mark_of_a_peer_has_the_time_of_its_stamp(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with Bridge(listen=LOCAL, ros=False, record=out, mark_from=["Nurse"]) as bridge:
        with igtl_gateway.connect(*bridge.addresses[0]) as peer:
            bridge.wait_peers()
            time.sleep(0.2)
            now_ns = time.time_ns()
            peer.send("STRING", "Nurse", "late", time_ns=now_ns - 100_000_000)
            peer.send("STRING", "Nurse", "before", time_ns=now_ns - 3600 * 10**9)
            peer.command("Mark", "early @-0.15", device="Nurse")
        later_ns = time.time_ns()
    with igtl_gateway.open(out) as recording:
        early, late, before = sorted(recording.marks, key=lambda mark: mark.label != "early")
        assert late.time_ns == pytest.approx(now_ns - 100_000_000, abs=50_000_000)
        assert now_ns - 150_000_000 <= early.time_ns <= later_ns - 150_000_000
        assert now_ns <= before.time_ns <= later_ns
        (note,) = [note.text for note in recording.notes if note.code == "mark_time"]
        assert note.startswith("mark: found 1 h ") and note.endswith("mark before is of its arrival")
    assert igtl_gateway.verify(out).good


def test_a_relay_has_marks(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    target = ["127.0.0.1:1"]
    with (
        Bridge(listen=LOCAL, connect=target, relay=True, record=out) as bridge,
        bridge.phase("suture"),
        pytest.raises(ConfigError, match="open already"),
    ):
        bridge.mark("suture", phase="begin")
    with igtl_gateway.open(out) as recording:
        assert [mark.label for mark in recording.marks] == ["suture"]


def test_a_relay_between_scripts(tmp_path: Path) -> None:
    with (
        igtl_gateway.serve(0) as server,
        Bridge(listen=LOCAL, connect=[f"127.0.0.1:{server.port}"], relay=True) as bridge,
        igtl_gateway.connect(*bridge.addresses[0]) as peer,
    ):
        server.wait_connected()
        server.on_command("Name")(lambda command: command.text[::-1])
        server.on_query("TRANSFORM")(lambda query: np.eye(4) if query.device == "Tool" else None)
        assert peer.command("Name", "abc").text == "cba"
        assert peer.query("TRANSFORM", "Tool").matrix.tolist() == np.eye(4).tolist()
        with pytest.raises(Refused):
            peer.query("TRANSFORM", "Other")


def test_a_configuration_file(tmp_path: Path) -> None:
    config = tmp_path / "bridge.toml"
    config.write_text('[igtl]\nlisten = ["127.0.0.1:0"]\n[gateway]\ndeny_in = ["TRANSFORM"]\n', "utf-8")
    with Bridge(config=config, ros=False, deny_in=["IMAGE"]) as bridge:
        assert bridge.addresses[0][1] != 18944
        assert set(bridge._bridge.gateway.config.deny_in) == {"TRANSFORM", "IMAGE"}
        with pytest.raises(NoReply, match="expected 1"):
            bridge.wait_peers(timeout_s=0.01)


def test_rows_of_messages() -> None:
    rows = ["/camera/image=Camera", {"topic": "/pose", "device": "Tool", "max_age_s": 0.5}]
    bridge = Bridge(listen=LOCAL, ros="zenoh:tcp/localhost:1", to_igtl=rows)  # without ROS it would have no effect
    assert [row.device for row in bridge._bridge.gateway.config.to_igtl] == ["Camera", "Tool"]
    bridge.stop()


@table(
    ("settings", "text"),
    [
        ({"listn": LOCAL}, r"^listn: unknown setting, expected one of .*listen"),
        ({"metrics": "9464"}, r"^metrics: unknown setting"),
        ({"listen": "127.0.0.1:0"}, r"^listen: found '127.0.0.1:0', expected strings such as"),
        ({"queue_mib": 0}, r"^queue_mib: found 0, expected 1 to"),
        ({"max_age_s": "1"}, r"^max_age_s: found '1', expected a number"),
        ({"to_igtl": "/camera"}, r"^to_igtl: found '/camera', expected a list"),
        ({"ros": True, "to_igtl": [{"topik": "/camera"}]}, r"to_igtl\[0\]\.topik: unknown setting"),
        ({"to_igtl": ["/camera"]}, r"^to_igtl: found ros=False or relay, expected neither"),
        ({"custom_data": ["a=b"]}, r"^custom_data: found no record FILE, expected it"),
        ({"record": "a.mcap", "snapshot": 5.0, "split_size": 3}, r"^snapshot: found split_size or split_duration"),
        ({"video_codec": "h264"}, r"^video_codec: found ros=False or relay, expected neither"),
        ({"tls_key": "key.pem"}, r"^tls_key: found no tls_cert FILE, expected it"),
        ({"tls_ca": "ca.pem"}, r"^tls_ca, tls_cert: found no address with TLS, expected tls or tls://HOST:PORT$"),
        ({"to_igtl": 5}, r"^to_igtl: found 5, expected a list"),
        ({"ros_args": ["-r", "__ns:=/a"]}, r"^ros_args: found ros=False, expected ROS"),
        ({"ros_args": "-r __ns:=/a"}, r"^ros_args: found '-r __ns:=/a', expected a list of strings"),
        ({"relay": True}, r"^relay: found 0 servers, expected one: connect HOST:PORT$"),
    ],
)
def test_settings(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        Bridge(**({"ros": False} | settings))


def test_a_port_in_use(tmp_path: Path) -> None:
    with Bridge(listen=LOCAL, ros=False) as bridge:
        out = tmp_path / "out.mcap"
        with (
            pytest.raises(Unavailable, match="port is in use"),
            Bridge(listen=[f"127.0.0.1:{bridge.addresses[0][1]}"], ros=False, record=out),
        ):
            pass
        assert not out.exists()
        with pytest.raises(RecordingError, match="found none"):
            bridge.pause_recording()
    bridge.stop()
