"""``igtl-gateway view``: files, facts, errors."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.tables import table

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

import mcap.writer
import numpy as np

from igtl_gateway.addons.view import shots
from igtl_gateway.cli import main
from igtl_gateway.convert import rosmsg
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from tests.places import FIXTURES

START_NS = 1_767_225_600_000_000_000
ROS_STRING = rosmsg.String.TYPE


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def counts(path: Path) -> dict[str, int]:
    """Rows of each entity of a recording of rerun."""
    from rerun.chunk import RrdReader

    rows: dict[str, int] = {}
    for chunk in RrdReader(str(path)).store().stream():
        if not chunk.is_static:
            rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return rows


@pytest.mark.slow
def test_a_suturing_session_is_saved_with_its_review(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "star.rrd"
    assert main(["view", str(FIXTURES / "star.mcap"), "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    rows = counts(out)
    assert told["blueprint"] == "star"
    assert told["reviewed"]
    assert rows["/review/stitches"] == rows["/review/table"] > 0
    assert all(rows[topic["topic"]] == topic["messages"] for topic in told["topics"])
    named = [(topic["topic"], topic["type"]) for topic in told["topics"]]
    assert named == sorted(named)
    assert {topic["picture"] for topic in told["topics"]} >= {"cloud", "pose", "image", "lines", "text"}
    assert [*tmp_path.iterdir()] == [out]


def test_two_recordings_of_one_name_stay_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple[str, dict[str, int]]] = []

    def show(_options: object, sessions: list[Path], _wait: object) -> None:
        from rerun.chunk import RrdReader

        shown.extend((RrdReader(str(path)).recordings()[0].recording_id, counts(path)) for path in sessions)

    monkeypatch.setattr("igtl_gateway.addons.view.verb_run._show", show)
    file = str(FIXTURES / "paper-types.mcap")
    assert main(["view", file, file, "--web", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["file"] == told["other"]["file"] == file
    assert told["messages"] == told["other"]["messages"] > 0
    (one, rows), (other, other_rows) = shown
    assert one != other
    assert rows == other_rows


def test_what_is_drawn_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.rrd"
    arguments = ["view", str(FIXTURES / "paper-types.mcap"), "-o", str(out), "--blueprint", "generic"]
    assert main(arguments) == 0
    told = capsys.readouterr().out
    assert "/igtl/in/Surface/mesh" in told
    assert "shape_msgs/msg/Mesh" in told
    assert "blueprint generic" in told


def test_a_recording_that_became_no_ros_messages_is_drawn_by_what_they_would_be(tmp_path: Path) -> None:
    path, out = tmp_path / "imported.mcap", tmp_path / "out.rrd"
    writer = SessionWriter(path, {})
    for number in (1, 2, 3):
        data = b"".join(bytes(part) for part in encode(Message("STRING", "Greeting", String.of(f"hello {number}"))))
        stamp_ns = START_NS + number * 1000
        writer.write(Entry(number, stamp_ns, Kind.IGTL_IN, "STRING/Greeting", "STRING", (data,), (1,)))
    writer.close({})
    assert main(["view", str(path), "-o", str(out)]) == 0
    assert counts(out)["/igtl/in/Greeting/string"] == 3


@table(
    ("arguments", "code", "sentence"),
    [
        (["--at", "3"], 2, "--at: found no -o OUT.png, expected it"),
        (["-o", "{folder}/x.png", "--at", "nan"], 2, "--at: found 'nan', expected seconds from the beginning"),
        (["-o", "{folder}/x.png", "--at", "-1"], 2, "--at: found '-1', expected seconds from the beginning"),
        (["-o", "{folder}/x.png", "--at", "9999"], 2, "--at: found 9999, expected at most "),
        (["-o", "{folder}/x.png", "--at", "mark:slip"], 2, "--at: found mark:slip, expected a recording with marks"),
        (["-o", "{folder}/none/x.png"], 1, "none/x.png: there is no folder {folder}/none"),
        (["{folder}/taken", "-o", "{folder}/x.rrd"], 2, "-o: found two recordings, "),
        (["--port", "80"], 2, "--port: found no --web, expected it"),
        (["--web", "--port", "70000"], 2, "--port: found 70000, expected 0 to 65535"),
        (["-o", "{folder}/x.rrd", "--blueprint", "stars"], 2, "--blueprint: found 'stars', expected one of star, "),
        (["-o", "{folder}/taken"], 2, "taken: exists already, expected a new file or --overwrite"),
        (["-o", "{folder}/none/x.rrd"], 1, "cannot write to {folder}/none/x.rrd: there is no folder {folder}/none"),
        ([], 1, "found no screen (neither DISPLAY nor WAYLAND_DISPLAY is set)"),
    ],
)
def test_errors_are_one_sentence(
    arguments: list[str], code: int, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").touch()
    given = [each.format(folder=tmp_path) for each in arguments]
    assert main(["view", str(FIXTURES / "paper-types.mcap"), *given]) == code
    said = capsys.readouterr().err
    assert sentence.format(folder=tmp_path) in said
    assert said.count("\n") == 1
    assert [each.name for each in tmp_path.iterdir()] == ["taken"]


def test_an_existing_file_is_replaced_where_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    out.write_bytes(b"old")
    assert main(["view", str(FIXTURES / "paper-types.mcap"), "-o", str(out), "--overwrite"]) == 0
    assert counts(out)["/tf"] == 2


def test_a_recording_of_nothing_has_no_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "empty.mcap", tmp_path / "out.png"
    SessionWriter(path, {}).close({})
    assert main(["view", str(path), "-o", str(out)]) == 1
    assert "empty.mcap: found no messages" in capsys.readouterr().err
    assert not out.exists()


def test_a_file_of_others_is_drawn_whatever_its_names_and_times_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    topics = ["/a\x1b[2J", "", "/", "//b", "/a/../b", "/\n- c", "/\u202etxt.\U0001f600", "/session/log", "/a b", "/a_b"]
    stamps = [0, START_NS, 1 << 62, (1 << 62) + 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1, START_NS + 1, START_NS - 1, 1]
    path, out = tmp_path / "odd\udcff\x1b.mcap", tmp_path / "out\udcff.rrd"
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(ROS_STRING, "ros2msg", b"string data\n# \xff\xfe")
        for topic, stamp in zip(topics, stamps, strict=True):
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, stamp, rosmsg.String(f"on {topic!r}").pack(), stamps[-1 - stamps.index(stamp)])
        writer.finish()  # type: ignore[no-untyped-call]
    assert main(["view", str(path), "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["messages"] == len(topics)
    assert told["without_time"] == {"gateway_time": 5, "sender_time": 4}
    rows = counts(out.rename(tmp_path / "out.rrd"))
    assert sum(rows[entity] for entity in rows if entity.count("/") and not entity.startswith("/session/")) >= 10
    assert main(["view", str(path), "-o", str(out), "--overwrite"]) == 0
    said = capsys.readouterr().out
    assert "? 5 entries not on the time line gateway_time: stamps before 1970 or after 2116" in said
    assert "\x1b" not in said


def test_what_comes_before_damage_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.rrd"
    writer = SessionWriter(path, {})
    for number in range(1, 40):
        data = rosmsg.String(f"{number} {hashlib.sha512(bytes([number])).hexdigest()}").pack()
        writer.write(Entry(number, START_NS + number, Kind.ROS_IN, "/text", ROS_STRING, (data,)))
        writer.flush()
    writer.close({})
    whole = bytearray(path.read_bytes())
    whole[whole.index(hashlib.sha512(bytes([30])).hexdigest()[:16].encode())] ^= 1
    path.write_bytes(whole)
    assert main(["view", str(path), "-o", str(out)]) == 1
    said = capsys.readouterr()
    assert "igtl-gateway view: only the messages before the damage are drawn: " in said.err
    assert 20 <= counts(out)["/text"] < 39


def test_a_field_that_no_cloud_has_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["view", str(FIXTURES / "ultrasound.mcap"), "--overwrite", "-o", str(tmp_path / "out.rrd")]
    assert main([*arguments, "--colour-by", "noise"]) == 0
    told = capsys.readouterr().out
    assert "? --colour-by: found no cloud with a field 'noise', expected one of " in told
    assert main([*arguments, "--colour-by", "z"]) == 0
    assert "--colour-by" not in capsys.readouterr().out


def test_a_live_view_needs_a_screen(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bridge", "--no-ros", "--view", "--listen", "127.0.0.1:0"]) == 1
    assert "found no screen" in capsys.readouterr().err


def irregular(path: Path, late_s: float) -> Path:
    """Two tools with the same irregular movement, one of them late; stamps 5 ms before gateway time."""
    chance = np.random.default_rng(0)
    waves = chance.uniform((0.01, 0.5, 0), (0.03, 6, 6), (8, 3))
    messages = []
    for topic, period, late in (("/a", 0.025, 0.0), ("/b", 0.04, late_s)):
        for time in np.arange(0, 20, period):
            place = float(np.sum(waves[:, 0] * np.sin(waves[:, 1] * (time - late) + waves[:, 2])))
            stamp_ns = START_NS + round(time * 1e9)
            header = rosmsg.Header(stamp_ns, "base")
            messages.append((stamp_ns, topic, rosmsg.TransformStamped(header, topic[1:], (place, 0, 0), (0, 0, 0, 1))))
    writer = SessionWriter(path, {})
    for number, (stamp_ns, topic, message) in enumerate(sorted(messages, key=lambda each: each[:2]), 1):
        entry = (
            number,
            stamp_ns + 5_000_000 + number,
            Kind.ROS_IN,
            topic,
            message.TYPE,
            (message.pack(),),
            (),
            stamp_ns,
        )
        writer.write(Entry(*entry))
    writer.close({})
    return path


def test_the_lag_of_a_stream_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = irregular(tmp_path / "lag.mcap", 0.05), tmp_path / "out.rrd"
    assert main(["view", str(path), "-o", str(out), "--sync", "/a", "/b", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["lag"]
    assert told["lag_s"] == pytest.approx(0.05, abs=0.002)
    assert main(["sync", str(path), "/a", "/b", "--json"]) == 0
    (expected,) = json.loads(capsys.readouterr().out)["lags"]
    assert told.items() >= expected.items()
    rows = counts(out)
    assert {path: number for path, number in rows.items() if path.startswith("/lag/")} == {
        "/lag/curves/fixed": 799,
        "/lag/curves/moving": 500,
        "/lag/curves/corrected": 500,
    }
    assert main(["view", str(path), "-o", str(out), "--overwrite", "--sync", "/a", "/c"]) == 2
    assert "found no stream '/c', expected a recorded stream" in capsys.readouterr().err
    assert main(["view", str(path), "-o", str(out), "--overwrite", "--sync", "/a", "/b"]) == 0
    assert "/b behind /a: +5" in capsys.readouterr().out


def test_a_robot_of_the_user(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = tmp_path / "a=b.urdf"
    urdf.write_text('<robot name="arm"><link name="base"/></robot>')
    path, out = irregular(tmp_path / "in.mcap", 0.0), tmp_path / "out.rrd"
    for word in (str(urdf), f"/PSM1={urdf}"):
        assert main(["view", str(path), "-o", str(out), "--overwrite", "--urdf", word]) == 0
        assert "a=b.urdf" in capsys.readouterr().out
    for word, found in (("none.urdf", "none.urdf: No such file"), (str(path), "invalid XML"), ("", "found")):
        assert main(["view", str(path), "-o", str(out), "--overwrite", "--urdf", word]) in (1, 2)
        assert found in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        (["nope.mcap"], 2, "nope.mcap: No such file"),
        (["nope.mcap", "-o", "x.png"], 2, "nope.mcap: No such file"),
        (
            ["FILE", "-o", "star.jpg"],
            2,
            "found 'star.jpg', the name of a picture, expected a recording of rerun: *.rrd",
        ),
        (["FILE", "--overwrite"], 2, "--overwrite: found no -o OUT"),
    ],
)
def test_names_of_other_formats_and_missing_files(
    words: list[str], code: int, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(FIXTURES / "star.mcap") if word == "FILE" else word for word in words]
    try:
        assert main(["view", *given]) == code
    except SystemExit as end:  # argparse
        assert end.code == code
    assert reason in capsys.readouterr().err


def test_a_screenshot_without_a_driver_is_refused_before_the_drawing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "no.json"))
    monkeypatch.setattr("igtl_gateway.addons.view.stream.to_file", None)  # nothing is drawn
    assert main(["view", str(FIXTURES / "star.mcap"), "-o", str(tmp_path / "x.png")]) == 1
    assert "found no usable Vulkan driver" in capsys.readouterr().err


def test_a_picture_is_there_although_nobody_reads_what_was_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``view … -o x.png | head -1``: the reader leaves before the list ends."""

    def left(*_words: str, **_settings: object) -> None:
        raise BrokenPipeError

    out = tmp_path / "x.png"
    monkeypatch.setattr(shots, "check_driver", lambda _environment: None)
    monkeypatch.setattr(shots, "take_shots", lambda _session, _times: [shots.Shot(0, b"png", ())])
    monkeypatch.setattr("igtl_gateway.addons.view.verb_run.print_line", left)
    assert main(["view", str(irregular(tmp_path / "in.mcap", 0.0)), "-o", str(out)]) == 1
    assert out.read_bytes() == b"png"


def test_messages_that_are_not_drawn_do_not_count_as_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A recording of which nothing can be drawn is exit code 1."""
    for name, messages, drawn, code in (
        ("a", [b"\x28\xb5\x2f\xfd...."] * 2, "0 of 2 messages drawn", 1),
        ("b", [b"\0\1\0\0" + bytes(8), b"\0\1"], "1 of 2 messages drawn", 0),
        ("c", [b"\0\1\0\0" + bytes(8)] * 2, "2 messages drawn", 0),
    ):
        with (tmp_path / f"{name}.mcap").open("wb") as stream:
            writer = mcap.writer.Writer(stream)
            writer.start("ros2")
            schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
            channel = writer.register_channel("/a", "cdr", schema)
            for number, data in enumerate(messages, 1):
                writer.add_message(channel, number, data, number)
            writer.finish()  # type: ignore[no-untyped-call]
        assert main(["view", str(tmp_path / f"{name}.mcap"), "-o", str(tmp_path / f"{name}.rrd")]) == code
        assert drawn in capsys.readouterr().out


def test_a_file_is_written_without_pandas_and_viewer(tmp_path: Path) -> None:
    """They would take half a second; Arrow imports pandas where it is installed."""
    words = [sys.executable, "-X", "importtime", "-m", "igtl_gateway", "view", str(FIXTURES / "crtk.mcap")]
    done = subprocess.run([*words, "-o", str(tmp_path / "a.rrd")], capture_output=True, text=True, check=True)
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "rerun" in imported and find_spec("pandas")
    assert not imported & {"pandas.core", "igtl_gateway.addons.view.viewer", "igtl_gateway.addons.view.shots"}
