"""Sessions of peers that deviate from the protocol: what is certain is read, noted once, and recorded as received."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, PeerRow, ToIgtlRow
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.igtl_msgs import TrackedTool, TrackingData
from igtl_gateway.convert.rosmsg import Header as RosHeader
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.session import Session, make_core
from igtl_gateway.replay.restamp import Restamper
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Item, Message, decode, encode
from igtl_gateway.wire.header import TICKS_AT, U64
from igtl_gateway.wire.query import EmptyQuery, StartPolyData, StartTracking
from igtl_gateway.wire.transform import Transform
from tests.script import T0_NS, Script
from tests.tables import table

TOPIC = "/igtl/in/Probe/transform"
LIVE = Config().watched()
SECONDS = T0_NS // NS_PER_S


def pose(x: float = 1.0, version: int = 1, ticks: int = 0, items: tuple[Item, ...] = ()) -> Message:
    return Message("TRANSFORM", "Probe", Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, x, 2, 3)), ticks, version, 0, items)


def of_version(data: bytes, version: int) -> bytes:
    return bytes([0, version]) + data[2:]


BARE = of_version(join(encode(pose())), 2)
VERSION_3 = of_version(join(encode(pose(version=2, items=(Item("k", b"v"),)))), 3)


def script(config: Config = LIVE) -> Script:
    made = Script(config)
    made.up(1, peer="127.0.0.1:5", role="server")
    return made


def notes(made: Script) -> list[str]:
    found = [Note.unpack(entry.data()) for entry in made.log if entry.kind is Kind.NOTE]
    return [note.text for note in found if note.code == "deviation_read"]


@table(("data", "named"), [(BARE, "openigtlink-rust 0.4.1"), (VERSION_3, "header version 3")])
def test_it_is_read_said_once_and_recorded_as_it_came(data: bytes, named: str) -> None:
    made, plain = script(), script()
    for number in range(40):  # the fast path would have it, if any message could be compiled
        lines = made.igtl(data)
        assert TOPIC in " ".join(lines)
        plain.igtl(pose(version=2, items=(Item("k", b"v"),)) if data is VERSION_3 else pose())
        assert made.published(TOPIC) == plain.published(TOPIC)
        assert lines.count("note deviation_read") == (number == 0)
    (text,) = notes(made)
    assert "TRANSFORM/Probe" in text and "127.0.0.1:5" in text and named in text
    assert all(entry.data() == data for entry in made.log if entry.kind is Kind.IGTL_IN)
    assert verify(made.log, LIVE).good
    # who deviates is answered in version 1, which it writes
    assert made.igtl(Message("GET_STATUS", "", EmptyQuery()))[-1] == "igtl STATUS/ v1 to 1"


def test_right_messages_of_such_a_peer_stay_in_the_fast_path_and_wrong_ones_leave_it() -> None:
    made = script()
    right = join(encode(pose(version=2)))
    for _ in range(20):
        made.igtl(right)
    for data in (BARE, right, VERSION_3, right, BARE):
        made.igtl(data)
        assert TransformStamped.unpack(made.published(TOPIC)).translation == (0.001, 0.002, 0.003)
    core = make_core(LIVE, fast_path=False)
    session = Session(core)
    for entry in made.log:
        if entry.kind.is_input:
            session.recorded(entry)
    assert core.ledger.to_dict() == made.gateway.ledger.to_dict() and verify(made.log, LIVE).good


def test_a_recording_that_is_older_refuses_what_it_refused() -> None:
    old = replace(LIVE, reading=0)
    made = script(old)
    assert made.igtl(BARE) == ["note malformed"] and made.igtl(VERSION_3) == ["note malformed"]
    assert made.igtl(Message("STT_TDATA", "", StartTracking(50, is_long=True)))
    assert made.gateway.profile_of(1) == "unrecognised"
    assert verify(made.log, old).good


# -- milliseconds in place of the fraction ----------------------------------------------------------------------------

NAMED = replace(LIVE, peers=(PeerRow("127.0.0.1:5", "openigtlink4j"),))


def stamped(milliseconds: int, seconds: int = SECONDS) -> Message:
    return pose(ticks=seconds << 32 | milliseconds)


def stamp_of(made: Script) -> int:
    return TransformStamped.unpack(made.published(TOPIC)).header.stamp_ns


@table("milliseconds", [0, 1, 7, 500, 999])
def test_a_profile_recovers_the_milliseconds(milliseconds: int) -> None:
    made = script(NAMED)
    sent = stamped(milliseconds)
    for _ in range(20):
        made.igtl(sent)
    wanted_ns = SECONDS * NS_PER_S + milliseconds * NS_PER_MS
    assert stamp_of(made) == wanted_ns
    inputs = [entry for entry in made.log if entry.kind is Kind.IGTL_IN]
    assert all((entry.source_ns, entry.data()) == (wanted_ns, join(encode(sent))) for entry in inputs)
    assert verify(made.log, NAMED).good


@table("ticks", [0, SECONDS << 32 | 1_000, ns_to_ticks(T0_NS + 123_456_789)])
def test_other_stamps_of_such_a_peer_stay_what_they_are(ticks: int) -> None:
    made, plain = script(NAMED), script()
    for one in (made, plain):
        one.igtl(pose(ticks=ticks))
    assert made.published(TOPIC) == plain.published(TOPIC)


def test_other_peers_keep_their_fractions() -> None:
    made = script(NAMED)
    made.up(2, peer="127.0.0.1:6", role="server")
    made.igtl(stamped(7), link=2)
    assert stamp_of(made) == SECONDS * NS_PER_S + 3


@table(
    ("message", "shows"),
    [
        (Message("STT_TDATA", "", StartTracking(50, is_long=True)), True),
        (Message("STT_IMAGE", "", EmptyQuery(bytes(8))), True),
        (Message("STT_TDATA", "", StartTracking(50, "patient")), False),
        (Message("STT_IMAGE", "", EmptyQuery()), False),
        (Message("GET_IMAGE", "", EmptyQuery(bytes(8))), False),
        (Message("STT_POLYDATA", "", StartPolyData(8)), False),
    ],
)
def test_its_interval_shows_openigtlink4j(message: Message, shows: bool) -> None:
    made = script()
    for _ in range(20):
        made.igtl(stamped(7))
    made.igtl(message)
    assert (made.gateway.profile_of(1) == "openigtlink4j") is shows
    made.igtl(stamped(7))
    assert stamp_of(made) == SECONDS * NS_PER_S + (7 * NS_PER_MS if shows else 3)
    assert verify(made.log, LIVE).good


def test_it_gets_a_transform_in_place_of_a_position_which_ends_its_reader() -> None:
    made = script(replace(NAMED, to_igtl=(ToIgtlRow(topic="/pose", device="Tool", type="POSITION"),)))
    lines = made.ros("/pose", PoseStamped(RosHeader(T0_NS, "base"), (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)))
    assert "igtl TRANSFORM/Tool v1 to 1" in lines and not any("POSITION" in line for line in lines)


def test_openigtlink_rust_gets_an_extended_header_and_no_matrix_by_columns_in_a_list() -> None:
    config = replace(LIVE, peers=(PeerRow("127.0.0.1:5", "openigtlink-rust"),))
    made = script(config)
    made.igtl(BARE)
    assert made.igtl(Message("GET_STATUS", "", EmptyQuery()))[-1] == "igtl STATUS/ v2 to 1"
    tools = TrackingData(RosHeader(T0_NS, "base"), (TrackedTool("Tip", 2, (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)),))
    lines = made.ros("/igtl/out/Tools", tools)
    assert "igtl TRANSFORM/Tip v2 to 1" in lines and not any("TDATA" in line for line in lines)
    assert verify(made.log, config).good


def test_a_replay_at_another_time_moves_the_stamp_that_was_meant() -> None:
    made = script(NAMED)
    made.igtl(stamped(7))
    (entry,) = (one for one in made.log if one.kind is Kind.IGTL_IN)
    (data,) = Restamper("shift", print).payload(entry, entry.stamp_ns + 5 * NS_PER_S)
    assert decode(data).ticks == ns_to_ticks(SECONDS * NS_PER_S + 7 * NS_PER_MS + 5 * NS_PER_S)
    plain: Entry = replace(entry, source_ns=U64.unpack_from(entry.data(), TICKS_AT)[0] and SECONDS * NS_PER_S + 3)
    (data,) = Restamper("shift", print).payload(plain, entry.stamp_ns + 5 * NS_PER_S)
    assert decode(data).ticks == ns_to_ticks(SECONDS * NS_PER_S + 3 + 5 * NS_PER_S)


def test_what_is_not_there_is_a_status_which_it_reads_and_no_empty_transform_which_it_shows_as_null() -> None:
    made = script(NAMED)
    for version in (1, 2):
        lines = made.igtl(Message("GET_TRANS", "Any", EmptyQuery(), 0, version))
        assert "igtl STATUS/Any v1 to 1" in lines and not any("igtl TRANSFORM" in line for line in lines)
