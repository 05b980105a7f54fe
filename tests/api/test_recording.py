"""``igtl_gateway.open``: every number against ``info`` and a plain reader of MCAP with its own unpacking."""

from __future__ import annotations

import http.server
import io
import json
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

import igtl_gateway
from igtl_gateway.base.errors import (
    ClockWarning,
    ClosedRecording,
    ConfigError,
    DamagedRecording,
    LimitExceeded,
    UnsupportedRecording,
)
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import Header, Image
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message
from igtl_gateway.wire.transform import Transform
from tests import exchanges
from tests.files import BytesRead
from tests.places import FIXTURES
from tests.script import Script

STAR = FIXTURES / "star.mcap"
TOOL = "TRANSFORM/ToolToBase"
START_NS = 1767225600_000000000


def raw_messages(path: Path, topic: str) -> list[tuple[int, int, int, bytes]]:
    """Sequence, log time, publish time and OpenIGTLink message of a wire topic; RawMessage unpacked by hand."""
    found = []
    with path.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=[topic]):
            data, at = message.data, 32
            at += 4 + 4 * struct.unpack_from("<I", data, at)[0]
            for _ in range(2):
                at += 4 + struct.unpack_from("<I", data, at)[0]
                at += -at % 4
            (size,) = struct.unpack_from("<I", data, at)
            assert at + 4 + size == len(data)
            found.append((message.sequence, message.log_time, message.publish_time, data[at + 4 :]))
    return found


@pytest.mark.parametrize("name", ["star", "every-type"])
def test_streams_are_those_of_info(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = FIXTURES / f"{name}.mcap"
    assert main(["info", "--json", str(path)]) in (0, 1)
    info = json.loads(capsys.readouterr().out)
    with igtl_gateway.open(path) as recording:
        assert recording.entry_count == info["entries"]
        assert recording.duration == pytest.approx(info["duration_s"])
        expected = {(row["direction"], row["stream"], row["type"]): row["messages"] for row in info["streams"]}
        found = {(each.direction, each.name, each.type): each for each in recording.streams.values()}
        # streams that peers invented share a channel, which has the name of its topic
        shared = [key for key in found if key[1].startswith("/igtl_gateway/")]
        assert {key: each.count for key, each in found.items() if key not in shared}.items() <= expected.items()
        assert sum(each.count for each in found.values()) == sum(expected.values())
        for each in found.values():
            assert len(each.times) == len(each.source_times) == len(each.numbers) == each.count
            assert (each.first_time, each.last_time) == (each.times[0], each.times[-1])
            assert recording[each.key] is each


def test_poses_of_openigtlink_are_those_of_a_plain_reader() -> None:
    rows = raw_messages(STAR, "/igtl_gateway/wire/out/transform/ToolToBase")
    with igtl_gateway.open(STAR) as recording:
        stream = recording[TOOL]
        poses = stream.poses()
        assert stream.numbers.tolist() == [row[0] for row in rows]
        assert poses.times.tolist() == stream.times.tolist() == [row[1] for row in rows]
        assert poses.stamps.tolist() == poses.source_times.tolist() == [row[2] for row in rows]
    for matrix, (_, _, _, message) in zip(poses.matrices, rows, strict=True):
        numbers = struct.unpack(">12f", message[58:])
        assert matrix[:3].T.reshape(-1).tolist() == list(numbers)
        assert matrix[3].tolist() == [0, 0, 0, 1]
    assert (poses.unit, poses.parent, poses.child, poses.left_out) == ("mm", "Base", "Tool", 0)


def test_poses_of_ros_are_those_of_a_plain_reader() -> None:
    with STAR.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        rows = [(message, ros) for _, _, message, ros in reader.iter_decoded_messages(topics=["/star/tool"])]
    with igtl_gateway.open(STAR) as recording:
        poses = recording["/star/tool"].poses()
        millimetres = recording["/star/tool"].positions("mm")
    assert (poses.unit, poses.parent, poses.child) == ("m", "lwr_base", "suture_tool")
    assert poses.times.tolist() == [message.log_time for message, _ in rows]
    assert poses.stamps.tolist() == [ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec for _, ros in rows]
    for row, (_, ros) in enumerate(rows):
        place, turn = ros.transform.translation, ros.transform.rotation
        assert poses.positions[row].tolist() == [place.x, place.y, place.z]
        assert np.allclose(millimetres[row], [1000 * place.x, 1000 * place.y, 1000 * place.z], rtol=1e-15)
        w, x, y, z = turn.w, turn.x, turn.y, turn.z
        first = [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)]
        assert np.allclose(poses.matrices[row, :3, 0], first, atol=1e-8)


def test_images_are_those_of_a_plain_reader() -> None:
    rows = raw_messages(STAR, "/igtl_gateway/wire/out/image/Camera")
    with igtl_gateway.open(STAR) as recording:
        images = recording["IMAGE/Camera"].images()
        pictures = recording["/star/camera/image"].images()
        assert len(images) == len(pictures) == len(rows) == 12
        for image, picture, (_, time, _, message) in zip(images, pictures, rows, strict=True):
            columns, lines, slices = struct.unpack_from(">3H", message, 58 + 6)
            pixels = np.frombuffer(message[58 + 72 :], np.uint8).reshape(slices, lines, columns, 3)
            assert image.time == time
            assert np.array_equal(image.array, pixels)
            assert np.array_equal(picture.plane, image.plane)
            assert (image.unit, image.spacing) == ("mm", (1.0, 1.0, 1.0))
            assert picture.matrix is None
            # the wire has the centre of the image
            assert image.matrix is not None
            centre = image.matrix @ [(columns - 1) / 2, (lines - 1) / 2, (slices - 1) / 2, 1]
            assert np.allclose(centre[:3], struct.unpack_from(">12f", message, 58 + 12)[9:])
        assert [each.time for each in images[2:4]] == [images[2].time, images[-9].time]
        with pytest.raises(IndexError):
            images[12]


def test_the_padding_of_rows_is_no_pixel(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    pixels = np.arange(3 * 5 * 3, dtype=np.uint8).reshape(3, 5, 3)
    padded = np.pad(pixels.reshape(3, 15), ((0, 0), (0, 9)), constant_values=99)
    message = Image(Header(0, "camera"), 3, 5, "rgb8", 0, 24, padded.tobytes())
    writer = SessionWriter(path, {})
    writer.write(Entry(1, START_NS, Kind.ROS_IN, "/camera", Image.TYPE, (message.pack(),)))
    writer.close({})
    with igtl_gateway.open(path) as recording:
        assert np.array_equal(recording["/camera"].images()[0].plane, pixels)


def test_volumes_have_the_same_geometry_on_both_sides() -> None:
    with igtl_gateway.open(FIXTURES / "lego.mcap") as recording:
        volumes = [each.images()[0] for each in recording.values() if each.type == "igtl_msgs/msg/Volume"]
        wires = [each.images()[0] for each in recording.values() if each.type == "IMAGE"]
    assert volumes
    for volume in volumes:
        (wire,) = (each for each in wires if each.array.shape == volume.array.shape)
        assert np.array_equal(wire.array, volume.array)
        assert wire.matrix is not None and volume.matrix is not None
        assert np.allclose(wire.matrix[:3], 1000 * volume.matrix[:3], atol=1e-4)


def test_clouds_of_both_sides_are_the_same_points() -> None:
    with igtl_gateway.open(STAR) as recording:
        clouds, surfaces = recording["/star/cloud"].points(), recording["POLYDATA/TissueCloud"].points()
        assert len(clouds) == len(surfaces) == 12
        for cloud, surface in zip(clouds[:3], surfaces[:3], strict=True):
            whole = cloud.xyz[np.isfinite(cloud.xyz).all(axis=1)]
            assert np.allclose(1000 * whole, surface.xyz, atol=1e-3)
        markers = recording["POINT/NirMarkers"].points()[0]
        assert np.allclose(markers.xyz, 1000 * recording["/star/nir_markers"].points()[0].xyz, atol=1e-3)
        plan = recording["in:POINT/PlanPoints"].points()[0]
        assert plan.names[0] == "entry 1" and plan.fields["rgba"][0].tolist() == [255] * 4
        assert recording["/igtl/in/PlanPoints/landmarks"].points()[0].names == plan.names


def test_messages_are_decoded() -> None:
    with igtl_gateway.open(STAR) as recording:
        texts = [message.content.text for message in recording["STRING/StarStatus"].messages()]
        ros = [message.content.data for message in recording["/star/status"].messages()]
        assert texts == ros and texts[0].startswith("session: SYNTHETIC")


def test_a_wrong_name_has_a_proposal() -> None:
    with igtl_gateway.open(STAR) as recording:
        with pytest.raises(TypeError, match="found 3, expected the name of a stream"):
            recording[3]  # type: ignore[index]
        with pytest.raises(KeyError, match="did you mean 'TRANSFORM/ToolToBase'"):
            recording["TRANSFORM/TolToBase"]
        with pytest.raises(KeyError, match="'out:POINT/PlanPoints', 'in:POINT/PlanPoints'"):
            recording["POINT/PlanPoints"]
        assert recording["in:POINT/PlanPoints"].count == 1
        assert recording[f"out:{TOOL}"] is recording[TOOL]
        assert "nothing" not in recording
        for method in ("poses", "images", "points"):
            with pytest.raises(ConfigError, match="found type STRING, expected"):
                getattr(recording["STRING/StarStatus"], method)()


def test_a_window_is_chosen_by_seconds_nanoseconds_datetime_and_text() -> None:
    with igtl_gateway.open(STAR) as recording:
        times = recording[TOOL].times
        expected = times[(times >= START_NS + 2 * 10**9) & (times < START_NS + 5 * 10**9)].tolist()
        for start, end in (
            (2.0, 5.0),
            (START_NS + 2 * 10**9, np.int64(START_NS + 5 * 10**9)),
            (datetime(2026, 1, 1, 0, 0, 2, tzinfo=timezone.utc), datetime(2026, 1, 1, 0, 0, 5)),
            ("2026-01-01T00:00:02Z", "5"),
            (np.datetime64("2026-01-01T00:00:02"), np.datetime64("2026-01-01T00:00:05")),
        ):
            part = recording.between(start, end)
            assert part[TOOL].times.tolist() == expected
            assert recording[TOOL].between(start, end).poses().times.tolist() == expected
        assert len(recording[TOOL].between(-1.0)) == sum(times >= recording.end_time - 10**9)
        assert recording[TOOL].between(3.0).between(0.0, 3.0).count == 0
        with pytest.raises(ConfigError, match="start: found 200000000, expected seconds"):
            recording.between(200_000_000)


def test_notes_ledger_and_configuration_are_there() -> None:
    with igtl_gateway.open(STAR) as recording:
        assert recording.notes[0].code == "synthetic"
        assert [note.code for note in recording.notes if note.kind == "link"] == ["link_up", "link_down"]
        assert recording.ledger is not None
        assert recording.ledger["streams"]["ros_in"]["/star/tool"]["received"] == 1200
        assert recording.config is not None and recording.config.base_frame == "lwr_base"
        assert recording.between(0.0, 1.0).notes == tuple(n for n in recording.notes if n.time < START_NS + 10**9)


def large_file(path: Path, megabytes: int) -> None:
    """Images of 1 MB each, every 10 ms, with a pose between two of them."""
    writer = SessionWriter(path, {}, compression="none")
    pixels = bytes(1 << 20)
    for number in range(megabytes):
        time = START_NS + number * 10_000_000
        writer.write(Entry(2 * number + 1, time, Kind.ROS_IN, "/image", "std_msgs/msg/String", (pixels,)))
        pose = struct.pack("<4B7d", 0, 1, 0, 0, number, 0, 0, 0, 0, 0, 1)
        writer.write(Entry(2 * number + 2, time + 1, Kind.ROS_IN, "/pose", "geometry_msgs/msg/Pose", (pose,)))
    writer.close({})


def test_the_end_of_a_large_file_is_read_without_its_beginning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "large.mcap"
    large_file(path, 60)
    read = BytesRead(monkeypatch)
    with igtl_gateway.open(path) as recording:
        poses = recording["/pose"].between(-0.045).poses()
        assert poses.positions[:, 0].tolist() == [55, 56, 57, 58, 59]
        assert read.count < 8 << 20
        assert recording["/image"].first_time == START_NS  # by the index
        assert read.count < 8 << 20
        assert len(recording["/image"].between(0.1, 0.12)) == 2
        assert read.count < 12 << 20


def test_a_file_that_was_cut_off_is_read_as_far_as_it_is_whole(tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    data = STAR.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    with igtl_gateway.open(cut) as recording, igtl_gateway.open(STAR) as whole:
        (warning,) = recording.warnings
        assert warning.startswith(f"{cut}: was cut off after")
        poses = recording[TOOL].poses()
        assert 700 < len(poses) < 900
        assert np.array_equal(poses.matrices, whole[TOOL].poses()[: len(poses)].matrices)
        assert whole.warnings == ()
        # as `recover` declares it: a reader of the ledger knows that the end is lost
        assert recording.ledger is not None
        told = recording.ledger["recovered"]
        assert (told["from"], told["from_bytes"], told["whole"]) == ("cut.mcap", cut.stat().st_size, False)


def test_damage_is_one_line(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(STAR.read_bytes())
    data[3_000_000] ^= 0xFF
    damaged.write_bytes(data)
    with igtl_gateway.open(damaged) as recording:
        with pytest.raises(DamagedRecording, match="found checksum") as caught:
            recording["POLYDATA/TissueCloud"].points()
        assert "\n" not in str(caught.value)
    with pytest.raises(UnsupportedRecording, match="No such file"):
        igtl_gateway.open(tmp_path / "nothing.mcap")
    with pytest.raises(LimitExceeded):
        igtl_gateway.open(STAR, limits={"memory": 100})
    with igtl_gateway.open(STAR, limits={"memory": 300_000}) as recording, pytest.raises(LimitExceeded):
        recording[TOOL].poses()
    with pytest.raises(ConfigError, match="limits: found 'memori': 1"):
        igtl_gateway.open(STAR, limits={"memori": 1})


def test_the_parts_of_a_split_recording_are_one(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    with igtl_gateway.open(STAR) as whole:
        rows = [(int(t), whole[TOOL]._message(b, i)) for b in whole[TOOL].blocks() for i, t in enumerate(b.times)]
        payloads = [bytes(b.payload(i)) for b in whole[TOOL].blocks() for i in range(len(b))]
    for part in range(3):
        writer = SessionWriter(folder / f"split_{part}.mcap", {layout.PART_KEY: str(part)})
        for number in range(400 * part, 400 * part + 400):
            time = rows[number][0]
            writer.write(Entry(number + 1, time, Kind.IGTL_OUT, TOOL, "TRANSFORM", (payloads[number],), (1,)))
        writer.close({})
    with igtl_gateway.open(folder) as recording:
        stream = recording[TOOL]
        assert (stream.count, stream.first_time, stream.last_time) == (1200, rows[0][0], rows[-1][0])
        assert stream.times.tolist() == [time for time, _ in rows]
        assert len(stream.between(rows[350][0], rows[450][0]).poses()) == 100


def test_a_file_of_another_program_has_its_ros_topics(tmp_path: Path) -> None:
    assert main(["export", str(STAR), "--to", "rosbag2", "-o", str(tmp_path / "bag")]) in (0, 1)
    (path,) = (tmp_path / "bag").glob("*.mcap")
    with igtl_gateway.open(path) as bag, igtl_gateway.open(STAR) as whole:
        assert bag.config is None and bag.ledger is None
        assert np.array_equal(bag["/star/tool"].poses().matrices, whole["/star/tool"].poses().matrices)
        assert "lwr_base" in bag.tf.frames


def other_program(path: Path, channels: int, publish_ns: int) -> list[int]:
    """Write poses of one topic, in several channels, as rosbag2 does for several publishers; return their times."""
    with STAR.open("rb") as stream:
        schema, _, message = next(make_reader(stream).iter_messages(topics=["/star/tool"]))
    assert schema is not None
    with path.open("wb") as out:
        writer = Writer(out)
        writer.start("ros2")
        number = writer.register_schema(schema.name, schema.encoding, schema.data)
        ids = [writer.register_channel("/tool", "cdr", number) for _ in range(channels)]
        times = [START_NS + 1_000_000 * place for place in range(10 * channels)]
        for place, time_ns in enumerate(times):
            writer.add_message(ids[place % channels], time_ns, message.data, publish_ns or time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return times


def test_a_topic_of_several_channels_is_one_stream(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bag.mcap"
    times = other_program(path, 3, 0)
    with igtl_gateway.open(path) as bag:
        stream = bag["/tool"]
        assert len(bag) == 1
        assert len(stream) == len(stream.poses().matrices) == len(times)
        assert stream.times.tolist() == times
    assert main(["sync", str(path)]) == 1
    assert main(["info", "--json", str(path)]) == 0
    assert [row["messages"] for row in json.loads(capsys.readouterr().out)["streams"]] == [len(times)]


@pytest.mark.parametrize("publish_ns", [1 << 63, (1 << 64) - 1])
def test_a_stamp_after_2262_is_not_one_before_1970(publish_ns: int, tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    other_program(path, 1, publish_ns)
    with (
        igtl_gateway.open(path) as bag,
        pytest.raises(UnsupportedRecording, match=rf"found {publish_ns}, expected times up to 2\^63"),
    ):
        assert len(bag["/tool"].source_times)


class Ranges(http.server.BaseHTTPRequestHandler):
    """Serves the file ``data``: by ranges, unless ``plain``."""

    data = b""
    plain = False

    def do_GET(self) -> None:
        if self.path != "/star.mcap?key=1":
            self.send_error(404)
            return
        asked = self.headers.get("Range")
        start, end = 0, len(self.data) - 1
        if asked and not self.plain:
            start, end = (int(word) for word in asked.removeprefix("bytes=").split("-"))
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{end}/{len(self.data)}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(end + 1 - start))
        self.end_headers()
        self.wfile.write(self.data[start : end + 1])

    def log_message(self, *_: Any) -> None: ...


@contextmanager
def server(data: bytes, plain: bool = False) -> Iterator[str]:
    handler = type("Handler", (Ranges,), {"data": data, "plain": plain})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as serving:
        thread = threading.Thread(target=serving.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{serving.server_address[1]}/star.mcap?key=1"
        finally:
            serving.shutdown()
            thread.join()


def test_a_url_is_read_by_ranges() -> None:
    data = STAR.read_bytes()
    with server(data) as url, igtl_gateway.open(url) as recording, igtl_gateway.open(STAR) as whole:
        stream = recording._source.file._stream
        assert isinstance(stream, io.BufferedReader)
        found = recording[TOOL].between(-1.0).poses()
        assert np.array_equal(found.matrices, whole[TOOL].between(-1.0).poses().matrices)
        assert stream.raw.bytes_read < len(data) / 2
        assert recording.path == url
        with pytest.raises(UnsupportedRecording, match="404"):
            igtl_gateway.open(url.replace("star", "moon"))
    with server(data, plain=True) as url, pytest.raises(UnsupportedRecording, match="without ranges"):
        igtl_gateway.open(url)
    with server(data[:1000]) as url, pytest.raises(DamagedRecording, match=r"^http:.*star.mcap.key=1: was cut off"):
        igtl_gateway.open(url)


def test_poses_that_do_not_fit_columns_are_decoded_one_by_one(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    pose, vector, turn = (store.types[f"geometry_msgs/msg/{name}"] for name in ("Pose", "Point", "Quaternion"))
    given = [pose(vector(float(x), 2.0, 3.0), turn(0.0, 0.0, 0.0, 1.0)) for x in range(5)]
    # some of them are big-endian
    data = [
        bytes(store.serialize_cdr(each, "geometry_msgs/msg/Pose", little_endian=x < 3)) for x, each in enumerate(given)
    ]
    data.insert(1, data[0][:20])
    writer = SessionWriter(tmp_path / "a.mcap", {})
    for number, each in enumerate(data, 1):
        writer.write(Entry(number, number, Kind.ROS_IN, "/pose", "geometry_msgs/msg/Pose", (each,)))
    writer.close({})
    with igtl_gateway.open(tmp_path / "a.mcap") as recording:
        poses = recording["/pose"].poses()
        assert poses.positions.tolist() == [[float(x), 2.0, 3.0] for x in range(5)]
        assert (poses.left_out, poses.times.tolist()) == (1, [1, 3, 4, 5, 6])


def test_a_type_without_a_pose_is_an_error() -> None:
    with igtl_gateway.open(FIXTURES / "lego.mcap") as recording:
        for key in ("/lego/joint_states", "STRING/Planner"):
            with pytest.raises(ConfigError, match="pose"):
                recording[key].poses()


# -- in a notebook ----------------------------------------------------------------------------------------------------


def test_numpy_takes_poses_images_and_clouds() -> None:
    with igtl_gateway.open(STAR) as recording:
        stream = recording[TOOL]
        poses, image = stream.poses(), recording["IMAGE/Camera"].images()[0]
        cloud = recording["POLYDATA/TissueCloud"].points()[0]
        for view, array in ((poses, poses.matrices), (image, image.array), (cloud, cloud.xyz)):
            got = np.asarray(view)
            assert got.dtype == array.dtype and np.array_equal(got, array, equal_nan=True)
            assert np.shares_memory(got, array), "no copy without need"
            assert not np.shares_memory(np.array(view), array)
            assert np.asarray(view, np.float16).dtype == np.float16
            assert view.__array__(copy=True) is not array
            assert np.shares_memory(view.__array__(copy=False), array)
            with pytest.raises(ValueError, match="needs a copy"):
                view.__array__(np.complex64, copy=False)
        assert np.asarray(recording["IMAGE/Camera"].images()).shape == (12, *image.array.shape)
        assert np.mean(image, axis=(0, 1, 2)).shape == (3,)
        with pytest.raises(TypeError, match=r"TRANSFORM/ToolToBase: found a stream, expected its poses\(\)"):
            np.asarray(stream)
        assert poses[0].shape == poses[np.int64(-1)].shape == (4, 4)
        assert np.array_equal(np.array(list(poses)), poses.matrices), "iteration gives matrices"
        assert len(poses[:3]) == len(poses[[0, 5, 7]]) == 3 and poses[:3].unit == "mm"
        assert [each.number for each in stream][:2] == [each.number for each in stream.messages()][:2]


def test_a_missing_file_is_a_file_not_found_error_for_every_function(tmp_path: Path) -> None:
    path = tmp_path / "nope.mcap"
    for function in (igtl_gateway.open, igtl_gateway.verify, igtl_gateway.review, igtl_gateway.replay_recording):
        for kind in (FileNotFoundError, UnsupportedRecording):
            with pytest.raises(kind, match=r"nope\.mcap: No such file"):
                function(path)
    with pytest.raises(FileNotFoundError):
        igtl_gateway.diff(STAR, path)
    (tmp_path / "text.mcap").write_text("no recording")
    with pytest.raises(UnsupportedRecording) as found:
        igtl_gateway.open(tmp_path / "text.mcap")
    assert not isinstance(found.value, FileNotFoundError)


def test_a_part_that_ends_before_it_starts_is_an_error() -> None:
    with igtl_gateway.open(STAR) as recording:
        for part in (recording, recording[TOOL]):
            with pytest.raises(ConfigError, match=r"^end: found 2, which is before 5, expected a moment after the"):
                part.between(5, 2)
            with pytest.raises(ConfigError, match=r"^end: found -5, which is before -1"):
                part.between(-1, -5)
        assert recording.between(3, 3)[TOOL].count == 0
        assert recording.between(1, 2).between(5, 6)[TOOL].count == 0, "no common part"
        assert recording.between(100, 200).entry_count == 0, "after the end"


def test_a_part_has_its_own_size() -> None:
    with igtl_gateway.open(STAR) as recording:
        whole, entries = recording.entry_count, list(recording._source.file.entries())
        edges = [START_NS + step * 10**9 for step in (0, 1, 2, 5)] + [recording.end_time + 1]
        parts = [recording.between(start, end) for start, end in pairwise(edges)]
        for part, (start, end) in zip(parts, pairwise(edges), strict=True):
            assert part.entry_count == sum(start <= entry.stamp_ns < end for entry in entries)
            assert part.start_time == start and part.end_time == min(end, recording.end_time)
        assert sum(part.entry_count for part in parts) == whole == len(entries)
        assert [round(part.duration, 3) for part in parts[:3]] == [1.0, 1.0, 3.0]
        assert f"from 1.000 s to 2.000 s: {parts[1].entry_count} entries" in repr(parts[1])
        assert recording.between().entry_count == whole and recording.between().is_whole
        assert recording.between(-1).duration == pytest.approx(1.0)


@pytest.mark.parametrize("folder", [False, True])
def test_reading_after_close_is_named(folder: bool, tmp_path: Path) -> None:
    path = STAR
    if folder:  # whose parts are opened when they are read
        path = tmp_path / "parts"
        path.mkdir()
        with SessionFile.open(STAR) as whole:
            writer = SessionWriter(path / "parts_0.mcap", {**whole.recorded_session, layout.PART_KEY: "0"})
            for entry in whole.entries():
                writer.write(entry)
            writer.close(whole.ledger or {})
    with igtl_gateway.open(path) as recording:
        stream = recording[TOOL]
        poses, images = stream.poses(), recording["IMAGE/Camera"].images()
    assert len(poses) and images[0].array.size, "what was read stays valid"
    for read in (
        stream.poses,
        recording["IMAGE/Camera"].images,
        lambda: stream.times,
        lambda: stream.first_time,
        lambda: list(stream),
        lambda: recording.notes,
        lambda: recording.tf,
        lambda: recording.to_arrow(TOOL),
        lambda: recording.between(0, 0.5).entry_count,
        lambda: igtl_gateway.verify(recording),
        recording.__enter__,
    ):
        with pytest.raises(ClosedRecording, match=f"{path.name}: found a closed recording, expected an open one"):
            read()
    assert "closed" in repr(recording) and issubclass(ClosedRecording, ValueError)


def test_one_name_is_not_its_letters() -> None:
    with igtl_gateway.open(STAR) as recording:
        assert list(recording.to_arrow(TOOL)) == list(recording.to_pandas(TOOL)) == [TOOL]
        assert list(recording.to_arrow([TOOL, "/star/tool"])) == [TOOL, "/star/tool"]
        with pytest.raises(ConfigError, match=r"^streams: found \[1\], expected a string or a list of strings$"):
            recording.to_arrow([1])  # type: ignore[list-item]
        only = igtl_gateway.diff(recording, STAR, streams="/star/tool")
    assert [stream.stream for stream in only.streams] == ["/star/tool"]


@pytest.mark.slow
def test_results_are_one_line_in_a_console_and_escaped_in_a_notebook() -> None:
    with igtl_gateway.open(STAR) as recording:
        stream, images = recording[TOOL], recording["IMAGE/Camera"].images()
        clouds, aligned = recording["/star/cloud"].points(), igtl_gateway.align([stream], on=recording["/star/tool"])
        shown: list[Any] = [recording, stream, stream.poses(), images, images[0], clouds, clouds[0]]
        shown += [aligned, aligned[TOOL], recording.tf, recording.tf.edges[0], igtl_gateway.review(recording)]
        shown += [stream.poses()[:0], igtl_gateway.diff(recording, recording), igtl_gateway.verify(recording)]
        shown += [next(recording[key].messages()) for key in ("/star/plan", "POLYDATA/SuturePlan", "IMAGE/Camera")]
        shown += [igtl_gateway.lag(stream, stream), igtl_gateway.lag(stream, recording["/star/tool"])]
        with igtl_gateway.serve(0) as server, igtl_gateway.connect(port=server.port) as peer:
            server.wait_connected()
            assert f"127.0.0.1:{server.port}" in repr(peer)
            shown += [server, peer, igtl_gateway.Bridge(listen=["127.0.0.1:0"], ros=False)]
        for each in shown:
            assert len(repr(each)) < 200 and "\n" not in repr(each), repr(each)
            if hasattr(each, "_repr_html_"):
                assert each._repr_html_().startswith("<"), each
        page = recording._repr_html_()
        assert page.count("<tr>") == len(recording) + 1 and TOOL in page
        stream.key = "<script>"
        assert "<script>" not in stream._repr_html_() and "&lt;script&gt;" in stream._repr_html_()


@pytest.mark.slow
def test_the_verbs_take_an_open_recording(tmp_path: Path) -> None:
    with igtl_gateway.open(STAR) as recording:
        assert igtl_gateway.review(recording).last.wrong == igtl_gateway.review(STAR).last.wrong
        assert igtl_gateway.verify(recording) == igtl_gateway.verify(STAR)
        assert igtl_gateway.diff(recording, STAR).equal and igtl_gateway.diff(recording, recording).equal
        assert recording[TOOL].count == 1200, "and it stays open"
        for verb in (igtl_gateway.review, igtl_gateway.verify):
            with pytest.raises(ConfigError, match="found a part of a recording, expected the whole one"):
                verb(recording.between(1, 2))


def test_messages_of_two_peers_with_one_device_are_told_apart(tmp_path: Path) -> None:
    script = Script()
    for link in (1, 2):
        script.up(link)
    for number in range(10):
        matrix = (1, 0, 0, 0, 1, 0, 0, 0, 1, 100 * (number % 2 + 1), 0, 0)
        script.igtl(Message("TRANSFORM", "Tool", Transform(matrix), number + 1 << 32), link=number % 2 + 1)
    path = tmp_path / "s.mcap"
    writer = SessionWriter(path, {"config": json.dumps(Config().to_dict())})
    for entry in script.log:
        writer.write(entry)
    writer.close({})
    with igtl_gateway.open(path) as recording:
        stream = recording["TRANSFORM/Tool"]
        assert stream.links.tolist() == [1, 2] * 5
        with pytest.raises(ConfigError, match=r"links 1 and 2 in turn.*recording\['TRANSFORM/Tool@1'\]"):
            stream.poses()
        for link in (1, 2):
            one = recording[f"TRANSFORM/Tool@{link}"]
            assert one.positions().tolist() == [[100.0 * link, 0, 0]] * 5 and len(one) == one.count == 5
            assert one.links.tolist() == [link] * 5 and len(one.between(0.0, one.times[2])) == 2
            assert one.to_arrow()["x_mm"].to_pylist() == [100.0 * link] * 5
        assert stream.to_arrow()["link"].to_pylist() == [1, 2] * 5
        with pytest.raises(ConfigError, match="found messages of several peers"):
            recording["/igtl/in/Tool/transform"].poses()
        with pytest.raises(ConfigError, match=r"'Tool' in 'igtl': found poses of several peers.*TRANSFORM/Tool@LINK"):
            recording.tf.lookup("igtl", "Tool", recording["TRANSFORM/Tool@1"])
        for mixed in ("TRANSFORM/Tool", "/igtl/in/Tool/transform"):
            with pytest.raises(ConfigError, match="found messages of"):
                igtl_gateway.align([recording[mixed]], on=recording["TRANSFORM/Tool@1"])
        with pytest.warns(ClockWarning, match="TRANSFORM/Tool@1 are up to 999 ms older"):  # as they were made here
            assert len(igtl_gateway.align([recording["TRANSFORM/Tool@2"]], on=recording["TRANSFORM/Tool@1"]).times) == 5
        with pytest.raises(KeyError, match="Toool"):
            recording["TRANSFORM/Toool@1"]


def test_services_and_actions_are_streams(tmp_path: Path) -> None:
    """Messages have the fields of rosidl; an event has a request, a response or none of them."""
    with igtl_gateway.open(exchanges.write(tmp_path / "a.mcap")) as session:
        events = [each.content for each in session["/arm/enable/_service_event"].messages()]
        feedback = session["/fib/_action/feedback"]
        assert [len(each.content.feedback.sequence) for each in feedback.messages()] == [3, 4] * 4
    assert [(len(each.request), len(each.response)) for each in events[:4]] == [(1, 0), (1, 0), (0, 1), (0, 1)]
    assert (events[0].request[0].data, events[2].response[0].message) == (True, "on")
