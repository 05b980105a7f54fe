"""Videos with tables of kinematics: PyAV and pandas read the files, and each value, stamp and pixel is compared."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pandas
import pytest

import igtl_gateway
from igtl_gateway.addons.lerobot.video import VideoFile
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.cli import FAILURE, main
from tests.addons.lerobot.sessions import bars
from tests.places import ROOT
from tests.tables import table

Array = npt.NDArray[Any]
EPOCH_NS = 946_684_800 * NS_PER_S
BEGIN_NS = 1_700_000_000 * NS_PER_S + 123_456_789
ROWS, FPS = 8, 30

#: As tables of a dVRK: UTC stamps in ns, a row for each frame, quaternions and joints.
DVRK = re.sub(r"(?m)^#.*\n| *#.*$", "", (ROOT / "examples" / "kinematics.toml").read_text("utf-8"))
#: As tables of JIGSAWS: 76 columns between blanks, without header and time, rotations row by row.
JIGSAWS = """\
[[video]]
file = "left.mp4"
name = "/camera/left"
start = 0.05
[[table]]
file = "Suturing_B001.txt"
rate = 30
separator = "space"
header = false
[[table.pose]]
name = "/PSM1/measured_cp"
position = [39, 40, 41]
unit = "m"
rotation = [42, 43, 44, 45, 46, 47, 48, 49, 50]
[[table.joints]]
name = "/PSM1/jaw"
names = ["jaw"]
position = [57]
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a video of 8 frames, and both tables."""
    folder = tmp_path_factory.mktemp("kinematics")
    video = VideoFile(folder / "left.mp4", (32, 32), FPS, "h264")
    for number in range(ROWS):
        video.add(np.repeat(bars(number, 32, 32)[:, :, np.newaxis], 3, axis=2))
    video.close()
    random = np.random.default_rng(3)
    turns = [rotation(0.1 * number) for number in range(ROWS)]
    lines = ["stamp,psm1.x,psm1.y,psm1.z,psm1.qw,psm1.qx,psm1.qy,psm1.qz,yaw,pitch,yaw',pitch'"]
    for number in range(ROWS):
        half = 0.05 * number
        pose = [*random.normal(size=3) * 100, np.cos(half), 0.0, 0.0, np.sin(half)]
        numbers = [BEGIN_NS + number * 33_333_333 + number % 3, *pose, *random.normal(size=4)]
        lines.append(",".join(map(repr, [int(numbers[0]), *map(float, numbers[1:])])))
    (folder / "kinematics.csv").write_text("\n".join(lines) + "\n", "utf-8")
    wide = random.normal(size=(ROWS, 76))
    wide[:, 41:50] = np.array(turns).reshape(ROWS, 9)
    text = "\n".join("  " + "   ".join(f"{value:.9f}" for value in row) for row in wide)
    (folder / "Suturing_B001.txt").write_text(text + "\n", "utf-8")
    return folder


def rotation(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def recipe(folder: Path, text: str) -> Path:
    path = folder / "recipe.toml"
    path.write_text(text, "utf-8")
    return path


def imported(folder: Path, text: str, place: Path) -> Path:
    assert main(["import", str(recipe(folder, text)), "-o", str(place)]) == 0
    return place


def pictures(path: Path) -> Array:
    with av.open(str(path)) as file:
        return np.array([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])


def decoded(stream: igtl_gateway.Stream) -> list[Array]:
    codec = av.CodecContext.create("h264", "r")
    packets = [av.Packet(bytes(message.content.data)) for message in stream.messages()]
    return [frame.to_ndarray(format="rgb24") for each in (*packets, None) for frame in codec.decode(each)]


def test_each_value_of_a_table_with_stamps(data: Path, tmp_path: Path) -> None:
    rows = pandas.read_csv(data / "kinematics.csv")
    stamps = rows["stamp"].tolist()
    with igtl_gateway.open(imported(data, DVRK, tmp_path / "s.mcap")) as recording:
        poses = recording["/PSM1/measured_cp"]
        assert poses.source_times.tolist() == stamps
        assert np.array_equal(poses.poses().positions, rows[["psm1.x", "psm1.y", "psm1.z"]].to_numpy() * 1e-3)
        for row, message in zip(rows.to_dict("records"), poses.messages(), strict=True):
            found = message.content.pose.orientation
            assert (found.x, found.y, found.z, found.w) == tuple(
                row[f"psm1.{name}"] for name in ("qx", "qy", "qz", "qw")
            )
            assert message.content.header.frame_id == "PSM1_base"
        for row, message in zip(rows.to_dict("records"), recording["/PSM1/measured_js"].messages(), strict=True):
            content = message.content
            assert content.name == ["yaw", "pitch"]
            assert content.position.tolist() == [row[name] * (np.pi / 180) for name in ("yaw", "pitch")]
            assert content.velocity.tolist() == [row[name] * (np.pi / 180) for name in ("yaw'", "pitch'")]
        view = recording["/camera/left"]
        assert view.source_times.tolist() == stamps
        assert np.array_equal(decoded(view), pictures(data / "left.mp4"))


def test_each_value_of_a_table_of_rows(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = np.loadtxt(data / "Suturing_B001.txt")
    with igtl_gateway.open(imported(data, JIGSAWS, tmp_path / "s.mcap")) as recording:
        poses = recording["/PSM1/measured_cp"]
        stamps = [EPOCH_NS + round(number * NS_PER_S / 30) for number in range(ROWS)]
        assert poses.source_times.tolist() == stamps
        found = poses.poses()
        assert np.array_equal(found.positions, rows[:, 38:41])
        assert np.allclose(found.matrices[:, :3, :3], rows[:, 41:50].reshape(-1, 3, 3), atol=1e-8)
        jaws = [message.content.position.tolist() for message in recording["/PSM1/jaw"].messages()]
        assert jaws == rows[:, 56:57].tolist()
        view = recording["/camera/left"]
        assert np.abs(view.source_times - np.array(stamps) - 50_000_000).max() <= 1
        assert np.array_equal(decoded(view), pictures(data / "left.mp4"))
    assert "the begin is 2000-01-01T00:00:00.000Z: the tables have no date" in capsys.readouterr().out


def test_frames_that_need_later_ones_are_decoded(data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "b"
    folder.mkdir()
    with av.open(str(folder / "left.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=FPS, options={"bf": "2", "x264-params": "b-adapt=0:keyint=8"})
        stream.width = stream.height = 32
        for number in range(ROWS):
            picture = np.repeat(bars(number, 32, 32)[:, :, np.newaxis], 3, axis=2)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode(None))
    text = '[[video]]\nfile = "left.mp4"\nname = "/camera"\n'
    with igtl_gateway.open(imported(folder, text, tmp_path / "s.mcap")) as recording:
        found = recording["/camera"]
        assert found.type == "sensor_msgs/msg/Image"
        assert np.array_equal([each.array[0] for each in found.images()], pictures(folder / "left.mp4"))
        steps = np.diff(found.source_times)
        assert np.abs(steps - NS_PER_S / FPS).max() <= 1


def test_sync_measures_how_late_a_video_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A wall becomes darker and brighter as the tool moves, and the video begins 0.12 s late."""
    video, rows = VideoFile(tmp_path / "v.mp4", (32, 32), 12, "h264"), ["x,y,z,a,b,c,d"]
    for number in range(200):
        at = number / 12
        height = np.sin(2.1 * at) + 0.7 * np.sin(3.7 * at + 1) + 0.4 * np.sin(0.21 * at * at)
        picture = 128 + 50 * height * np.linspace(0, 1, 32)
        video.add(
            np.ascontiguousarray(np.broadcast_to(picture[:, np.newaxis, np.newaxis], (32, 32, 3)).astype(np.uint8))
        )
        rows.append(f"{height / 50},0,0,0,0,0,1")
    video.close()
    (tmp_path / "t.csv").write_text("\n".join(rows), "utf-8")
    text = """\
[[video]]
file = "v.mp4"
name = "/camera"
start = 0.12
[[table]]
file = "t.csv"
rate = 12
[[table.pose]]
name = "/tool"
position = ["x", "y", "z"]
unit = "m"
quaternion = ["a", "b", "c", "d"]
"""
    session = imported(tmp_path, text, tmp_path / "s.mcap")
    capsys.readouterr()
    assert main(["sync", str(session), "/tool", "/camera", "--json"]) == 0
    [lag] = json.loads(capsys.readouterr().out)["lags"]
    assert (lag["verdict"], lag["samples"] > 150) == ("measured", True)
    assert lag["lag_s"] == pytest.approx(0.12, abs=0.01)
    assert main(["sync", str(session)]) == FAILURE  # without names, encoded pictures are not decoded
    assert "found 1 stream in which something could move" in capsys.readouterr().err


def test_rows_without_a_value_are_counted(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (data / "kinematics.csv").read_text("utf-8").splitlines()
    cells = [line.split(",") for line in lines]
    cells[2][1], cells[3][4], cells[4][8] = "nan", "5.0", ""
    (tmp_path / "kinematics.csv").write_text("\n".join(map(",".join, cells)), "utf-8")
    path = recipe(tmp_path, DVRK[DVRK.index("[[table]]") :])
    assert main(["import", str(path), "-o", str(tmp_path / "s.mcap"), "--json"]) == 0
    told = {row["stream"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    poses, joints = told["/PSM1/measured_cp"], told["/PSM1/measured_js"]
    assert (poses["declared"], poses["imported"], poses["left_out"]) == (8, 6, 2)
    assert (joints["declared"], joints["imported"], joints["left_out"]) == (8, 7, 1)


def changed(old: str, new: str) -> str:
    assert old in DVRK
    return DVRK.replace(old, new, 1)


TABLE = DVRK[DVRK.index("[[table]]") :]
BAD = [
    (changed('name = "/camera/left"', 'names = "x"'), "video[0].names: unknown key, expected one of file, name"),
    (changed('"left.mp4"', '"../left.mp4"'), "video[0].file: found '../left.mp4', expected a file in or below"),
    (changed('"left.mp4"', '"/left.mp4"'), "video[0].file: found '/left.mp4', expected a file in or below"),
    (changed('"left.mp4"', '"left.avi"'), "video[0].file: found 'left.avi', expected a file in or below"),
    (changed('"left.mp4"', '"right.mp4"'), "video[0].file: found 'right.mp4', expected a file that is there"),
    (changed('"/camera/left"', '"camera left"'), "video[0].name: found 'camera left', expected a topic such as"),
    (changed('time = "stamp"\n', ""), "video[0]: expected times and time together, without start"),
    (changed('[[table]]', '[[tables]]'), "tables: unknown table, expected one of video, table; did you mean 'table'?"),
    (changed('file = "kinematics.csv"', 'file = "kinematics.mat"'), "of the recipe, .csv, .txt, .tsv, .h5, .hdf5"),
    (changed('zero = "utc"', 'zero = "epoch"'), "table[0].zero: found 'epoch', expected one of begin, utc"),
    (changed('zero = "utc"', "rate = 30"), "table[0]: found both, expected time or rate"),
    (changed('unit = "mm"\n', ""), "table[0].pose[0]: found no unit, expected one of m, cm, mm, um"),
    (changed('"psm1.x", ', ""), "table[0].pose[0].position: found ['psm1.y', 'psm1.z'], expected 3 columns"),
    (changed('order = "wxyz"', 'order = "zyx"'), "table[0].pose[0].order: found 'zyx', expected one of xyzw, wxyz"),
    (changed('"psm1.x"', '"psm1.X"'), "position: kinematics.csv: found no column 'psm1.X', expected one of stamp"),
    (changed('"psm1.x"', "13"), "table[0].pose[0].position: kinematics.csv: found column 13, expected 1 to 12"),
    (changed('["yaw\'", "pitch\'"]', '["yaw\'"]'), "table[0].joints[0].velocity: found 1 value, expected 2"),
    (changed('"/PSM1/measured_js"', '"/PSM1/measured_cp"'), "found /PSM1/measured_cp as in table[0].pose[0], expected"),
    (changed('zero = "utc"\n', "").replace('"ns"\n\n[[table.', '"s"\n\n[[table.'), "expected a time in s before 2038"),
    ("", "found no stream, expected [[video]], [[table.pose]] or [[table.joints]]"),
    ("[[video", "recipe.toml: "),
    (TABLE.replace('["yaw", "pitch"]', '["yaw", "word"]'), "joints[0].position: kinematics.csv: word: found string"),
    (TABLE.replace('["yaw", "pitch"]', '["yaw", "yaw"]'), "position: found ['yaw', 'yaw'], expected different columns"),
    (TABLE.replace('time = "stamp"', 'time = "back"'), "row 3: back: found 1, expected more than 2 of the row before"),
    (TABLE.replace('time = "stamp"', 'time = "hole"'), "row 2: hole: found nan, expected a time in ns before 2038"),
    (JIGSAWS.replace("[42, 43, 44, 45, 46, 47, 48, 49, 50]", "[1, 2, 3, 4, 5, 6, 7, 8, 9]"), "of length 1"),
    (JIGSAWS.replace("header = false\n", ""), "expected names of columns, or header = false"),
    (TABLE.replace('"stamp"', '"late"').replace("word", "late"), "row 2: late: found nan, expected a time in ns"),
    (TABLE.replace('["yaw", "pitch"]', '["yaw", "none"]'), "joints[0]: wide.csv: found only rows with a number"),
    (DVRK.replace('times = "kinematics.csv"', 'times = "short.csv"'), "left.mp4: found more frames, expected 2 as "),
    (DVRK.replace('times = "kinematics.csv"', 'times = "long.csv"'), "left.mp4: found 8 frames, expected 16 as "),
    (TABLE.replace('"kinematics.csv"', '"uneven.csv"'), "uneven.csv: is not a valid table: "),
    (TABLE.replace('"kinematics.csv"', '"empty.csv"'), "empty.csv: is not a valid table: "),
    (TABLE.replace('"kinematics.csv"', '"latin.csv"'), "latin.csv: is not a valid table: "),
    (TABLE.replace('"kinematics.csv"', '"outside.csv"'), "found 'outside.csv', expected a file in or below the folder"),
]  # fmt: skip


@pytest.fixture(scope="module")
def bad(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder, with tables that are wrong."""
    lines = (data / "kinematics.csv").read_text("utf-8").splitlines()
    late = str(BEGIN_NS)
    more = [["word", "back", "hole", "late", "none"], ["a", "1", "1", late, ""], ["b", "2", "nan", "nan", ""]]
    more += [["c", "1", "3", late, ""], *[["d", "4", "4", late, ""]] * 5]
    (data / "short.csv").write_text("\n".join(lines[:3]), "utf-8")
    twice = [f"{int(line.partition(',')[0]) + NS_PER_S},{line.partition(',')[2]}" for line in lines[1:]]
    (data / "long.csv").write_text("\n".join([*lines, *twice]), "utf-8")
    (data / "uneven.csv").write_text("\n".join([*lines, "1,2"]), "utf-8")
    (data / "empty.csv").write_text("", "utf-8")
    (data / "latin.csv").write_bytes(b"t\xe4gliche," + "\n".join(lines).encode())
    outside = tmp_path_factory.mktemp("outside") / "kinematics.csv"
    outside.write_text("\n".join(lines), "utf-8")
    (data / "outside.csv").symlink_to(outside)
    wide = [",".join([line, *cells]) for line, cells in zip(lines, more, strict=True)]
    (data / "wide.csv").write_text("\n".join(wide), "utf-8")
    return data


@table(("text", "expected"), BAD, gate=lambda text, expected: expected in {each[1] for each in BAD[::3]})
def test_a_wrong_recipe_or_table_is_one_line(
    text: str, expected: str, bad: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if any(name in text for name in ('"word"', '"back"', '"hole"', '"late"', '"none"')):
        text = text.replace("kinematics.csv", "wide.csv")
        expected = expected.replace("kinematics.csv", "wide.csv")
    path = recipe(bad, text)
    assert main(["import", str(path), "-o", str(tmp_path / "s.mcap")]) != 0
    out, err = capsys.readouterr()
    told = [each for each in (out + err).splitlines() if expected in each]
    assert len(told) == 1 and len(told[0]) < 500, out + err
    assert not (tmp_path / "s.mcap").exists()
