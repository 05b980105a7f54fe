"""Identifiers in places that the walk over one session does not reach: every ROS type, pictures, parts, prologue."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

from igtl_gateway.addons.deidentify.context import Context, Removed
from igtl_gateway.addons.deidentify.messages import _RULES, MessageCleaner
from igtl_gateway.addons.deidentify.pixels import PixelCleaner
from igtl_gateway.addons.deidentify.profile import BASIC
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.addons.deidentify.ros import _DATA, RosCleaner
from igtl_gateway.addons.deidentify.rules import OPTIONS, RULES, Action
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.cli import main
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import String
from tests.addons.deidentify.planted import MARK, SOURCE, all_bytes, found, planted_session, ros_store

TEXT = MARK.encode()
_EIGHT = ("uint8", "int8", "byte", "char", "octet")


def _value(store: Any, owner: str, field: str, kind: Any, inner: Any, depth: int) -> Any:
    if kind == Nodetype.NAME:
        return planted_message(store, inner, depth + 1)
    if kind == Nodetype.BASE:
        if inner[0] in ("string", "wstring"):
            return MARK
        return inner[0] == "bool" if inner[0] == "bool" else 0.0 if inner[0].startswith("float") else 1
    (each_kind, each), length = inner
    count = length if kind == Nodetype.ARRAY else int(depth < 6)
    if each_kind == Nodetype.BASE and each[0] not in ("string", "wstring"):
        name = {"octet": "uint8", "byte": "uint8", "char": "uint8", "bool": "bool"}.get(each[0], each[0])
        if each[0] in _EIGHT and (owner, field) not in _DATA:
            data = np.frombuffer(TEXT[: count if kind == Nodetype.ARRAY else None].ljust(count, b"x"), np.uint8)
            return data.astype(name)
        return np.zeros(0 if (owner, field) in _DATA and kind != Nodetype.ARRAY else count, name)
    return [_value(store, owner, field, each_kind, each, depth) for _ in range(count)]


def planted_message(store: Any, name: str, depth: int = 0) -> Any:
    """Return a message with the identifier in every string and in every array of bytes that is not a picture."""
    given = {field: _value(store, name, field, kind, inner, depth) for field, (kind, inner) in store.fielddefs[name][1]}
    return store.types[name](**{str(getattr(key, "name", key)): value for key, value in given.items()})


def test_every_type_of_openigtlink_has_a_rule() -> None:
    assert [codec for codec in BODIES.values() if codec not in _RULES and not issubclass(codec, Elements)] == []


def test_a_type_without_a_rule_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new type has strings until it has a rule; before, it was written unchanged."""

    @dataclass(frozen=True)
    class Note(String):
        PROTOCOL = "x"

    monkeypatch.setitem(BODIES, "NOTE", Note)
    data = join(encode(Message("NOTE", "A", Note.of(MARK))))
    assert TEXT in data
    for kept, allowed in (((), False), (("NOTE",), True)):
        context = Context.of(replace(BASIC, keep_types=kept), bytes(32), None)
        cleaner = MessageCleaner(context)
        if allowed:
            assert TEXT in cleaner.clean(data, "NOTE/A") and context.report.rules["kept type"] == 1
        else:
            with pytest.raises(Removed, match="type"):
                cleaner.clean(data, "NOTE/A")


def test_every_type_of_ros() -> None:
    store, context = ros_store(), Context.of(BASIC, bytes(32), None)
    cleaner = RosCleaner(context, MessageCleaner(context), {})
    names = sorted(name for name in store.fielddefs if "/msg/" in name)
    cleaned = removed = 0
    for name in names:
        data = bytes(store.serialize_cdr(planted_message(store, name), name))
        try:
            new = cleaner.clean(name, data, "/topic")
        except Removed as reason:
            assert reason.rule in ("bytes", "place", "type", "pixels", "damaged", "metadata"), name
            removed += 1
            continue
        cleaned += 1
        for at in range(len(TEXT) - 5):
            assert TEXT[at : at + 6] not in new, name
    assert cleaned > 150 and removed < 30


def _segment(marker: int, data: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", 2 + len(data)) + data


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


_START = b"\0\0\0\1"
_JPEG = b"".join((
    b"\xff\xd8", _segment(0xE1, b"Exif\0\0" + TEXT), _segment(0xE2, TEXT), _segment(0xED, TEXT),
    _segment(0xEE, b"Adobe\0\x64\0\0\0\0\1" + TEXT), _segment(0xFE, TEXT),
    _segment(0xE0, b"JFIF\0\1\1\0\0\1\0\1\0\0" + TEXT), _segment(0xDB, bytes(65)), _segment(0xDA, b"\1\1\0\0\x3f\0"),
    b"\x12\x34\xff\xd9", TEXT,
))  # fmt: skip
_PNG = b"".join((
    b"\x89PNG\r\n\x1a\n", _chunk(b"IHDR", bytes(13)), _chunk(b"tEXt", TEXT), _chunk(b"zTXt", b"a\0\0" + TEXT),
    _chunk(b"iTXt", TEXT), _chunk(b"eXIf", TEXT), _chunk(b"tIME", TEXT), _chunk(b"iCCP", TEXT), _chunk(b"prVt", TEXT),
    _chunk(b"IDAT", zlib.compress(b"\0\0")), _chunk(b"IEND", b""), TEXT,
))  # fmt: skip
_H264 = b"".join((
    TEXT, _START, b"\x67\x42\x1e", _START, b"\x06\x05" + TEXT + b"\x80", _START, b"\x0c" + TEXT, _START, b"\x18" + TEXT,
    _START, b"\x00" + TEXT, _START, b"\x65\x88\x84",
))  # fmt: skip
_H265 = b"".join((
    TEXT, _START, b"\x40\x01\x0c", _START, b"\x4e\x01" + TEXT, _START, b"\x50\x01" + TEXT, _START, b"\x4c\x01" + TEXT,
    _START, b"\x60\x01" + TEXT, _START, b"\x26\x01\xaf",
))  # fmt: skip
_AV1 = bytes([0x12, 0, 0x2A, 1 + len(TEXT), 4]) + TEXT + bytes([0x7A, len(TEXT)]) + TEXT + b"\x32\x02\x10\x80"
PICTURES = {"jpeg": _JPEG, "png": _PNG, "h264": _H264, "h265": _H265, "av1": _AV1}


@pytest.mark.parametrize("form", PICTURES)
def test_text_beside_the_picture(form: str) -> None:
    report = Report()
    new = PixelCleaner(BASIC, report).compressed(form, PICTURES[form], "/camera")
    assert new and TEXT not in new
    assert report.rules["picture data"] == 1
    assert PixelCleaner(BASIC, Report()).compressed(form, new, "/camera") == new
    for cut in range(len(PICTURES[form])):
        part = PixelCleaner(BASIC, Report()).compressed(form, PICTURES[form][:cut], "/camera")
        assert part is None or TEXT[:6] not in part, cut


@pytest.mark.slow
def test_a_sealed_recording_with_a_prologue_by_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / MARK
    folder.mkdir()
    source, sealed, out = folder / f"{MARK}.mcap", folder / f"{MARK}_sealed.mcap", tmp_path / "clean.mcap"
    planted_session(source, prologue=True)
    assert any(b"prologue.mcap" in data for data in all_bytes(source))
    key, secret = tmp_path / "key", tmp_path / "study.key"
    secret.write_bytes(bytes(range(64, 96)))
    assert main(["keys", "new", str(key)]) == 0
    assert main(["seal", str(source), "--key", str(key), "-o", str(sealed)]) == 0
    assert found(sealed)
    before = sorted(tmp_path.rglob("*"))
    capsys.readouterr()
    assert main(["deidentify", str(sealed), "-o", str(out), "--secret", str(secret), "--json"]) == 0
    report = capsys.readouterr()
    assert MARK not in report.out + report.err
    assert sorted(tmp_path.rglob("*")) == sorted([*before, out])
    assert found(out) == []
    assert main(["verify", str(out)]) == 0
    capsys.readouterr()
    assert main(["verify", str(sealed), "--seal", "--json"]) == 0
    digest = json.loads(capsys.readouterr().out)["parts"][0]["last_seal"]
    everything = b"".join(all_bytes(out))
    assert digest.encode() in everything
    assert b"igtl_gateway.seal" not in everything
    for form in (secret.read_bytes(), secret.read_bytes().hex().encode(), base64.b64encode(secret.read_bytes())):
        assert form not in everything


def test_the_command_line_says_what_diff_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With names and times kept, ``diff`` names the streams of the report, and no other one.

    A body without its extended header gets one: other bytes, which the report shows, with an equal content.
    """
    profile, out = tmp_path / "profile.toml", tmp_path / "clean.mcap"
    profile.write_text('[keep]\nnames = ["**"]\ntypes = ["**"]\n')
    words = ["deidentify", str(SOURCE), "-o", str(out), "--profile", str(profile), "--keep-times", "--json"]
    assert main(words) == 0
    report = json.loads(capsys.readouterr().out)
    named = {name for name in report["streams"].keys() | report["removed"].keys() if name != "notes"}
    main(["diff", str(SOURCE), str(out), "--json"])
    result = json.loads(capsys.readouterr().out)
    differing = {
        row["stream"] for row in result["streams"] if row["kind"] in ("igtl_in", "ros_in") and not row["equal"]
    }
    assert differing | {"TRANSFORM/Bare"} == named


def test_several_sessions_of_a_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secrets = [tmp_path / name for name in ("study", "other")]
    for secret, content in zip(secrets, (b"s" * 16, b"o" * 40), strict=True):
        secret.write_bytes(content)
    names: dict[tuple[str, str], set[str]] = {}
    for secret in secrets:
        for turn in range(2):
            out = tmp_path / f"{secret.name}-{turn}.mcap"
            source = SOURCE.with_name("acquisition.mcap")
            assert main(["deidentify", str(source), "-o", str(out), "--secret", str(secret)]) == 0
            capsys.readouterr()
            assert main(["info", str(out), "--json"]) == 0
            info = json.loads(capsys.readouterr().out)
            names[secret.name, str(turn)] = {row["stream"] for row in info["streams"]}
    assert names["study", "0"] == names["study", "1"]
    common = names["study", "0"] & names["other", "0"]
    assert all(name.startswith("/igtl/links") or name in ("", "/igtl_gateway/notes") for name in common), common


def test_parts_of_a_split_recording_become_one_file(tmp_path: Path) -> None:
    source, options = tmp_path / "planted.mcap", RecordOptions(split_bytes=20_000, chunk_bytes=5_000)
    planted_session(source)
    with SessionFile.open(source) as file:
        entries, facts = list(islice(file.entries(), 150)), file.session
    recorder = Recorder(
        tmp_path / f"{MARK}.mcap", facts, qos_of=lambda *_: None, on_note=lambda _: None, clock=ManualClock(),
        host=in_thread, options=options,
    )  # fmt: skip
    for entry in entries:
        recorder(entry)
    recorder.close({})
    folder, out = tmp_path / MARK, tmp_path / "clean.mcap"
    assert len(list(folder.glob("*.mcap"))) > 2
    assert main(["deidentify", str(folder), "-o", str(out)]) == 0
    assert main(["verify", str(out)]) == 0
    assert found(out) == []


#: Rules, in the order of the report, where programs read their names, and the option of DICOM that asks for each.
NAMES = {
    "patient": "113100", "name": "113105", "text": "113104", "metadata": "113104", "padding": "113100",
    "type": "113100", "kept type": "113111", "bytes": "113100", "place": "113100", "damaged": "113100",
    "pixels": "113101", "picture data": "113101", "address": "113100", "note": "113104", "setting": "113105",
    "session": "113100", "time": "113107",
}  # fmt: skip


def test_each_rule_has_its_name_and_its_option() -> None:
    assert [(name, rule.name, rule.option) for name, rule in RULES.items()] == [
        (name, name, option) for name, option in NAMES.items()
    ]
    for rule in RULES.values():
        assert isinstance(rule.action, Action) and rule.option in OPTIONS
        assert rule.place not in NAMES and rule.what not in NAMES and rule.place != rule.what
