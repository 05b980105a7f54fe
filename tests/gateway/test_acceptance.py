"""What a session accepted, every reader reads: a recording with ``check_crc = false`` and messages without CRCs gives
the same as the recording of the same messages with CRCs, in every way to read it.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.addons.exchange.targets import TARGETS
from igtl_gateway.api.recording import Recording
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import ConfigError, WireError
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.triggers import trigger
from igtl_gateway.gateway import LINK_UP, LINKS_TOPIC, Session, make_core
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.stamps import restamped
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.wire import Item, Message, decode, encode
from igtl_gateway.wire.header import CRC, CRC_AT, HEADER_SIZE
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.transform import Transform
from igtl_gateway_lab.simulate.every_igtl import contents

START_NS = 1_700_000_000_000_000_000
NS = 1_000_000_000
_POSE = "TRANSFORM/StylusToTracker"


def _messages(zeroed: bool) -> Iterator[tuple[int, bytes]]:
    """Time and bytes of each message: every type, and poses of versions 1 and 2; with or without CRCs."""
    named = [Message(kind, device, content) for kind, device, content in contents()]
    for number in range(20):
        pose = Transform((1.0, 0, 0, 0, 1, 0, 0, 0, 1, number, 2, 3))
        items = (Item.of("ros.stamp", str(START_NS + number)), Item.of("a", "b")) if number % 2 else ()
        named.append(Message("TRANSFORM", "StylusToTracker", pose, header_version=1 + number % 2, metadata=items))
    named.append(Message("STATUS", "Arm", Status(13)))
    for number, message in enumerate(named):
        data = bytes(join(encode(message)))
        yield START_NS + (number + 1) * NS // 50, data[:CRC_AT] + bytes(8) + data[HEADER_SIZE:] if zeroed else data


def record(path: Path, *, zeroed: bool, check_crc: bool, **options: Any) -> Path:
    config = Config(check_crc=check_crc)
    session = Session(make_core(config))
    up = Note(Level.INFO, LINK_UP, "a peer", data={"address": "127.0.0.1:1"}).pack()
    entries = session.input(START_NS, Kind.LINK, (up,), links=(1,))
    for now_ns, data in _messages(zeroed):
        entries += session.input(now_ns, Kind.IGTL_IN, (data,), links=(1,))
    recorder = Recorder(
        path,
        {layout.CONFIGURATION_KEY: json.dumps(config.to_dict()), "host": "a"},
        qos_of=lambda _topic, _type: None,
        on_note=lambda _note: None,
        clock=ManualClock(),
        host=in_thread,
        options=RecordOptions(**options),
        rule=StateInputRule(frozenset({LINKS_TOPIC})),
    )
    for entry in entries:
        recorder(entry)
    if options.get("snapshot_s") and not options.get("triggers"):
        recorder.snapshot().result(30)
    summary = recorder.close({"streams": {}})
    assert not summary.failure
    return path


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The recording with CRCs, and the one without."""
    folder = tmp_path_factory.mktemp("acceptance")
    for name in ("with", "without"):
        (folder / name).mkdir()
    return (
        record(folder / "with" / "s.mcap", zeroed=False, check_crc=True),
        record(folder / "without" / "s.mcap", zeroed=True, check_crc=False),
    )


def _plain(value: Any) -> Any:
    """A value that can be compared: arrays as lists, contents by their fields."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return repr(value)


def _of(content: Any) -> Any:
    return bytes(join(content.pack())) if hasattr(content, "pack") else repr(content)


def read_all(recording: Recording) -> dict[str, Any]:
    """All that the Python API gives of a recording."""
    found: dict[str, Any] = {}
    for key, stream in recording.items():
        if key.endswith("/Custom/raw"):
            continue  # the bytes, with their CRC
        found[f"{key} messages"] = [(m.type, _of(m.content), m.metadata) for m in stream]
        found[f"{key} table"] = stream.to_arrow().to_pylist()
        if stream.type == "IMAGE":
            images = stream.images()
            full = [number for number, each in enumerate(stream) if isinstance(each.content, Image)]
            found[f"{key} images"] = [_plain(images[number].array) for number in full]
        if stream.type in ("POINT", "POLYDATA"):
            clouds = stream.points()
            full = [number for number, each in enumerate(stream) if isinstance(each.content, Points | PolyData)]
            found[f"{key} clouds"] = [_plain(clouds[number].xyz) for number in full]
        if stream.type in ("TRANSFORM", "POSITION", "QTRANS"):
            found[f"{key} poses"] = _plain(stream.poses().matrices)
        if stream.type in ("TDATA", "QTDATA"):
            name = str(next(iter(stream)).content.elements["name"][0], "ascii").rstrip("\0")
            found[f"{key} poses"] = _plain(stream.poses(frame=name).matrices)
    assert len(found) > 60
    return found


def same(one: Path, two: Path) -> None:
    """Both give the same."""
    with igtl_gateway.open(one) as with_crc, igtl_gateway.open(two) as without:
        expected, found = read_all(with_crc), read_all(without)
    assert expected.keys() == found.keys()
    assert [key for key in expected if expected[key] != found[key]] == []


def test_python_reads_what_was_accepted(pair: tuple[Path, Path]) -> None:
    same(*pair)
    assert all(main(["verify", str(path)]) == 0 for path in pair)


def digests(folder: Path) -> dict[str, str]:
    if folder.suffix == ".mrb":
        with zipfile.ZipFile(folder) as bundle:
            members = {name: bundle.read(name) for name in bundle.namelist()}
        return {name: hashlib.sha256(data).hexdigest() for name, data in members.items() if not name.endswith(".mrml")}
    found = [folder] if folder.is_file() else sorted(path for path in folder.rglob("*") if path.is_file())
    found = [path for path in found if path.suffix != ".mrml"]  # it has name and digest of the recording
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_exports_have_what_was_accepted(
    pair: tuple[Path, Path], target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made, told = [], []
    globs = ["--streams", "IMAGE/Slice*", "--streams", "TRANSFORM/*"] if target in ("igs.mha", "seq.nrrd") else []
    for name, path in zip("ab", pair, strict=True):
        out = tmp_path / name / f"out{(TARGETS[target].suffixes or ('',))[0]}"
        out.parent.mkdir()
        code = main(["export", str(path), "--to", target, "-o", str(out), *globs])
        told.append((code, capsys.readouterr().out.replace(str(out), "OUT").replace(str(path), "FILE")))
        files = digests(out) if target not in ("rosbag2", "mcap") else {}
        made.append({name: digest for name, digest in files.items() if "Custom_raw" not in name})  # the bytes
    assert told[0] == told[1]
    assert made[0] == made[1]


def test_changed_copies_have_what_was_accepted(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, path in zip("ab", pair, strict=True):
        for verb, *words in (
            ("slice", "--start", "0.05"),
            ("deidentify", "--secret", str(tmp_path / "key")),
            ("recover",),
        ):
            if verb == "deidentify" and name == "a":
                (tmp_path / "key").write_bytes(bytes(range(32)))
                (tmp_path / "key").chmod(0o600)
            code = main([verb, str(path), "-o", str(tmp_path / f"{verb}-{name}.mcap"), *words])
            assert code == 0, capsys.readouterr().err
    for verb in ("slice", "recover"):
        same(tmp_path / f"{verb}-a.mcap", tmp_path / f"{verb}-b.mcap")
    poses = []
    for name in "ab":
        with igtl_gateway.open(tmp_path / f"deidentify-{name}.mcap") as recording:
            poses.append({key: len(stream) for key, stream in recording.items() if stream.type != "STATUS"})
    assert poses[0] == poses[1]


def test_a_merged_session_reads_each_part_as_it_was_recorded(pair: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "both.mcap"
    named = [f"{name}={path}" for name, path in zip("ab", pair, strict=True)]
    assert main(["merge", *named, "-o", str(out), "--offset", "b=0"]) in (0, 1)
    same(out / "a", out / "b")


@pytest.mark.parametrize("options", [{"split_s": 0.1}, {"snapshot_s": 100.0}], ids=["parts", "snapshot"])
def test_parts_and_snapshots_too(options: dict[str, Any], tmp_path: Path) -> None:
    made = []
    for name, zeroed in (("a", False), ("b", True)):
        (tmp_path / name).mkdir()
        record(tmp_path / name / "s.mcap", zeroed=zeroed, check_crc=not zeroed, **options)
        made.append(sorted((tmp_path / name).iterdir())[0])
    same(*made)
    if made[0].is_dir():
        last = [sorted(each.glob("*.mcap"), key=lambda path: (len(path.name), path.name))[-2] for each in made]
        with igtl_gateway.open(last[0]) as one, igtl_gateway.open(last[1]) as two:
            assert {key: len(each) for key, each in one.items()} == {key: len(each) for key, each in two.items()}


def test_a_session_that_checks_the_crc_has_nothing_of_them(tmp_path: Path) -> None:
    with igtl_gateway.open(record(tmp_path / "s.mcap", zeroed=True, check_crc=True)) as recording:
        with pytest.raises(ConfigError, match="without a pose in any of 20 messages"):
            recording[_POSE].poses()
        with pytest.raises(WireError):
            list(recording["STATUS/Arm"])


@pytest.mark.parametrize(("check_crc", "files"), [(False, 1), (True, 0)])
def test_the_black_box_looks_into_what_is_accepted(check_crc: bool, files: int, tmp_path: Path) -> None:
    rules = (trigger("status=Arm,after=0.1"),)
    record(tmp_path / "box.mcap", zeroed=True, check_crc=check_crc, snapshot_s=2.0, triggers=rules)
    assert len(list(tmp_path.glob("*.mcap"))) == files


def test_new_stamps_leave_a_crc_as_it_is() -> None:
    lenient = Acceptance(check_crc=False)
    for number, (_, data) in enumerate(_messages(zeroed=True)):
        moved = restamped(data, lambda stamp_ns: stamp_ns + NS if stamp_ns else 0, lenient)
        assert moved[CRC] == bytes(8), number
    changed = [
        lenient.message(restamped(data, lambda stamp_ns: stamp_ns + NS, lenient)).metadata
        for _, data in _messages(zeroed=True)
        if b"ros.stamp" in data
    ]
    assert [items[0].text for items in changed] == [str(START_NS + number + NS) for number in range(1, 20, 2)]
    sound = next(data for _, data in _messages(zeroed=False) if b"ros.stamp" in data)
    assert decode(restamped(sound, lambda stamp_ns: stamp_ns + NS)), "the CRC is right again"
