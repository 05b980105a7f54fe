"""``igtl-gateway sync`` on recordings with a planted lag, and on PLUS's own sequences."""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import igtl_gateway
from igtl_gateway.addons.cohort.jobs import VERBS
from igtl_gateway.addons.sync.signal import Signal
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, DamagedRecording
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway import Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.transform import Transform
from tests.addons.sync.trajectories import trajectory
from tests.addons.sync.worlds import stamps
from tests.places import FIXTURES
from tests.plus_sequences import water_tank_tracker, water_tank_video

SECONDS, RATE = 20, 25
#: Lateness of the stamps of each stream, ms.
LATE_MS = {"TRANSFORM/Probe": 0, "IMAGE/Video": 80, "SENSOR/Force": -40, "/joint_states": 130}


def placed(x: float, y: float, z: float) -> npt.NDArray[np.float64]:
    """Return a matrix (4, 4) with this translation, in mm."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def height(at: float) -> float:
    """The movement of all streams: it does not repeat itself."""
    return math.sin(2.1 * at) + 0.7 * math.sin(3.7 * at + 1) + 0.4 * math.sin(0.21 * at * at)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session in which a probe, a video, a force and a joint show the same movement, and a bed that does not move."""
    path = tmp_path_factory.mktemp("sync") / "session.mcap"
    config = Config()
    session = Session(Gateway(config))
    begin_ns = SystemClock().utc_ns()
    with_config = {"config": json.dumps(config.to_dict()), "igtl_gateway_version": igtl_gateway.__version__}
    writer = SessionWriter(path, with_config)
    rows = np.arange(64)[:, np.newaxis] * np.ones(48)
    for number in range(SECONDS * RATE):
        at = number / RATE
        value = height(at)
        picture = (200 * np.exp(-(((rows - 32 - 9 * value) / 4) ** 2))).astype("u1")
        contents: dict[str, Body] = {
            "TRANSFORM/Probe": Transform.from_rows(placed(3 * value, 1.0, 20 * value).tolist()),
            "TRANSFORM/Bed": Transform.from_rows(placed(0, 0, 0).tolist()),
            "IMAGE/Video": Image((48, 64, 1), 3, picture.tobytes()),
            "SENSOR/Force": Sensor(np.array([1.0, 5 * value])),
        }
        now_ns = begin_ns + round(at * NS_PER_S)
        for stream, content in contents.items():
            kind, _, device = stream.partition("/")
            ticks = ns_to_ticks(now_ns + LATE_MS.get(stream, 0) * NS_PER_MS)
            frame = join(encode(Message(kind, device, content, ticks=ticks)))
            for entry in session.input(now_ns, Kind.IGTL_IN, (frame,), links=(1,)):
                writer.write(entry)
        stamp_ns = now_ns + LATE_MS["/joint_states"] * NS_PER_MS
        joints = JointState(Header(stamp_ns, ""), ("joint",), np.array([value]), np.array([]), np.array([])).pack()
        for entry in session.input(
            now_ns, Kind.ROS_IN, (joints,), channel="/joint_states", type_name=JointState.TYPE, source_ns=stamp_ns
        ):
            writer.write(entry)
    writer.close({"streams": session.gateway.ledger.to_dict()})
    return path


def lags(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, dict[str, Any]]:
    code = main(["sync", *map(str, words), "--json"])
    found = json.loads(capsys.readouterr().out)
    return code, {lag["stream"]: lag for lag in found["lags"]}


def test_planted_lags(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = lags(capsys, recording, *LATE_MS)
    assert code == 0
    for stream, late_ms in LATE_MS.items():
        if stream != "TRANSFORM/Probe":
            assert found[stream]["lag_s"] * 1e3 == pytest.approx(late_ms, abs=3), stream
            assert found[stream]["low_s"] * 1e3 - 1 <= late_ms <= found[stream]["high_s"] * 1e3 + 1


@pytest.mark.slow
def test_the_line_in_pictures(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, found = lags(capsys, recording, "TRANSFORM/Probe", "IMAGE/Video", "--line")
    assert found["IMAGE/Video"]["lag_s"] * 1e3 == pytest.approx(80, abs=2)


def test_all_streams_and_one_that_is_still(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = lags(capsys, recording)
    assert code == 1
    assert found["TRANSFORM/Bed"]["verdict"] == "still"
    assert main(["sync", str(recording), "TRANSFORM/Probe", "TRANSFORM/Bed", "SENSOR/Force"]) == 1
    text = capsys.readouterr().out
    assert "no movement" in text
    assert "-40." in text or "-39." in text


@pytest.mark.slow
def test_applied(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The corrected session verifies, and its lag is gone; bytes and gateway times are those of before."""
    out = tmp_path / "out.mcap"
    assert main(["sync", str(recording), "TRANSFORM/Probe", "IMAGE/Video", "--apply", "-o", str(out)]) == 0
    assert "are corrected; measured again, the lag is " in capsys.readouterr().out
    assert main(["verify", str(out)]) == 0
    capsys.readouterr()
    _, found = lags(capsys, out, "TRANSFORM/Probe", "IMAGE/Video")
    assert found["IMAGE/Video"]["lag_s"] == pytest.approx(0, abs=1e-3)
    with igtl_gateway.open(recording) as before, igtl_gateway.open(out) as after:
        for key in ("IMAGE/Video", "TRANSFORM/Probe"):
            one, other = before[key], after[key]
            assert np.array_equal(one.times, other.times) and np.array_equal(one.numbers, other.numbers)
            moved = np.unique(one.source_times - other.source_times) / NS_PER_MS
            assert np.abs(moved - (80 if key == "IMAGE/Video" else 0)).max() < 4, (key, moved)
            pairs = zip(one.messages(), other.messages(), strict=True)
            assert all(
                np.array_equal(getattr(a.content, "matrix", 0), getattr(b.content, "matrix", 0)) for a, b in pairs
            )
        assert [note.code for note in after.notes][-1] == "stamps_corrected"


def joints_session(path: Path, signals: dict[str, Signal]) -> Path:
    """Write signals as joints of an import."""
    writer = SessionWriter(path, {"imported_format": "a test", "igtl_gateway_version": igtl_gateway.__version__})
    rows = [
        (at, topic, row) for topic, each in signals.items() for at, row in zip(each.times_ns, each.values, strict=True)
    ]
    last_ns = 0
    for seq, (at, topic, row) in enumerate(sorted(rows, key=lambda each: (each[0], each[1])), 1):
        last_ns = max(at, last_ns + 1)
        joints = JointState(Header(0, ""), ("joint",), row, np.array([]), np.array([])).pack()
        writer.write(Entry(seq, last_ns, Kind.ROS_IN, topic, JointState.TYPE, (joints,), (), at - 1))
    writer.close({})
    return path


@pytest.mark.slow
def test_several_pairs_have_one_lag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A periodic jaw and an insertion: refused alone, measured and corrected together; in the API and cohorts, too."""
    case = trajectory(11, 1)
    names = ("/psm/jaw", "/video/jaw", "/psm/insertion", "/video/insertion")
    path = joints_session(tmp_path / "a.mcap", dict(zip(names, (*case.jaw, *case.insertion), strict=True)))
    words = [*names[:2], "--max-lag", "5", "--pair", *names[2:]]
    code, found = lags(capsys, path, *names[:2], "--max-lag", "5")
    assert (code, found["/video/jaw"]["verdict"]) == (1, "periodic")
    code, found = lags(capsys, path, *words)
    lag = found["/video/jaw"]
    assert code == 0
    assert abs(lag["lag_s"] - case.lag_s) < case.frame_s
    assert [pair["verdict"] for pair in lag["pairs"]] == ["periodic", "measured"]
    with igtl_gateway.open(path) as recording:
        streams = [recording[name] for name in names]
        again = igtl_gateway.lag(streams[::2], streams[1::2], max_lag_s=5)
        assert again.lag_s == lag["lag_s"]
        with pytest.raises(ConfigError, match="found 2 fixed and 1 moving stream"):
            igtl_gateway.lag(streams[::2], streams[1:2])
    with SessionFile.open(path) as file:
        settings = {"streams": names[:2], "pairs": [names[2:]], "max_lag_s": 5.0}
        (row,) = VERBS["sync"].work(file, settings)["lags"]
        assert row["lag_ms"] == lag["lag_s"] * 1e3
    assert main(["sync", str(path), *words, "--apply", "-o", str(tmp_path / "out.mcap")]) == 0
    text = capsys.readouterr().out
    assert (
        f"/psm/jaw and /video/jaw: R² {lag['pairs'][0]['r2']:.3f}, period {lag['pairs'][0]['period_s']:.2f} s" in text
    )
    assert "measured again, the lag is " in text


def test_the_reference_by_default_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A bed with the most samples is no reference, and neither is a clock that only counts."""
    random = np.random.default_rng(3)
    slow, fast = np.arange(0, 15, 1 / 20), np.arange(0, 15, 1 / 60)
    movement = np.array([height(at) for at in slow.tolist()])
    signals = {
        "/bed": Signal.of(stamps(fast), random.normal(0, 1e-3, len(fast))),
        "/count": Signal.of(stamps(fast), fast),
        "/probe": Signal.of(stamps(slow), movement),
        "/video": Signal.of(stamps(slow[::2] + 0.1), movement[::2]),
    }
    path = joints_session(tmp_path / "a.mcap", signals)
    assert main(["sync", str(path)]) == 1
    text = capsys.readouterr().out
    assert text.startswith("behind /probe:")
    _, found = lags(capsys, path)
    assert found["/video"]["lag_s"] == pytest.approx(0.1, abs=0.01)
    assert (found["/bed"]["verdict"], found["/count"]["verdict"]) == ("still", "one_way")


@pytest.mark.slow
def test_plot(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "lag.svg"
    words = ["sync", str(recording), "TRANSFORM/Probe", "SENSOR/Force", "TRANSFORM/Bed", "--plot", str(path)]
    assert main(words) == 1
    text = path.read_text()
    assert "SENSOR/Force behind TRANSFORM/Probe" in text
    assert "no movement" in text
    assert main(words) == 2  # the file exists


def test_the_library_of_charts_is_missing_before_the_search(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "matplotlib.figure", raising=False)
    monkeypatch.setattr("igtl_gateway.addons.sync.verb_run._signals", lambda *_: pytest.fail("a search"))
    assert main(["sync", str(recording), "--plot", str(tmp_path / "lag.svg")]) == 1
    assert 'pip install "igtl-gateway[plot]"' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["TRANSFORM/Prob", "IMAGE/Video"], "found no stream 'TRANSFORM/Prob', expected a recorded"),
        (["TRANSFORM/Probe"], "found 1 stream in which something could move, expected two"),
        (["--max-lag", "0"], "--max-lag: found 0, expected more than 0"),
        (
            ["TRANSFORM/Probe", "--pair", "IMAGE/Video", "SENSOR/Force"],
            "--pair: found 1 stream, expected two before it",
        ),
        (["--apply"], "--apply: found it or -o OUT alone, expected both"),
        (["TRANSFORM/Probe", "IMAGE/Video", "SENSOR/Force", "--apply", "-o", "x"], "found 3 streams, expected two"),
    ],
)
def test_errors(recording: Path, words: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sync", str(recording), *words]) in (1, 2)
    captured = capsys.readouterr()
    assert text in captured.err
    assert captured.out == ""


def _joints(at_ns: int, value: float) -> bytes:
    return JointState(Header(at_ns, ""), ("joint",), np.array([value]), np.array([]), np.array([])).pack()


def _with_unreadable(path: Path, good: int) -> None:
    """Write a recording with this number of good streams, one cut off in each message, and one without a definition."""
    writer = SessionWriter(path, {"imported_format": "a test"})
    for number in range(SECONDS * RATE):
        at_ns = NS_PER_S + number * NS_PER_S // RATE
        data = _joints(at_ns, height(number / RATE))
        streams = {f"/arm{each}": (JointState.TYPE, data) for each in range(good)}
        streams |= {"/cut": (JointState.TYPE, data[:-20]), "/unknown": ("lab_msgs/msg/Own", data)}
        for place, (topic, (ros_type, sent)) in enumerate(streams.items()):
            seq = 1 + number * len(streams) + place
            writer.write(Entry(seq, at_ns, Kind.ROS_IN, topic, ros_type, (sent,), (), at_ns))
    writer.close({})


def test_unreadable_streams_are_left_out_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The other lags are measured, in the verb and in a cohort; the exit code is that of a damaged recording."""
    path, chart = tmp_path / "session.mcap", tmp_path / "lag.svg"
    _with_unreadable(path, 2)
    assert main(["sync", str(path), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert [(each["stream"], each["verdict"]) for each in found["lags"]] == [("/arm1", "measured")]
    assert [each["stream"] for each in found["unreadable"]] == ["/cut", "/unknown"]
    assert all(each["reason"] for each in found["unreadable"])
    assert main(["sync", str(path), "--plot", str(chart)]) == 1
    shown = capsys.readouterr()
    assert "unreadable: /cut: " in shown.out
    assert shown.err == ""
    assert "unreadable: /cut, /unknown" in chart.read_text()
    with SessionFile.open(path) as file:
        rows = VERBS["sync"].work(file, {"streams": [], "pairs": [], "max_lag_s": None})["lags"]
    assert [(row["stream"], row["verdict"]) for row in rows] == [
        ("/arm1", "measured"), ("/cut", "unreadable"), ("/unknown", "unreadable"),
    ]  # fmt: skip
    out = tmp_path / "tables"
    assert main(["cohort", "sync", str(path), "-o", str(out)]) == 1
    shown = capsys.readouterr()
    assert "1 ok" in shown.out
    assert "1 with unreadable streams" in shown.out


def test_a_recording_that_was_cut_off_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The verb measures what is there: alone and of a folder it states that the end is missing."""
    path = tmp_path / "session.mcap"
    _with_unreadable(path, 2)
    size = path.stat().st_size - 100
    os.truncate(path, size)
    for source in (path, tmp_path):
        assert main(["sync", str(source)]) == 1
        assert " ".join(capsys.readouterr().err.split()).startswith(f"note: {path}: was cut off after {size:,} bytes; ")


def test_too_few_streams_because_others_are_unreadable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "session.mcap"
    _with_unreadable(path, 1)
    assert main(["sync", str(path)]) == 1
    text = " ".join(capsys.readouterr().err.split())
    assert "found 1 stream in which something could move, expected two; unreadable: /cut (" in text
    with SessionFile.open(path) as file, pytest.raises(DamagedRecording, match="unreadable: /cut"):
        VERBS["sync"].work(file, {"streams": [], "pairs": [], "max_lag_s": None})


def test_the_water_tank_of_plus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two sequences with the signals of those that PLUS publishes with their lag, -64.8 ms, imported."""
    for name, write in (("Video", water_tank_video), ("Tracker", water_tank_tracker)):
        source = write(tmp_path / f"{name}.igs.mha")
        assert main(["import", str(source), "-o", str(tmp_path / f"{name}.mcap")]) == 0
    capsys.readouterr()
    streams = ("IMAGE/Image", "TRANSFORM/ProbeToTracker")
    code, found = lags(capsys, tmp_path / "Video.mcap", *streams, "--with", tmp_path / "Tracker.mcap", "--line")
    lag = found["TRANSFORM/ProbeToTracker"]
    assert (code, lag["verdict"]) == (0, "varies")
    assert lag["lag_s"] == pytest.approx(-0.0648, abs=0.002)
    assert lag["low_s"] < -0.0648 < lag["high_s"]


def test_doctor_points_to_streams_that_are_late(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["doctor", str(recording), "--json"])
    findings = [each for each in json.loads(capsys.readouterr().out)["findings"] if each["id"] == "IGTL-W308"]
    assert len(findings) >= 2
    for finding in findings:
        planted = LATE_MS[finding["where"]] - LATE_MS[finding["data"]["behind"]]
        assert abs(planted) > 30 and abs(finding["data"]["lag_s"] * 1000 - planted) < 5, finding
    assert "igtl-gateway sync" in findings[0]["advice"]


@pytest.mark.parametrize("name", ["star", "lego"])
def test_doctor_reports_no_lag_where_there_is_none(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    main(["doctor", str(FIXTURES / f"{name}.mcap"), "--json"])
    assert "IGTL-W308" not in capsys.readouterr().out
