"""Merged sessions against planted clocks (``tools/evidence/merge_worlds.py``), their parts against the recordings."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

import igtl_gateway
from igtl_gateway.addons.merge import merging
from igtl_gateway.addons.merge.clock_graph import Clock
from igtl_gateway.addons.merge.merging import Source, merge
from igtl_gateway.addons.merge.offsets import ClockOffset, Contradiction, Piece
from igtl_gateway.app.verification import verify_parts
from igtl_gateway.base.errors import ConfigError, DamagedRecording, GatewayError, UnsupportedRecording
from igtl_gateway.convert.common_msgs import FrameTransform, PoseStamped, TFMessage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.dialogue.clocks import ask_note
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import Mark
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile import merged
from igtl_gateway.record.sessionfile.merged import Digest, Method
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.testing.gateway import ManualGateway
from tests.places import FIXTURES
from tests.replay.test_state_before import parts
from tests.tables import table
from tools.evidence.merge_worlds import World, judge, record

START_NS = 1_700_000_000 * 10**9
WORLD = World(seconds=4)
AHEAD = {"r1": ClockOffset(Method.GIVEN, (Piece(0, 1_700_000_000),))}

WORLDS = {
    "constant": WORLD,
    "behind": replace(WORLD, offsets_s=(0.0, -3600.0)),
    "drift": replace(WORLD, drifts_ppm=(0.0, 60.0), seconds=200, rate_hz=3),
    "asymmetric": replace(WORLD, delays_s=(0.2, 0.001)),
    "equal stamps": replace(WORLD, offsets_s=(0.0, 0.001), coarse_ns=1_000_000, delays_s=(0.002, 0.002)),
    "loss, duplicates, repetitions": replace(WORLD, loss=0.3, doubled=0.3, repeated=0.5),
    "clock set": replace(WORLD, step_s=5.0, seconds=8),
    "three": replace(WORLD, offsets_s=(0.0, 1.7, -2.0), drifts_ppm=(0.0,) * 3, pairs=((0, 1), (1, 2))),
    "five": replace(
        WORLD, offsets_s=(1.0, 1.7, -2.0, 0.1, 9.0), drifts_ppm=(0.0,) * 5, pairs=((0, 1), (1, 2), (0, 3), (2, 4))
    ),
}


@table("name", WORLDS)
def test_clocks_and_order_are_those_planted(name: str, tmp_path: Path) -> None:
    world = WORLDS[name]
    recordings = record(world, tmp_path, seed=1)
    out = tmp_path / "merged.mcap"
    facts = merge(recordings.sources, out, given={})
    found = judge(world, recordings, facts, out)
    if not world.step_s:  # between the last message before and the first one after, a set clock is unknown
        assert (found.outside, found.inverted, found.early) == ([], 0, 0)
    clocks = {part["name"]: part["clock"] for part in facts["parts"]}
    assert clocks["r1"]["is_drifting"] is (name == "drift")
    assert len(clocks["r1"]["chain"][0]) == (2 if world.step_s else 1)
    assert clocks["r0"]["method"] == "reference"
    for row in facts["latencies"]:
        planted = world.delays_s[row["from"] > row["to"]] * 1e3
        assert planted - 1e-5 * world.coarse_ns <= row["min_ms"] + row["error_ms"]
        assert abs(row["p50_ms"] - planted - 1.4) <= row["error_ms"] + 1 + 1e-6 * world.coarse_ns


def test_one_direction_is_a_bound(tmp_path: Path) -> None:
    world = replace(WORLD, one_way=True)
    facts = merge(record(world, tmp_path, 1).sources, tmp_path / "merged.mcap", given={})
    clock = facts["parts"][1]["clock"]
    assert (clock["method"], clock["low_s"]) == ("one_way", None)
    assert 1.7 <= clock["high_s"] <= 1.71
    assert facts["latencies"][0]["error_ms"] is None


def ask_each_other(folder: Path, offset_ns: int, ways: int, *, step_ns: int = 0) -> list[Source]:
    """Two gateways of which the first asks the second for its clock, or both ask; 2 ms there, 1 ms back."""
    sides = [ManualGateway(start_ns=START_NS), ManualGateway(start_ns=START_NS + offset_ns)]
    for side in sides:
        side.connect()

    def later(seconds: float) -> None:
        for side in sides:
            side.advance(seconds)

    for second in range(20):
        for asks, answers in ((0, 1), (1, 0))[:ways]:
            note = ask_note(report=False).pack()
            (question,) = sides[asks]._feed(Kind.EDGE_NOTE, (note,), links=(1,)).igtl()
            later(0.002)
            (answer,) = sides[answers].from_peer(question.data).igtl()
            later(0.001)
            sides[asks].from_peer(answer.data)
        later(1)
        if second == 10 and step_ns:
            sides[1].now_ns += step_ns
    for name, side in zip("ab", sides, strict=True):
        side.save(folder / f"{name}.mcap")
    return [Source("", folder / f"{name}.mcap") for name in "ab"]


@pytest.mark.parametrize("ways", [1, 2])
@pytest.mark.parametrize("offset_ns", [0, -(10**9) * 3600, 10**9])
def test_questions_for_the_clock_bound_the_offset_on_both_sides(tmp_path: Path, offset_ns: int, ways: int) -> None:
    facts = merge(ask_each_other(tmp_path, offset_ns, ways), tmp_path / "merged.mcap", given={})
    clock = facts["parts"][1]["clock"]
    assert clock["method"] == "both_ways"
    assert clock["low_s"] <= offset_ns / 1e9 <= clock["high_s"] <= clock["low_s"] + 0.003_001
    streams = {(row["from"], row["stream"]): row["min_ms"] for row in facts["latencies"]}
    assert {("a", "GET_STATUS/igtl_clock"), ("b", "STATUS/igtl_clock")} <= set(streams)
    assert verify_parts(tmp_path / "merged.mcap")[0].good


def test_a_clock_that_was_set_between_questions_has_two_pieces(tmp_path: Path) -> None:
    facts = merge(ask_each_other(tmp_path, 0, 1, step_ns=20_000_000), tmp_path / "merged.mcap", given={})
    (pieces,) = facts["parts"][1]["clock"]["chain"]
    assert len(pieces) == 2 and 0.017e9 < pieces[1][1] - pieces[0][1] < 0.023e9


def test_each_part_is_the_recording(tmp_path: Path) -> None:
    recordings = record(WORLD, tmp_path, 1)
    out = tmp_path / "merged.mcap"
    sources = [*recordings.sources, Source("", FIXTURES / "crtk.mcap")]
    merge(sources, out, given={"crtk": AHEAD["r1"]})
    for source in sources:
        assert _content(out / (source.name or "crtk")) == _content(source.path)
    with SessionFile.open(out) as file:
        times = [row[2] for _, _, row in file.messages()]
        assert file.foreign and file.skipped == ()
    assert times == sorted(times)
    assert [(result.good, result.outputs > 0) for result in verify_parts(out)[2:]] == [(True, True)]
    with AnyReader([out]) as reader:
        assert {topic.split("/")[1] for topic in reader.topics} == {"r0", "r1", "crtk"}
        assert sum(1 for _ in reader.messages()) == len(times)


def test_a_part_that_begins_midway_has_what_was_latched_before(tmp_path: Path) -> None:
    part = parts(tmp_path)[-1]
    out = tmp_path / "merged.mcap"
    merge([Source("star", FIXTURES / "star.mcap"), Source("part", part)], out, given={"part": AHEAD["r1"]})
    assert _content(out / "part") == _content(part), "taken out, it is the recording"
    assert all(result.good for result in verify_parts(out))
    with igtl_gateway.open(out) as recording, igtl_gateway.open(part) as alone:
        static = recording["/part/tf_static"]
        assert static.count == 1 and static.times[0] == alone.start_time - 1_700_000_000
        assert static.stamps[0] == alone["/tf_static"].stamps[0] - 1_700_000_000
        assert recording["/part/robot_description"].count == recording["/part/igtl/in/Navigation/status"].count == 1
        found = recording.tf.lookup("world", "tip", recording["/part/tf"].times[:1], unit="m")
        assert np.allclose(found[0, :3, 3], (1.9, 0, 0))
    with AnyReader([out]) as reader:
        topics = [connection.topic for connection, _, _ in reader.messages()]
    assert topics.count("/part/tf_static") == 1


def _content(path: Path) -> tuple[Any, ...]:
    with SessionFile.open(path) as file:
        messages = [
            (schema.name, schema.data, channel.topic, channel.metadata, *row[1:4], row[6][row[4] : row[5]])
            for schema, channel, row in file.messages()
            if schema
        ]
        return messages, list(file.attachments()), file.recorded_session, file.recorded_ledger, list(file.entries())


def test_numbers_of_a_part_in_several_attachments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merged, "NUMBERS", 7)
    recordings = record(replace(WORLD, seconds=1), tmp_path, 1)
    out = tmp_path / "merged.mcap"
    merge(recordings.sources, out, given={})
    for source in recordings.sources:
        assert _content(out / source.name) == _content(source.path)
    with out.open("rb") as stream:
        names = [each.name for each in make_reader(stream).iter_attachments()]
    for part in ("r0", "r1"):
        found = [name for name in names if name.startswith(merged.NUMBERS_OF.format(part))]
        assert len(found) > 2 and found == [f"numbers/{part}/{number}" for number in range(len(found))]


def test_warnings_of_a_part_have_a_bound(tmp_path: Path) -> None:
    source = crossing(tmp_path, ROS, ("/t", "/t"), 24)[0]
    writer = SessionWriter(source.path, {}, overwrite=True)
    seq = 0
    for number in range(103):
        for _ in range(2 if number == 5 else 1):
            seq += 1
            note = Note(Level.WARN, f"code_{number}", f"text {number}", "/t" if number % 2 else "")
            writer.write(Entry(seq, 1_700_000_000 * 10**9 + seq, Kind.NOTE, payload=(note.pack(),)))
    info = Note(Level.INFO, "quiet", "no warning")
    writer.write(Entry(seq + 1, 1_700_000_000 * 10**9 + seq + 1, Kind.NOTE, payload=(info.pack(),)))
    writer.close({})
    two = Source("two", FIXTURES / "crtk.mcap")
    reported = merge([source, two], tmp_path / "out.mcap", given={"two": AHEAD["r1"]})["reported"]
    lines = [line for line in reported if line.startswith("a: ")]
    assert len(lines) == 101
    assert (lines[0], lines[-1]) == ("a: /t, 2 times: text 5", "a: 3 more, as `info` of the part states them")
    assert "a: code_0: text 0" in lines and "a: /t: text 1" in lines


def test_merged_sessions_are_merged_again(tmp_path: Path) -> None:
    world = replace(WORLDS["three"], pairs=((0, 1), (0, 2)))
    recordings = record(world, tmp_path, 1)
    first, out = tmp_path / "first.mcap", tmp_path / "all.mcap"
    merge(recordings.sources[:2], first, given={})
    facts = merge([Source("", first), recordings.sources[2]], out, given={})
    assert [part["name"] for part in facts["parts"]] == ["r0", "r1", "r2"]
    found = judge(world, recordings, facts, out)
    assert (found.outside, found.inverted) == ([], 0)
    # what was given stays known, and nothing else joins them
    alone = record(replace(WORLD, pairs=()), tmp_path, 2).sources
    merge(alone, first, given=AHEAD, overwrite=True)
    again = merge(
        [Source("x", first), Source("crtk", FIXTURES / "crtk.mcap")], out, given={"crtk": AHEAD["r1"]}, overwrite=True
    )
    assert [(part["name"], part["clock"]["offset_s"]) for part in again["parts"]] == [
        ("x_r0", 0.0), ("x_r1", 1.7), ("crtk", 1.7),
    ]  # fmt: skip


@table(
    ("low_s", "high_s", "interval_ns"),
    [(1.5, 2.5, (5e8, 5e8)), (2.0, 2.0, (0.0, 0.0)), (None, 2.25, (math.inf, 2.5e8)), (1.75, None, (2.5e8, math.inf))],
)
@table("steps", [1, 2, 3])
def test_a_clock_that_a_merged_session_states_is_as_wide_as_it_states(
    low_s: float | None, high_s: float | None, interval_ns: tuple[float, float], steps: int
) -> None:
    """However many steps lead to it: merging again makes no clock wider."""
    chain = [[[START_NS, 10**9 // steps, 0.0]] for _ in range(steps)]
    part = {"name": "b", "clock": {"chain": chain, "offset_s": 2.0, "low_s": low_s, "high_s": high_s}}
    clock = merging._recorded_clock(part, Path("a"))
    assert clock.interval_ns == interval_ns
    assert len(clock.chain) == steps and clock.method is Method.GIVEN


@table(
    ("facts", "words"),
    [
        ({}, "part b: found a clock without 'chain'"),
        ({"chain": [[[0, 0, 0.0]]]}, "part b: found a clock without 'low_s'"),
        ({"chain": [[]], "offset_s": 2.0, "low_s": 1.0, "high_s": 3.0}, "found a clock without offset, expected one"),
    ],
)
def test_a_clock_that_lacks_something_is_damage(facts: dict[str, Any], words: str) -> None:
    with pytest.raises(DamagedRecording, match=words):
        merging._recorded_clock({"name": "b", "clock": facts}, Path("a"))


@pytest.mark.parametrize("end_s", [None, 0, 3])
def test_a_mark_moves_with_its_clock_and_a_moment_stays_one(end_s: int | None) -> None:
    clock = Clock((ClockOffset(Method.GIVEN, (Piece(START_NS, 1_700_000_000),)),))
    end_ns = None if end_s is None else START_NS + end_s * 10**9
    found = merging._moved(Mark("a", "text", "who", START_NS, end_ns), clock)
    assert (found.label, found.text, found.who, found.time_ns) == ("a", "text", "who", START_NS - 1_700_000_000)
    assert found.end_ns == (None if end_ns is None else end_ns - 1_700_000_000)


def test_an_empty_recording(tmp_path: Path) -> None:
    recordings = record(replace(WORLD, seconds=0.1, rate_hz=1), tmp_path, 1)
    out = tmp_path / "merged.mcap"
    with pytest.raises(GatewayError, match=r"r1: found no message that crosses .* --offset r1=SECONDS"):
        merge(recordings.sources, out, given={})
    assert not out.exists()
    assert merge(recordings.sources, out, given=AHEAD)["messages"] == 0
    with SessionFile.open(out / "r1") as part:
        assert list(part.entries()) == []


def crossing(folder: Path, kinds: tuple[Kind, Kind], channels: tuple[str, str], size: int) -> list[Source]:
    """Two recordings: what one sends, the other one receives a millisecond later."""
    sources = []
    for name, kind, channel, later_ns in zip("ab", kinds, channels, (0, 10**6), strict=True):
        path = folder / f"{name}.mcap"
        writer = SessionWriter(path, {}, overwrite=True)
        for seq in range(1, 41):
            stamp_ns, data = 1_700_000_000 * 10**9 + seq * 10**7 + later_ns, seq.to_bytes(4, "little") + bytes(size - 4)
            kind_of_ros = "std_msgs/msg/String" if channel.startswith("/") else "STRING"
            writer.write(Entry(seq, stamp_ns, kind, channel, kind_of_ros, (data,)))
        writer.close({})
        sources.append(Source(name, path))
    return sources


ROS, IGTL = (Kind.ROS_OUT, Kind.ROS_IN), (Kind.IGTL_OUT, Kind.IGTL_IN)


@table(
    ("kinds", "channels", "size", "crosses"),
    [
        (ROS, ("/t", "/t"), 24, True),
        (ROS, ("/t", "/t"), 23, False),  # such as an Empty or a Bool: equal by coincidence
        (ROS, ("/t", "/there/t"), 24, True),  # in a namespace there ...
        (ROS, ("/there/t", "/t"), 24, True),  # ... or here
        (ROS, ("/t", "/other"), 24, False),
        (IGTL, ("STRING/D", "STRING/D"), 59, True),
        (IGTL, ("STRING/D", "STRING/D"), 58, False),  # a header alone
        (IGTL, ("STRING/D", "STRING/ED"), 59, False),  # devices have no namespaces
        ((Kind.ROS_OUT, Kind.IGTL_IN), ("/t", "STRING/t"), 59, False),
        ((Kind.ROS_IN, Kind.ROS_IN), ("/t", "/t"), 24, False),  # a third program sent it to both
    ],
)
def test_what_crosses(
    kinds: tuple[Kind, Kind], channels: tuple[str, str], size: int, crosses: bool, tmp_path: Path
) -> None:
    sources, out = crossing(tmp_path, kinds, channels, size), tmp_path / "merged.mcap"
    if not crosses:
        with pytest.raises(GatewayError, match="b: found no message that crosses between it and a"):
            merge(sources, out, given={})
        return
    facts = merge(sources, out, given={})
    (row,) = facts["latencies"]
    assert (row["from"], row["to"], row["stream"], row["received_as"]) == ("a", "b", *channels)
    assert facts["parts"][1]["clock"]["method"] == "one_way"


def test_refusals(tmp_path: Path) -> None:
    recordings = record(WORLD, tmp_path, 1)
    one, two = recordings.sources
    copy = Source("copy", Path(shutil.copy(one.path, tmp_path / "copy.mcap")))
    cut = Source("cut", tmp_path / "cut.mcap")
    cut.path.write_bytes(two.path.read_bytes()[:-500])
    cases: list[tuple[list[Source], dict[str, ClockOffset], type[Exception], str]] = [
        ([one, copy], {}, ConfigError, "copy.mcap: found the same recording as .*r0.mcap"),
        ([one, one], {}, ConfigError, "found the same recording"),
        ([one], {}, ConfigError, "found 1 recording, expected two or more"),
        ([one, cut], {}, DamagedRecording, "was cut off after .* igtl-gateway recover"),
        ([one, Source("", tmp_path / "none.mcap")], {}, UnsupportedRecording, "No such file"),
        ([one, two], {"r0": AHEAD["r1"]}, ConfigError, "offset of 'r0': found no such part, expected one of r1"),
        ([one, two], {"r1": ClockOffset(Method.GIVEN, (Piece(0, 1 << 62),))}, GatewayError, "out of all calendars"),
    ]
    for sources, given, error, text in cases:
        target = tmp_path / "out.mcap"
        with pytest.raises(error, match=text):
            merge(sources, target, given=given)
        assert not target.exists()


def test_a_contradiction_names_both_parts_and_the_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = record(WORLD, tmp_path, 1)

    def measure(*_: object) -> ClockOffset:
        raise Contradiction("found messages that no clock explains")

    monkeypatch.setattr(merging, "measure_offset", measure)
    with pytest.raises(GatewayError, match=r"^r0, r1: found messages that .*; state the offset: --offset r1=SECONDS$"):
        merge(recordings.sources, tmp_path / "out.mcap", given={})
    assert not (tmp_path / "out.mcap").exists()
    assert merge(recordings.sources, tmp_path / "out.mcap", given=AHEAD)["messages"] > 0, "nothing is measured"


def test_a_changed_part_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = record(replace(WORLD, seconds=1), tmp_path, 1)
    out = tmp_path / "merged.mcap"
    with monkeypatch.context() as patched:
        patched.setattr(Digest, "finish", lambda *_: "0" * 64)
        merge(recordings.sources, out, given={})
    with pytest.raises(DamagedRecording, match=r"part r1: found digest [0-9a-f]{64}, expected 0{64}"):
        SessionFile.open(out / "r1")
    with monkeypatch.context() as patched:
        patched.setattr("igtl_gateway.addons.merge.merging.topic_token", lambda _name: "../r1")
        merge(recordings.sources, out, given={"../r1_2": AHEAD["r1"]}, overwrite=True)
    with pytest.raises(DamagedRecording, match=r'name: found "\.\./r1", expected letters, digits and _'):
        SessionFile.open(out)
    merge(recordings.sources, out, given={}, overwrite=True)
    with pytest.raises(UnsupportedRecording, match="found no part 'other', expected one of r0, r1"):
        SessionFile.open(out / "other")


SECOND, MOVING_M_S = 10**9, 0.1


def moving(path: Path, ahead_ns: int, *, drift: float = 0.0) -> Path:
    """A pose and a frame that move 100 mm/s, recorded by a host whose clock, like those of its senders, is ahead."""
    writer, seq = SessionWriter(path, {}), 0
    for number in range(300):
        true_ns = 1_700_000_000 * SECOND + number * SECOND // 50
        stamp_ns = true_ns + ahead_ns + round(drift * number * SECOND / 50)
        x = MOVING_M_S * number / 50
        header, pose = Header(stamp_ns, "base"), (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        for topic, name, data in (
            ("/pose", PoseStamped.TYPE, PoseStamped(header, pose).pack()),
            ("/tf", TFMessage.TYPE, TFMessage((FrameTransform(header, path.stem, pose),)).pack()),
        ):
            seq += 1
            writer.write(Entry(seq, stamp_ns + 10**6 + (seq % 2 == 0), Kind.ROS_IN, topic, name, (data,), (), stamp_ns))
    writer.close({})
    return path


@pytest.mark.parametrize(("ahead_ns", "drift"), [(3 * SECOND, 0.0), (-3 * SECOND, 0.0), (3 * SECOND, 1e-4)])
def test_all_stamps_have_the_clock_of_the_reference(tmp_path: Path, ahead_ns: int, drift: float) -> None:
    """Poses of two recorders at the time of each are one pose: by stamps of any reader."""
    one, two = moving(tmp_path / "one.mcap", 0), moving(tmp_path / "two.mcap", ahead_ns, drift=drift)
    begin_ns = 1_700_000_000 * SECOND + ahead_ns
    given = {"two": ClockOffset(Method.GIVEN, (Piece(begin_ns, ahead_ns, drift * SECOND),))}
    out = tmp_path / "both.mcap"
    merge([Source("", one), Source("", two)], out, given=given)
    off_m = 2e-4 if drift else 1e-6
    with out.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(topics=["/one/pose", "/two/pose"]):
            x = PoseStamped.unpack(message.data).pose[0]
            assert abs(x - MOVING_M_S * (message.publish_time / SECOND - 1_700_000_000)) < off_m + 1e-6, channel.topic
    with igtl_gateway.open(out) as recording:
        first, second = recording["/one/pose"], recording["/two/pose"]
        for stamps in (second.stamps, second.poses().stamps, second.source_times):
            assert np.abs(stamps - first.stamps).max() < SECOND // 1000
        aligned = igtl_gateway.align([second], on=first, method="interpolate")
        assert aligned.notes == ()
        off = aligned.poses("/two/pose").positions[:, 0] - aligned.poses("/one/pose").positions[:, 0]
        assert np.nanmax(np.abs(off)) < off_m and np.isfinite(off).sum() > 290
        between = recording.tf.lookup("one", "two", first, out_of_range="nan")[:, 0, 3]
        assert np.nanmax(np.abs(between)) < off_m and np.isfinite(between).sum() > 290
        assert first.to_arrow()["header.stamp_ns"].to_pylist() == first.stamps.tolist()
    with SessionFile.open(out / "two") as part, SessionFile.open(two) as file:  # as it was recorded
        assert list(part.entries()) == list(file.entries())
