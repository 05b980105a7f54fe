"""``igtl-gateway export``: what others read of it, and what comes back by ``import``."""

from __future__ import annotations

import csv
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.cli import FAILURE, USAGE, main
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import BIG_ENDIAN, LPS, Image
from igtl_gateway.wire.polydata import RGBA, Attribute, Cells, PolyData
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.foreign_bags import cdr_sqlite3, turtles
from tests.plus_sequences import cropped

ROS2 = get_typestore(Stores.ROS2_JAZZY)
START = 1_700_000_000 * 10**9
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]], ">f4")
COLOURS = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0.5, 0.5, 0.5, 1]], ">f4")
SURFACE = PolyData(
    CORNERS, polygons=Cells.of([[0, 1, 2], [0, 2, 3]]), attributes=(Attribute.of(RGBA, "RGBA", COLOURS),)
)
VOLUME = Image(
    (4, 3, 2),
    5,
    bytes(range(48)),
    endian=BIG_ENDIAN,
    coordinate=LPS,
    wire_matrix=(0, 2.0, 0, -3.0, 0, 0, 0, 0, 4.0, 10, 20, 30),
)


def moved(x: float) -> Transform:
    return Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, x, 2.0, 3.0))


def ros(name: str, **fields: Any) -> bytes:
    return bytes(ROS2.serialize_cdr(ROS2.types[name](**fields), name))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A session by the gateway itself: both sides, inputs and outputs."""
    session, path = Session(Gateway(Config())), tmp_path / "session.mcap"
    writer = SessionWriter(path, {"config": "{}"})

    def peer(device: str, kind: str, content: Body, at: int) -> list[Entry]:
        data = join(encode(Message(kind, device, content, ns_to_ticks(START + at))))
        return session.input(START + at, Kind.IGTL_IN, (data,), links=(1,))

    def topic(name: str, kind: str, data: bytes, at: int) -> list[Entry]:
        return session.input(START + at, Kind.ROS_IN, (data,), channel=name, type_name=kind)

    vector = ROS2.types["geometry_msgs/msg/Vector3"]
    entries = [
        *peer("ProbeToTracker", "TRANSFORM", moved(1.5), 1_000),
        *peer("Said", "STRING", String.of('one, "two"\nthree'), 2_000),
        *peer("Surface", "POLYDATA", SURFACE, 3_000),
        *peer("Scan", "IMAGE", VOLUME, 4_000),
        *topic(
            "/speed",
            "geometry_msgs/msg/Twist",
            ros("geometry_msgs/msg/Twist", linear=vector(1.0, 2.0, 3.0), angular=vector(4.0, 5.0, 6.0)),
            5_000,
        ),
        *topic("/said", "std_msgs/msg/String", ros("std_msgs/msg/String", data="ähm"), 6_000),
        *peer("ProbeToTracker", "TRANSFORM", moved(2.5), 7_000),
    ]
    for entry in entries:
        writer.write(entry)
    writer.close({})
    return path


def exported(recording: Path, to: str, out: Path, *streams: str) -> dict[str, Any]:
    globs = [word for stream in streams for word in ("--streams", stream)]
    assert main(["export", str(recording), "--to", to, "-o", str(out), *globs]) == 0
    return {file.name: file for file in out.iterdir()} if out.is_dir() else {}


def entries(path: Path) -> list[Entry]:
    with SessionFile.open(path) as file:
        return list(file.entries())


def test_rosbag2_is_read_by_others_and_comes_back(recording: Path, tmp_path: Path) -> None:
    exported(recording, "rosbag2", tmp_path / "bag")
    recorded = [entry for entry in entries(recording) if entry.kind in (Kind.ROS_IN, Kind.ROS_OUT)]
    with Reader(tmp_path / "bag") as reader:
        read = [(one.topic, one.msgtype, time, bytes(data)) for one, time, data in reader.messages()]
        counts = {one.topic: one.msgcount for one in reader.connections}
        for one in reader.connections:
            get_typestore(Stores.EMPTY).register(get_types_from_msg(one.msgdef.data, one.msgtype))
    assert read == [(entry.channel, entry.type, entry.stamp_ns, entry.data()) for entry in recorded]
    assert sum(counts.values()) == len(recorded) > 5
    assert main(["import", str(tmp_path / "bag"), "-o", str(tmp_path / "back.mcap")]) == 0
    back = [
        (entry.channel, entry.type, entry.stamp_ns, entry.source_ns, entry.data())
        for entry in entries(tmp_path / "back.mcap")
    ]
    assert back == [(entry.channel, entry.type, entry.stamp_ns, entry.source_ns, entry.data()) for entry in recorded]


def test_streams_are_chosen(recording: Path, tmp_path: Path) -> None:
    exported(recording, "rosbag2", tmp_path / "bag", "/said", "/sp*")
    with Reader(tmp_path / "bag") as reader:
        assert {one.topic for one in reader.connections} == {"/said", "/speed"}


def sequence(path: Path, *, pixels: bool) -> Path:
    """Three frames; a transform is lost in the second, another one always."""
    size = "2 2 3" if pixels else "0 0 3"
    lines = ["NDims = 3", f"CompressedData = {pixels}", f"DimSize = {size}", "ElementType = MET_UCHAR"]
    lines += ["UltrasoundImageOrientation = MFA"]
    for frame in range(3):
        for name, status in (("ProbeToTracker", "INVALID" if frame == 1 else "OK"), ("StylusToTracker", "INVALID")):
            lines += [
                f"Seq_Frame000{frame}_{name}Transform = 1 0 0 {frame}.25 0 1 0 2 0 0 1 3 0 0 0 1",
                f"Seq_Frame000{frame}_{name}TransformStatus = {status}",
            ]
        lines += [f"Seq_Frame000{frame}_OtherToTrackerTransform = 1 0 0 0.1 0 1 0 2 0 0 1 3 0 0 0 1"]
        lines += [f"Seq_Frame000{frame}_Timestamp = {frame}.500000001"]
    data = zlib.compress(b"abcdefghijkl") if pixels else b""
    path.write_bytes("\n".join([*lines, "ElementDataFile = LOCAL", ""]).encode() + data)
    return path


@pytest.mark.parametrize("pixels", [True, False])
def test_a_sequence_comes_back(tmp_path: Path, pixels: bool) -> None:
    source = sequence(tmp_path / "some.igs.mha", pixels=pixels)
    assert main(["import", str(source), "-o", str(tmp_path / "a.mcap"), "--epoch", "2024-02-29"]) == 0
    exported(tmp_path / "a.mcap", "igs.mha", tmp_path / "b.igs.mha")
    assert main(["import", str(tmp_path / "b.igs.mha"), "-o", str(tmp_path / "c.mcap")]) == 0
    first, second = (
        [
            (entry.channel, entry.source_ns, entry.data())
            for entry in entries(tmp_path / name)
            if entry.kind is Kind.IGTL_IN
        ]
        for name in ("a.mcap", "c.mcap")
    )
    assert first == second
    assert len(first) == (8 if pixels else 5)
    header = (tmp_path / "b.igs.mha").read_bytes().partition(b"ElementDataFile")[0].decode()
    assert "Seq_Frame0001_ProbeToTrackerTransformStatus = INVALID" in header
    assert header.count("StylusToTrackerTransformStatus = INVALID") == 3
    assert header.count("OtherToTrackerTransformStatus = OK") == 3
    assert "UltrasoundImageOrientation = MFA" in header
    assert "Seq_Frame0002_Timestamp = 2.500000001" in header


def written(path: Path, *given: tuple[int, Kind, str, str, bytes]) -> Path:
    """A session of these: nanosecond, kind, channel, type, bytes."""
    writer = SessionWriter(path, {})
    for number, (at, kind, channel, name, data) in enumerate(given, 1):
        links = () if channel.startswith("/") else (1,)
        writer.write(Entry(number, START + at, kind, channel, name, (data,), links))
    writer.close({})
    return path


def test_a_transform_is_valid_between_poses_of_the_stated_gap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose = join(encode(Message("TRANSFORM", "AToB", moved(7))))
    scan = join(encode(Message("IMAGE", "Scan", Image((1, 1, 1), 3, b"x"))))
    ms = 10**6
    path = written(
        tmp_path / "some.mcap",
        (0, Kind.IGTL_IN, "IMAGE/Scan", "IMAGE", scan),
        (2 * ms, Kind.IGTL_IN, "TRANSFORM/AToB", "TRANSFORM", pose),
        (80 * ms, Kind.IGTL_IN, "IMAGE/Scan", "IMAGE", scan),
        (152 * ms, Kind.IGTL_IN, "TRANSFORM/AToB", "TRANSFORM", pose),
        (200 * ms, Kind.IGTL_IN, "IMAGE/Scan", "IMAGE", scan),
        (303 * ms, Kind.IGTL_IN, "TRANSFORM/AToB", "TRANSFORM", pose),
    )
    for more, expected in (((), [False, True, False]), (("--max-gap", "0.151"), [False, True, True])):
        out = tmp_path / f"{len(more)}.mha"
        assert main(["export", str(path), "--to", "igs.mha", "-o", str(out), *more]) == 0
        told = out.read_bytes().decode("latin1")
        assert [f"Seq_Frame000{frame}_AToBTransformStatus = OK" in told for frame in range(3)] == expected
    capsys.readouterr()
    for target, gap in (("csv", "1"), ("igs.mha", "-1"), ("igs.mha", "nan"), ("igs.mha", "1e9")):
        assert main(["export", str(path), "--to", target, "-o", str(tmp_path / "new.mha"), "--max-gap", gap]) == 2
        assert "--max-gap: found" in capsys.readouterr().err


def test_a_message_in_two_header_versions_is_one_row(tmp_path: Path) -> None:
    said = String.of("a")
    forms = [join(encode(Message("STRING", "Said", said, header_version=version))) for version in (1, 2)]
    path = written(
        tmp_path / "some.mcap",
        *((at, Kind.IGTL_OUT, "STRING/Said", "STRING", data) for at, data in enumerate(forms)),
        (5, Kind.IGTL_IN, "STRING/Other", "STRING", join(encode(Message("STRING", "Other", said)))),
        (6, Kind.IGTL_OUT, "STRING/Said", "STRING", forms[0]),
    )
    files = exported(path, "csv", tmp_path / "out", "Said")
    assert [line.split(",")[0] for line in files["igtl_out.STRING_Said.csv"].read_text().splitlines()] == [
        "entry",
        "1",
        "4",
    ]


@pytest.mark.parametrize(("numbers", "rows"), [(64, 1), (65, 0)])
def test_long_rows_of_numbers_are_no_table(tmp_path: Path, numbers: int, rows: int) -> None:
    name = "std_msgs/msg/Float64MultiArray"
    layout = ROS2.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    path = written(
        tmp_path / "some.mcap",
        (1, Kind.ROS_IN, "/row", name, ros(name, layout=layout, data=np.arange(numbers, dtype=np.float64))),
        (2, Kind.ROS_IN, "/said", "std_msgs/msg/String", ros("std_msgs/msg/String", data="a")),
    )
    assert len(exported(path, "csv", tmp_path / "out")) == 1 + rows


def test_several_images_are_no_sequence(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session, path = Session(Gateway(Config())), tmp_path / "two.mcap"
    writer = SessionWriter(path, {})
    for device in ("A", "B"):
        data = join(encode(Message("IMAGE", device, Image((1, 1, 1), 3, b"x"))))
        for entry in session.input(START, Kind.IGTL_IN, (data,), links=(1,)):
            writer.write(entry)
    writer.close({})
    assert main(["export", str(path), "--to", "igs.mha", "-o", str(tmp_path / "out.mha")]) == USAGE
    assert "found IMAGE/A, IMAGE/B, expected one" in capsys.readouterr().err
    assert not (tmp_path / "out.mha").exists()
    exported(path, "igs.mha", tmp_path / "out.mha", "A")
    assert b"DimSize = 1 1 1\n" in (tmp_path / "out.mha").read_bytes()


def test_tables(recording: Path, tmp_path: Path) -> None:
    files = exported(recording, "csv", tmp_path / "tables")
    tables = {name: list(csv.DictReader(file.open(encoding="utf-8", newline=""))) for name, file in files.items()}
    poses = tables["igtl_in.TRANSFORM_ProbeToTracker.csv"]
    assert [(row["time_ns"], row["source_ns"], row["x_mm"], row["qw"], row["r11"]) for row in poses] == [
        (str(START + 1_000), str(START + 1_000), "1.5", "1.0", "1.0"),
        (str(START + 7_000), str(START + 7_000), "2.5", "1.0", "1.0"),
    ]
    assert [row["string"] for row in tables["igtl_in.STRING_Said.csv"]] == ['one, "two"\nthree']
    assert [row["data"] for row in tables["ros_in.said.csv"]] == ["ähm"]
    (speed,) = tables["ros_in.speed.csv"]
    assert [
        speed[f"{part}.{axis}_{unit}"] for part, unit in (("linear", "m_s"), ("angular", "rad_s")) for axis in "xyz"
    ] == [f"{value}.0" for value in range(1, 7)]
    assert not any("POLYDATA" in name or "IMAGE" in name for name in files)
    frames = tables["ros_out.tf.csv"]
    assert [row["transforms.transform.translation.x_m"] for row in frames] == ["0.0015", "0.0025"]


def test_ply_holds_the_surface(recording: Path, tmp_path: Path) -> None:
    files = exported(recording, "ply", tmp_path / "ply", "POLYDATA/Surface")
    data = files["igtl_in.POLYDATA_Surface.000001.ply"].read_bytes()
    head, _, body = data.partition(b"end_header\n")
    assert b"element vertex 4\n" in head
    assert b"element face 2\n" in head
    vertices = np.frombuffer(body, [("xyz", "<f4", 3), ("rgba", "u1", 4)], 4)
    assert (vertices["xyz"] == CORNERS).all()
    assert vertices["rgba"].tolist()[:2] == [[255, 0, 0, 255], [0, 255, 0, 255]]
    faces = np.frombuffer(body[vertices.nbytes :], [("count", "u1"), ("points", "<i4", 3)])
    assert faces["count"].tolist() == [3, 3] and faces["points"].tolist() == [[0, 1, 2], [0, 2, 3]]


def test_vtk_holds_the_surface_and_its_attributes(recording: Path, tmp_path: Path) -> None:
    files = exported(recording, "vtk", tmp_path / "vtk", "Surface")
    data = files["igtl_in.POLYDATA_Surface.000001.vtk"].read_bytes()
    _, _, rest = data.partition(b"POINTS 4 float\n")
    assert (np.frombuffer(rest, ">f4", 12).reshape(4, 3) == CORNERS).all()
    _, _, rest = data.partition(b"POLYGONS 2 8\n")
    assert np.frombuffer(rest, ">i4", 8).tolist() == [3, 0, 1, 2, 3, 0, 2, 3]
    _, _, rest = data.partition(b"POINT_DATA 4\nCOLOR_SCALARS colours 4\n")
    assert (np.frombuffer(rest, "u1", 16).reshape(4, 4) == np.rint(COLOURS * 255)).all()
    _, _, rest = rest.partition(b"\nFIELD attributes 1\nRGBA 4 4 float\n")
    assert (np.frombuffer(rest, ">f4", 16).reshape(4, 4) == COLOURS).all()


def test_surfaces_of_both_sides_are_the_same(recording: Path, tmp_path: Path) -> None:
    files = exported(recording, "ply", tmp_path / "ply")
    points = {name: file.read_bytes().partition(b"end_header\n")[2] for name, file in files.items()}
    mesh = next(name for name in points if name.startswith("ros_out.") and "mesh" in name.lower())
    assert np.allclose(np.frombuffer(points[mesh], "<f4", 12).reshape(4, 3), CORNERS)  # metres there


def test_nrrd_places_the_volume(recording: Path, tmp_path: Path) -> None:
    files = exported(recording, "nrrd", tmp_path / "nrrd", "IMAGE/*")
    head, _, pixels = files["igtl_in.IMAGE_Scan.000001.nrrd"].read_bytes().partition(b"\n\n")
    told = dict(line.split(": ", 1) for line in head.decode().splitlines()[2:])
    assert pixels == bytes(range(48))
    assert (told["type"], told["endian"], told["sizes"]) == ("uint16", "big", "4 3 2")
    assert told["space"] == "left-posterior-superior"
    assert told["space directions"] == "(0,2,0) (-3,0,0) (0,0,4)"
    assert told["space origin"] == "(13,17,28)"  # the centre is 10, 20, 30


def test_nrrd_writes_each_picture_once(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of an IMAGE that became topics, the IMAGE alone; a topic if it is selected alone."""
    words = ["export", str(recording), "--to", "nrrd"]
    assert main([*words, "-o", str(tmp_path / "all")]) == 0
    names = sorted(each.name for each in (tmp_path / "all").iterdir())
    assert names and all(each.startswith("igtl_in.") for each in names), names
    assert "copies of IMAGE/Scan; --streams selects them alone" in capsys.readouterr().out
    with SessionFile.open(recording) as file:
        topics = {
            each.channel
            for each in file.entries()
            if each.kind is Kind.ROS_OUT and each.type.endswith(("/Image", "/Volume"))
        }
    topic = min(topics)
    assert main([*words, "--streams", topic, "-o", str(tmp_path / "topic")]) == 0
    assert all(each.name.startswith("ros_out.") for each in (tmp_path / "topic").iterdir())


def test_what_cannot_be_decoded_is_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = join(encode(Message("STRING", "Said", String.of("a"))))
    bad = bytearray(good)
    bad[-1] ^= 1
    path = tmp_path / "bad.mcap"
    writer = SessionWriter(path, {})
    for number, data in enumerate((good, bytes(bad)), 1):
        writer.write(Entry(number, START + number, Kind.IGTL_IN, "STRING/Said", "STRING", (data,), (1,)))
    writer.close({})
    assert main(["export", str(path), "--to", "csv", "-o", str(tmp_path / "out"), "--json"]) == FAILURE
    told = json.loads(capsys.readouterr().out)
    assert [(row["found"], row["exported"]) for row in told["rows"]] == [(2, 1)]
    assert "CRC" in told["rows"][0]["why"]


def test_nothing_is_replaced(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    for to in ("rosbag2", "csv", "ply", "nrrd", "vtk"):
        assert main(["export", str(recording), "--to", to, "-o", str(tmp_path / "full")]) == USAGE
    assert main(["export", str(recording), "--to", "igs.mha", "-o", str(recording)]) == USAGE
    assert main(["export", str(recording), "--to", "csv", "-o", str(tmp_path / "out"), "--streams", "no"]) == USAGE
    err = capsys.readouterr().err
    assert "--streams: found 'no', expected a recorded stream" in err
    assert [file.name for file in (tmp_path / "full").iterdir()] == ["mine"]


@pytest.mark.parametrize(("write", "name"), [(turtles, "some.bag"), (cdr_sqlite3, "cdr")])
def test_bags_of_robots_come_back(tmp_path: Path, write: Callable[[Path], Path], name: str) -> None:
    assert main(["import", str(write(tmp_path / name)), "-o", str(tmp_path / "a.mcap")]) == 0
    exported(tmp_path / "a.mcap", "rosbag2", tmp_path / "bag")
    with Reader(tmp_path / "bag") as reader:
        read = {one.topic: 0 for one in reader.connections}
        for one, _, _ in reader.messages():
            read[one.topic] += 1
        assert read == {one.topic: one.msgcount for one in reader.connections}
    assert sum(read.values()) == len(entries(tmp_path / "a.mcap"))


def test_a_sequence_of_plus_comes_back(tmp_path: Path) -> None:
    source = cropped(tmp_path / "0.igs.mha")
    for number, path in enumerate((source, tmp_path / "1.igs.mha")):
        assert main(["import", str(path), "-o", str(tmp_path / f"{number}.mcap")]) == 0
        exported(tmp_path / f"{number}.mcap", "igs.mha", tmp_path / f"{number + 1}.igs.mha")
    assert (tmp_path / "1.igs.mha").read_bytes() == (tmp_path / "2.igs.mha").read_bytes()


@pytest.mark.parametrize("to", ["csv", "ply", "vtk", "nrrd", "rosbag2"])
def test_foreign_names_stay_in_the_folder_and_on_their_line(
    tmp_path: Path, to: str, capsys: pytest.CaptureFixture[str]
) -> None:
    devices = [
        "../../x",
        "/etc/passwd",
        "..",
        "",
        "CON",
        "a/b\\c",
        "\x1b[2J",
        "a\nb: forged",
        "=1+1",
        "A/x",
        "A_x",
        "a.x",
    ]
    given: list[tuple[int, Kind, str, str, bytes]] = []
    for number, device in enumerate(devices):
        for kind, content in (("POLYDATA", SURFACE), ("IMAGE", VOLUME), ("STRING", String.of("a"))):
            data = join(encode(Message(kind, device, content)))
            given.append((len(given), Kind.IGTL_IN, f"{kind}/{device}", kind, data))
        said = ros("std_msgs/msg/String", data="a")
        given.append((len(given), Kind.ROS_IN, f"/{number}/{device}", "std_msgs/msg/String", said))
    path = written(tmp_path / "some.mcap", *given)
    before = {file: file.stat().st_mtime_ns for file in (tmp_path, path)}
    (tmp_path / "inside").mkdir()
    out = tmp_path / "inside" / "out"
    assert main(["export", str(path), "--to", to, "-o", str(out)]) == 0
    told = capsys.readouterr().out
    assert "\x1b" not in told
    assert not any(line.startswith("b: forged") for line in told.splitlines())
    assert sorted(file.name for file in tmp_path.iterdir()) == ["inside", "some.mcap"]
    assert [file.name for file in (tmp_path / "inside").iterdir()] == ["out"]
    assert path.stat().st_mtime_ns == before[path]
    made = list(out.iterdir())
    assert all(file.is_file() and not file.is_symlink() for file in made)
    expected = {"csv": 2, "ply": 1, "vtk": 1, "nrrd": 1}.get(to, 0) * len(devices) or 2
    assert len(made) == expected
    assert main(["export", str(path), "--to", to, "-o", str(out)]) == USAGE
    assert {file: file.stat().st_mtime_ns for file in made} == {file: file.stat().st_mtime_ns for file in out.iterdir()}


def test_a_name_without_a_stream_is_reported_and_the_others_are_exported(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    globs = ["--streams", "TRANSFORM/*", "--streams", "Toool"]
    assert main(["export", str(recording), "--to", "csv", "-o", str(tmp_path / "out"), *globs]) == 0
    assert "--streams Toool: matches no recorded stream" in capsys.readouterr().out
    assert main(["export", str(recording), "--to", "csv", "-o", str(tmp_path / "other"), *globs, "--json"]) == 0
    assert "Toool" in json.loads(capsys.readouterr().out)["notes"][-1]
