"""The golden recordings: what they promise, and that this version still computes the same."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from igtl_gateway.base.version import __version__
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.igtl_msgs import CommandReply, LinkStatusList
from igtl_gateway.convert.profiles import BY_NAME
from igtl_gateway.convert.table import TO_IGTL, TO_ROS
from igtl_gateway.convert.units import UNITS
from igtl_gateway.gateway import LINKS_TOPIC
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Header, decode
from igtl_gateway.wire.query import QUERIES
from igtl_gateway.wire.registry import BODIES
from tests.places import FIXTURES
from tests.tables import table
from tools.fixtures import Recipe, difference, made_by, make, packs_alike, recipes

NAMES = ("star", "paper-types", "every-type", "acquisition", "lego", "ultrasound", "crtk", "brain")
RECIPES = recipes()


def entries(name: str) -> list[Entry]:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        return list(file.entries())


@pytest.fixture(scope="module")
def star() -> list[Entry]:
    return entries("star")


@pytest.fixture(scope="module")
def every_type() -> list[Entry]:
    return entries("every-type")


def caused(log: list[Entry]) -> Iterator[tuple[Entry, Entry]]:
    """Each output with the input that caused it: outputs follow their cause."""
    cause = log[0]
    for entry in log:
        if entry.kind.is_input:
            cause = entry
        else:
            yield cause, entry


@table("name", NAMES)
def test_todays_gateway_says_the_same_byte_for_byte(name: str) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        report = verify(file.entries(), Config.from_dict(json.loads(file.session["config"])))
    assert report.good, report.differences[0]
    assert report.equal == report.outputs > 0


def test_verify_names_the_field_when_a_converter_constant_changes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from igtl_gateway.cli import main

    path = str(FIXTURES / "paper-types.mcap")
    assert main(("verify", path)) == 0
    capsys.readouterr()
    monkeypatch.setitem(UNITS, "mm", 1001)
    assert main(("verify", path)) == 1
    told = capsys.readouterr().out
    assert "DIFFERENT" in told and re.search(r"(translation|content|points?)\S*: recorded \S+, computed ", told), told


@table("name", NAMES)
def test_they_are_labelled_synthetic(name: str) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        assert "no robot" in file.session["synthetic"]


def test_there_is_a_recipe_for_each() -> None:
    assert tuple(recipe.name for recipe in RECIPES) == NAMES
    assert {path.stem for path in FIXTURES.glob("*.mcap")} == set(NAMES)


@pytest.mark.parametrize("recipe", RECIPES, ids=[recipe.name for recipe in RECIPES])
def test_they_are_what_their_commands_make_today(recipe: Recipe, tmp_path: Path) -> None:
    """Record by record, before compression; and as files, where the same zstandard packs them."""
    committed = FIXTURES / f"{recipe.name}.mcap"
    made = make(recipe, tmp_path, made_by(committed))
    found = difference(committed, made)
    assert not found, f"{found}\nTo renew: make fixtures"
    if packs_alike():
        alike = made.read_bytes() == committed.read_bytes()  # without pytest's account of all bytes
        assert alike


def test_a_recording_states_the_version_that_made_it(tmp_path: Path) -> None:
    (recipe,) = (each for each in RECIPES if each.name == "acquisition")
    assert [made_by(make(recipe, tmp_path, version)) for version in ("0.0.9", __version__)] == ["0.0.9", __version__]
    found = difference(make(recipe, tmp_path, "0.0.9"), FIXTURES / "acquisition.mcap")
    assert found.startswith("record 0: Header: ") and "0.0.9" in found


def test_another_packing_is_no_difference_and_another_field_is(tmp_path: Path) -> None:
    log = entries("acquisition")
    last = log.pop()
    files: list[Path] = []
    for compression, end in (("zstd", last), ("lz4", last), ("zstd", replace(last, source_ns=7))):
        files.append(tmp_path / f"{len(files)}.mcap")
        writer = SessionWriter(files[-1], {}, compression=compression)  # type: ignore[arg-type]
        for entry in (*log, end):
            writer.write(entry)
        writer.close({})
    packed, otherwise, changed = files
    assert packed.read_bytes() != otherwise.read_bytes()
    assert difference(packed, otherwise) == ""
    assert "Message: was " in difference(packed, changed)


def test_paper_types_use_the_types_of_the_paper() -> None:
    log = entries("paper-types")
    types = {"STRING", "TRANSFORM", "IMAGE", "POINT", "POLYDATA"}
    assert types < {e.type for e in log if e.kind is Kind.IGTL_IN}
    assert types < {e.type for e in log if e.kind is Kind.IGTL_OUT}


def test_every_type_is_small() -> None:
    assert (FIXTURES / "every-type.mcap").stat().st_size < 640_000


def test_every_row_of_the_conversion_table_is_used(every_type: list[Entry]) -> None:
    to_ros = {
        (cause.type, out.channel if out.channel == "/tf" else out.channel.rpartition("/")[2], out.type)
        for cause, out in caused(every_type)
        if out.kind is Kind.ROS_OUT
    }
    rows = {(name, row.topic or row.kind, row.message.TYPE) for row in TO_ROS for name in row.igtl_types}
    assert rows - to_ros == set()
    to_igtl = {
        (cause.type, out.type)
        for cause, out in caused(every_type)
        if cause.kind is Kind.ROS_IN and out.kind is Kind.IGTL_OUT
    }
    assert {(row.message.TYPE, row.igtl_type) for row in TO_IGTL} - to_igtl == set()


def test_every_type_of_the_protocol_comes_in_and_queries_of_every_content_go_out(every_type: list[Entry]) -> None:
    assert set(BODIES) - {e.type for e in every_type if e.kind is Kind.IGTL_IN} == set()
    sent = {e.type for e in every_type if e.kind is Kind.IGTL_OUT}
    assert {(name[:3], QUERIES[name]) for name in sent & set(QUERIES)} == {
        (name[:3], content) for name, content in QUERIES.items()
    }
    assert {"GET_TRANS", "GET_CAPABIL", "GET_VMETA"} <= sent, "the shortened names"


def test_every_kind_of_peer_is_there_and_gets_nothing_that_it_must_not_have(every_type: list[Entry]) -> None:
    seen: dict[int, str] = {}
    asked: set[int] = set()  # for tracking data, which 3D Slicer gets in no other case
    for entry in every_type:
        if entry.kind is Kind.IGTL_IN and entry.type in ("GET_TDATA", "STT_TDATA"):
            asked |= set(entry.links)
        if entry.channel == LINKS_TOPIC:
            seen |= {status.link: status.profile for status in LinkStatusList.unpack(entry.data()).links}
        if entry.kind is Kind.IGTL_OUT:
            version = Header.unpack(entry.data()).version
            for link in entry.links:
                profile = BY_NAME[seen.get(link, "default")]
                may_send = profile.may_send(entry.type) or (entry.type == "TDATA" and link in asked)
                assert may_send and version <= profile.max_version, (entry.seq, profile.name)
    assert set(seen.values()) == set(BY_NAME) - {"plus-v1"}  # younger than the recording


def test_ticks_give_up_commands_and_ping(every_type: list[Entry]) -> None:
    ticks = [out for cause, out in caused(every_type) if cause.kind is Kind.EDGE_NOTE]
    replies = [CommandReply.unpack(out.data()) for out in ticks if out.kind is Kind.ROS_OUT]
    assert {reply.status for reply in replies} == {CommandReply.TIMEOUT}
    assert {out.type for out in ticks if out.kind is Kind.IGTL_OUT} == {"GET_STATUS", "RTS_COMMAND"}


def test_nothing_was_lost_to_a_defect(every_type: list[Entry]) -> None:
    notes = Counter(Note.unpack(entry.data()).code for entry in every_type if entry.kind is Kind.NOTE)
    assert not notes["internal_error"]
    refusals = ("bad_crc", "malformed", "truncated", "conversion", "command_refused", "stream_refused", "empty")
    assert all(notes[code] for code in refusals), "what is refused is guarded too"


def test_star_is_small_long_and_has_enough_clouds(star: list[Entry]) -> None:
    assert (FIXTURES / "star.mcap").stat().st_size <= 10_000_000
    inputs = Counter(entry.channel for entry in star if entry.kind is Kind.ROS_IN)
    clouds = [entry for entry in star if entry.channel == "/star/cloud"]
    assert len(clouds) >= 10
    assert clouds[-1].stamp_ns - clouds[0].stamp_ns >= 10_000_000_000
    span_s = (star[-1].stamp_ns - star[0].stamp_ns) / 1e9
    assert span_s >= 10
    assert inputs["/star/tool"] / 12 == pytest.approx(100, rel=0.02)
    for topic in ("/star/camera/image", "/star/nir_markers", "/star/plan", "/star/plan_points", "/star/status"):
        assert inputs[topic] >= 1, topic


def test_star_clouds_are_organised_coloured_and_have_holes(star: list[Entry]) -> None:
    entry = next(entry for entry in star if entry.channel == "/star/cloud")
    cloud = rosmsg.PointCloud2.unpack(entry.data())
    assert (cloud.width, cloud.height) == (200, 150)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb"]
    depth = np.frombuffer(cloud.data, "<f4").reshape(-1, 4)[:, 2]
    assert 0.05 < np.isnan(depth).mean() < 0.4
    assert 0.2 < np.nanmedian(depth) < 0.3


def test_star_holds_both_sides(star: list[Entry]) -> None:
    out = Counter(entry.channel for entry in star if entry.kind is Kind.IGTL_OUT)
    assert out["POLYDATA/TissueCloud"] >= 10 and out["TRANSFORM/ToolToBase"] >= 1000
    cloud = decode(next(e for e in star if e.channel == "POLYDATA/TissueCloud").data())
    points = cloud.content.describe()["num_points"]
    assert 20_000 < points < 30_000
    assert any(entry.kind is Kind.IGTL_IN for entry in star)
    assert any(entry.kind is Kind.ROS_OUT for entry in star)


#: ``pymcap-cli doctor`` for several files: its start takes longer than its judgement.
JUDGE = """
import sys
from pymcap_cli.cmd.doctor_cmd import doctor
print("wrong:", *[file for file in sys.argv[1:] if doctor(file) != 0])
"""


def test_an_independent_judge_finds_no_error(tmp_path: Path) -> None:
    copies = [Path(shutil.copy(FIXTURES / f"{name}.mcap", tmp_path)) for name in NAMES]
    bent = tmp_path / "bent.mcap"  # and would find one
    data = bytearray(copies[0].read_bytes())
    data[len(data) // 2] ^= 1
    bent.write_bytes(data)
    told = subprocess.run([sys.executable, "-c", JUDGE, *copies, bent], capture_output=True, text=True, check=False)
    assert told.stdout.splitlines()[-1] == f"wrong: {bent}", told.stdout + told.stderr


def test_rosbags_reads_every_type_and_writes_what_we_wrote(every_type: list[Entry]) -> None:
    with AnyReader([FIXTURES / "every-type.mcap"]) as reader:
        for entry, (connection, _, data) in zip(every_type, reader.messages(), strict=True):
            message = reader.deserialize(data, connection.msgtype)
            if entry.kind in (Kind.ROS_IN, Kind.ROS_OUT):
                assert connection.topic == entry.channel
                assert bytes(reader.typestore.serialize_cdr(message, connection.msgtype)) == bytes(data), entry.type


def test_mcap_ros2_support_decodes_every_type(every_type: list[Entry]) -> None:
    with (FIXTURES / "every-type.mcap").open("rb") as stream:
        decoded = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        assert [message.sequence for _, _, message, _ in decoded] == [entry.seq for entry in every_type]
