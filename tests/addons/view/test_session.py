"""The view of a session besides its messages: times, gaps, drops, links, rates, types that are not drawn."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.blueprints import NAMES, blueprint
from igtl_gateway.convert.igtl_msgs import Metadata, MetadataItem, PolyData
from igtl_gateway.convert.rosmsg import Header, Mesh, String, TransformStamped
from igtl_gateway.gateway import TICK
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.places import FIXTURES

from .conftest import START_NS, STEP_NS, Draw, messages, without_time

SECOND = 1_000_000_000


@dataclass
class Odd:
    """An unknown type."""

    TYPE: ClassVar[str] = "odd_msgs/msg/Odd"

    def pack(self) -> bytes:
        return b"\0\1\0\0odd"


def text(seq: int, stamp_ns: int, said: str = "hello", **more: Any) -> Entry:
    return Entry(seq, stamp_ns, Kind.ROS_IN, "/text", String.TYPE, (String(said).pack(),), **more)


def note(seq: int, kind: Kind, said: Note, links: tuple[int, ...] = ()) -> Entry:
    return Entry(seq, START_NS + seq * STEP_NS, kind, payload=(said.pack(),), links=links)


def test_rows_carry_gateway_time_entry_number_and_the_senders_time_where_set(draw: Draw) -> None:
    stamped = text(8, START_NS + 8_000, source_ns=START_NS + 1_000)
    first, second = draw(entries=[text(7, START_NS), stamped]).rows("text")
    assert (first["entry"], second["entry"]) == (7, 8)
    assert first["gateway_time"] == START_NS
    assert second["gateway_time"] == START_NS + 8_000
    assert "sender_time" not in first
    assert second["sender_time"] == START_NS + 1_000


def test_a_type_without_picture_is_said_once_and_counts(draw: Draw) -> None:
    drawn = draw(Odd(), Odd(), Odd())
    assert len(drawn.rows("topic")) == 3
    assert [line for line in drawn.log() if "not drawn" in line] == ["not drawn: /topic (odd_msgs/msg/Odd)"]
    assert drawn.view.counts.without_picture == {"odd_msgs/msg/Odd": 3}


def test_a_message_that_cannot_be_read_costs_itself(draw: Draw) -> None:
    broken = Entry(2, START_NS + 2 * STEP_NS, Kind.ROS_IN, "/text", String.TYPE, (b"\0\1\0\0\xff\0\0\0",))
    drawn = draw(entries=[text(1, START_NS), broken, text(3, START_NS + 3 * STEP_NS)])
    assert len(drawn.rows("text")) == 3
    assert drawn.view.counts.refused == {"/text": 1}
    assert sum("/text: cannot be drawn" in line for line in drawn.log()) == 1


#: Numbers that sizes, counts and places lie with.
WORDS = (0, 1, 0xFF, 60_000, 0x10000, 10**9, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
DOUBLES = (np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 1e18, 3.5e38)


def mutant(data: bytes, chance: np.random.Generator) -> bytes:
    """A message with one to four lies in it, most of them near its beginning, some of it cut off."""
    out = bytearray(data)
    for _ in range(chance.integers(1, 5)):
        place = int(chance.integers(4, len(out) if chance.random() < 0.3 else min(len(out), 300)))
        lie = int(chance.integers(4))
        if lie == 0:
            out[place] ^= 1 << int(chance.integers(8))
        elif lie == 1:
            out[place] = chance.choice((0, 1, 127, 128, 255))
        else:
            size = 4 * (lie - 1)
            number = int(chance.choice(WORDS)).to_bytes(4, "little") if lie == 2 else chance.choice(DOUBLES).tobytes()
            place = 4 + (place - 4) // size * size
            out[place : place + size] = number[: len(out) - place]
    return bytes(out if chance.random() < 0.9 else out[: int(chance.integers(4, len(out)))])


@pytest.mark.slow
@pytest.mark.parametrize("strict", ["1", "0"])
@pytest.mark.filterwarnings("error")
def test_no_bytes_whatever_end_the_drawing(strict: str, draw: Draw, monkeypatch: pytest.MonkeyPatch) -> None:
    """Claims of 60,000 x 60,000 pixels, of 10^9 points, of NaN and infinity: a row each, and no memory."""
    resource = pytest.importorskip("resource")
    monkeypatch.setenv("RERUN_STRICT", strict)
    with SessionFile.open(FIXTURES / "every-type.mcap") as file:
        said = [entry for entry in file.entries() if entry.kind in (Kind.ROS_IN, Kind.ROS_OUT)]
    chance = np.random.default_rng(int(strict))
    entries: list[Entry] = []
    expected = Counter[str]()
    for entry in {(entry.type, entry.channel): entry for entry in said}.values():
        for _ in range(12):
            number = len(entries) + 1
            data = mutant(entry.data(), chance)
            entries.append(replace(entry, seq=number, stamp_ns=START_NS + number, payload=(data,)))
            expected[entry.channel] += 1
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    drawn = draw(entries=entries)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # kB
    assert sum(drawn.view.counts.refused.values()) > 500  # it was worth trying
    shown = drawn.view.seen.shown.values()
    assert {each.topic: drawn.count(each.path) for each in shown} == expected
    for name in NAMES:
        blueprint(name, drawn.view.seen)


def test_names_without_end_cost_themselves(draw: Draw, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway.addons.view.pen.MAX_ENTITIES", 30)
    turn = (0.0, 0.0, 0.0, 1.0)
    frames = [TransformStamped(Header(0, "base"), f"tool {number}", (0.0, 0.0, 0.0), turn) for number in range(40)]
    drawn = draw(*frames, *((f"/text/{number}", String("x")) for number in range(10)))
    assert drawn.count("topic") == 40
    assert 10 < drawn.view.counts.refused["/topic"] < 15
    assert sum(drawn.view.counts.refused.values()) > 20
    assert sum(path.startswith("frames/") for path in drawn.batches) < 30


def test_a_name_that_is_no_text_costs_no_other_row(draw: Draw) -> None:
    good = TransformStamped(Header(0, "base"), "tool", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    odd = TransformStamped(Header(0, "b\udcff"), "t\udc80", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    drawn = draw(good, odd, ("/text", String("caf\udce9")))
    parents = [row["Transform3D:parent_frame"] for row in drawn.rows("topic")]
    assert parents == [["base"], ["b\ufffd"]]
    assert drawn.one("text")["TextDocument:text"] == ["caf\ufffd"]


def test_missing_entry_numbers_are_drops(draw: Draw) -> None:
    drawn = draw(entries=[text(1, START_NS), text(2, START_NS + 1), text(6, START_NS + 2)])
    assert drawn.one("session/drops")["Scalars:scalars"] == [3.0]
    assert "3 entries are missing" in drawn.log()


def test_notes_links_and_drops_have_their_places(draw: Draw) -> None:
    drawn = draw(
        entries=[
            note(1, Kind.LINK, Note(Level.INFO, "link_up", "10.0.0.7:18944 connected"), (4,)),
            note(2, Kind.EDGE_NOTE, Note(Level.WARN, "queue_drop", "5 messages dropped", data={"count": 5})),
            note(3, Kind.NOTE, Note(Level.ERROR, "bad_crc", "refused", "TRANSFORM/Probe")),
            note(4, Kind.EDGE_NOTE, MarkNote("suture", "first", phase="begin").note()),
        ]
    )
    assert [without_time(row["TextLog:text"][0]) for row in drawn.rows("session/links")] == [
        "10.0.0.7:18944 connected [link 4]"
    ]
    assert drawn.one("session/drops")["Scalars:scalars"] == [5.0]
    levels = [(row["TextLog:level"][0], without_time(row["TextLog:text"][0])) for row in drawn.rows("session/log")]
    assert levels == [
        ("INFO", "10.0.0.7:18944 connected [link 4]"),
        ("WARN", "5 messages dropped"),
        ("ERROR", "TRANSFORM/Probe: refused"),
        ("INFO", "mark suture begins: first"),
    ]
    assert [without_time(row["TextLog:text"][0]) for row in drawn.rows("session/marks")] == [
        "mark suture begins: first"
    ]


def test_rates_are_messages_of_each_second_and_zero_in_a_pause(draw: Draw) -> None:
    times = [START_NS + k * SECOND // 10 for k in range(20)] + [START_NS + 7 * SECOND, START_NS + 8 * SECOND]
    drawn = draw(entries=[text(number, at) for number, at in enumerate(times, 1)])
    rates = [row["Scalars:scalars"][0] for row in drawn.rows("plots/rate/ros_in/text")]
    assert rates == [10.0, 10.0, 0.0, 0.0, 1.0]


def test_a_steady_stream_has_a_steady_rate_from_the_first_to_the_last_second(draw: Draw) -> None:
    times = [START_NS + SECOND // 3 + k * SECOND // 10 for k in range(57)]  # neither end at a whole second
    drawn = draw(entries=[text(number, at) for number, at in enumerate(times, 1)])
    rows = drawn.rows("plots/rate/ros_in/text")
    assert [row["Scalars:scalars"][0] for row in rows] == [10.0] * 5
    assert rows[-1]["gateway_time"] < times[-1]


@pytest.mark.parametrize("odd_ns", [0, -1, -(1 << 63), (1 << 62) + 1, (1 << 63) - 1, (1 << 64) - 1])
def test_a_stamp_that_no_time_line_takes_costs_its_place_there(odd_ns: int, draw: Draw) -> None:
    pose = TransformStamped(Header(0, "base"), "tool", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)).pack()
    times = [START_NS, odd_ns, START_NS + 1, odd_ns, START_NS + 2 * SECOND]
    poses = [
        Entry(10 + number, at, Kind.ROS_IN, "/tool", TransformStamped.TYPE, (pose,), source_ns=source)
        for number, (at, source) in enumerate(zip(times, reversed(times), strict=True))
    ]
    drawn = draw(entries=[*(text(number, at) for number, at in enumerate(times, 1)), *poses])
    for path, numbers in (("text", [1, 2, 3, 4, 5]), ("tool", [10, 11, 12, 13, 14])):
        assert [row["entry"] for row in drawn.rows(path)] == numbers
        assert [row.get("gateway_time", odd_ns) for row in drawn.rows(path)] == times
    assert [row.get("sender_time", odd_ns) for row in drawn.rows("tool")] == times[::-1]
    assert drawn.view.counts.timeless == {"gateway_time": 4} | ({"sender_time": 2} if odd_ns else {})
    assert sum(f"found the stamp {odd_ns}" in line for line in drawn.log()) == len(drawn.view.counts.timeless)
    assert drawn.view.seen.seconds == 2.0


def test_latency_is_gateway_time_minus_the_senders_stamp(draw: Draw) -> None:
    drawn = draw(entries=[text(1, START_NS, source_ns=START_NS - 2_500_000), text(2, START_NS + 1)])
    assert drawn.one("plots/latency/text")["Scalars:scalars"] == [2.5]


def test_a_stream_that_falls_silent_leaves_a_gap_on_the_time_line(draw: Draw) -> None:
    times = [START_NS + k * STEP_NS for k in range(30)] + [START_NS + 3 * SECOND]
    drawn = draw(entries=[text(number, at) for number, at in enumerate(times, 1)])
    assert [line for line in drawn.log() if "silent" in line] == ["/text: silent for 2.71 s"]


def test_of_messages_made_of_one_the_fullest_is_drawn(draw: Draw) -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    mesh = Mesh(np.array([[0, 1, 2]], np.uint32), corners)
    full = PolyData(Header(0, "f"), corners, polygons=np.array([3, 0, 1, 2], np.uint32))
    cause = Entry(1, START_NS, Kind.IGTL_IN, "POLYDATA/Skin", "POLYDATA", (b"",))
    outputs = messages(("/igtl/in/Skin/mesh", mesh), ("/igtl/in/Skin/polydata", full), kind=Kind.ROS_OUT)
    alone = messages(("/igtl/in/Other/mesh", mesh), kind=Kind.ROS_OUT)
    shown = draw(entries=[cause, *outputs, *alone]).view.seen.shown
    assert {topic: each.drawn for topic, each in shown.items()} == {
        "/igtl/in/Skin/mesh": False,
        "/igtl/in/Skin/polydata": True,
        "/igtl/in/Other/mesh": True,
    }


def test_a_picture_that_its_volume_holds_too_has_no_view_of_its_own(draw: Draw) -> None:
    with SessionFile.open(FIXTURES / "ultrasound.mcap") as file:
        seen = draw(entries=file.entries()).view.seen
    flat, placed = (seen.shown[f"/igtl/in/Image_Probe/{kind}"] for kind in ("image", "volume"))
    assert (flat.superseded, placed.superseded) == (True, False)
    names = re.findall(r"/igtl/in/Image_Probe/\w+", str([view.name for view in views(blueprint("ultrasound", seen))]))
    assert names == ["/igtl/in/Image_Probe/volume"]


def views(part: Any) -> list[Any]:
    """All views of a blueprint."""
    part = getattr(part, "root_container", part)
    return [part] if hasattr(part, "class_identifier") else [view for each in part.contents for view in views(each)]


def test_topics_that_would_meet_keep_apart(draw: Draw) -> None:
    drawn = draw(("/a b", String("x")), ("/a_b", String("y")), ("/session/log", String("z")))
    assert drawn.one("a_b")["TextDocument:text"] == ["x"]
    assert drawn.one("a_b_2")["TextDocument:text"] == ["y"]
    assert drawn.one("topics/session/log")["TextDocument:text"] == ["z"]


def test_equal_sessions_give_equal_pictures(draw: Draw) -> None:
    def rows() -> Any:
        drawn = draw(*(String(str(number)) for number in range(50)))
        return {path: drawn.rows(path) for path in drawn.batches}

    assert rows() == rows()


def test_the_log_has_no_note_that_comes_periodically_without_news(draw: Draw) -> None:
    """A minute of a PLUS server: a ping four times a second, and a query that has no answer each second."""
    tick = Note(Level.INFO, TICK, "a deadline has come")
    query = Note(Level.INFO, "query_unanswered", "GET_TRANS of any device not answered", "GET_TRANS/")
    mark = Note(Level.INFO, "mark", "stitch")
    entries: list[Entry] = []
    for number in range(240):
        told = [tick] + [query, mark] * (number % 4 == 0)
        for one in told:
            seq = len(entries) + 1
            entries.append(Entry(seq, START_NS + number * SECOND // 4, Kind.EDGE_NOTE, payload=(one.pack(),), links=()))
    log = Counter(re.sub(r" \(.* more like it\)", "", line) for line in draw(entries=entries).log())
    assert log == {"GET_TRANS/: GET_TRANS of any device not answered": 4, "stitch": 60}


@pytest.mark.parametrize("fixture", sorted(FIXTURES.glob("*.mcap")), ids=lambda path: path.stem)
def test_no_fixture_has_a_line_of_its_log_many_times(draw: Draw, fixture: Path) -> None:
    with SessionFile.open(fixture) as file:
        notes = file.entries_of_kinds({Kind.LINK, Kind.NOTE, Kind.EDGE_NOTE})
        log = Counter(draw(entries=[replace(one, seq=number) for number, one in enumerate(notes, 1)]).log())
    repeated = {line: count for line, count in log.items() if count > 4}
    assert not repeated and not [line for line in log if "deadline" in line]


def test_the_log_has_no_text_that_comes_periodically_without_news(draw: Draw) -> None:
    """The metadata of each pose of PLUS, and a state that is sent again and again; each other text is a line."""
    told: list[Any] = []
    for number in range(400):
        told += [("/meta", Metadata(Header(), "TRANSFORM", "Tool", 0, (MetadataItem("TransformStatus", 3, "OK"),)))]
        told += [("/state", String("AT TARGET")), ("/count", String(str(number)))]
    drawn = draw(*told)
    log = drawn.log()
    assert sum("TransformStatus" in line for line in log) <= 4 and sum("AT TARGET" in line for line in log) <= 4
    assert sum(line.startswith("/count: ") for line in log) == 400
    assert len(drawn.rows("state")) == 400, "each message is a row of its topic"
