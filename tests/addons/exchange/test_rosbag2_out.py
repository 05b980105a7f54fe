"""A bag of a session by the readers of others: types without a definition, names of any letters, other encodings."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.rosbag2 import Rosbag2
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.base.qos import Qos
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests import exchanges
from tests.tables import table
from tests.timing import quick

STRING = "std_msgs/msg/String"
ROS2 = get_typestore(Stores.ROS2_JAZZY)
SAID = bytes(ROS2.serialize_cdr(ROS2.types[STRING](data="a"), STRING))


def exported(tmp_path: Path, recording: Path) -> tuple[Path, ExportAccount]:
    with SessionFile.open(recording) as file:
        return tmp_path / "bag", export_to("rosbag2", file, tmp_path / "bag", ())


def session(tmp_path: Path, *channels: tuple[str, str]) -> Path:
    writer = SessionWriter(tmp_path / "some.mcap", {})
    for number, (topic, ros_type) in enumerate(channels, 1):
        writer.write(Entry(number, number, Kind.ROS_IN, topic, ros_type, (SAID,)))
    writer.close({})
    return tmp_path / "some.mcap"


def test_names_of_any_letters_are_the_same_in_both_files(tmp_path: Path) -> None:
    topics = ["/said", "/grüße", "/\U0001f600", '/a"b: [c]\n  - d', "/\x1b[2J\x85\u2028"]
    bag, _ = exported(tmp_path, session(tmp_path, *((topic, STRING) for topic in topics)))
    side = YAML(typ="safe").load(bag / "metadata.yaml")["rosbag2_bagfile_information"]
    assert [one["topic_metadata"]["name"] for one in side["topics_with_message_count"]] == topics
    with (bag / "bag_0.mcap").open("rb") as stream:
        assert [channel.topic for _, channel, _ in make_reader(stream).iter_messages()] == topics


def test_a_type_without_definition_does_not_hide_the_others(tmp_path: Path) -> None:
    bag, account = exported(tmp_path, session(tmp_path, ("/said", STRING), ("/other", "nobody_msgs/msg/Knows")))
    with Reader(bag) as reader:
        assert sorted((one.topic, one.msgcount) for one in reader.connections) == [("/other", 1), ("/said", 1)]
        assert [bytes(data) for _, _, data in reader.messages()] == [SAID, SAID]
    assert account.notes == ["nobody_msgs/msg/Knows: the session has no definition of this type"]


def test_other_encodings_are_left_out_and_counted(tmp_path: Path) -> None:
    with (tmp_path / "foreign.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        ros = writer.register_schema(STRING, "ros2msg", b"string data")
        plain = writer.register_schema("Said", "jsonschema", b"{}")
        channels = [writer.register_channel("/said", "cdr", ros), writer.register_channel("/json", "json", plain)]
        for number, (channel, data) in enumerate(zip(channels * 2, (SAID, b"{}") * 2, strict=True), 1):
            writer.add_message(channel, number, data, number)
        writer.finish()  # type: ignore[no-untyped-call]
    bag, account = exported(tmp_path, tmp_path / "foreign.mcap")
    rows = {row.stream: (row.declared, row.taken, row.left_out) for row in account.rows}
    assert rows == {"/said": (2, 2, 0), "/json": (2, 0, 2)}
    assert "found encoding 'json'" in next(row.why for row in account.rows if row.stream == "/json")
    with Reader(bag) as reader:
        assert [one.topic for one in reader.connections] == ["/said"]


def test_a_bag_is_named_like_its_folder(tmp_path: Path) -> None:
    path = session(tmp_path, ("/said", STRING))
    (tmp_path / "sub").mkdir()
    with SessionFile.open(path) as file:
        export_to("rosbag2", file, tmp_path / "sub" / ".." / "sub", ())
    assert sorted(made.name for made in (tmp_path / "sub").iterdir()) == ["metadata.yaml", "sub_0.mcap"]


def chained(length: int) -> str:
    """A type that holds ten of the next one, and so on."""
    separator = "=" * 80
    parts = [f"{separator}\nMSG: a/T{number}\na/T{number + 1}[10] x\n" for number in range(1, length)]
    return "a/T1[10] x\n" + "".join(parts) + f"{separator}\nMSG: a/T{length}\nuint8 x\n"


HOSTILE = {
    "recursive": "a/T x\n" + "=" * 80 + "\nMSG: a/T\na/T x\n",
    "chained": chained(9),
    "long chain": chained(2000),
    "giant": "".join(f"float64 field_{number}\n" for number in range(100_000)),
    "giant array": "uint8[4000000000] data\n",
    "not a definition": "\0\x1b[2J = = [[[",
}


@table("name", HOSTILE)
@table("to", ["rosbag2", "csv"])
def test_hostile_definitions_cost_their_own_messages(tmp_path: Path, name: str, to: str) -> None:
    with (tmp_path / "foreign.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        good = writer.register_channel("/said", "cdr", writer.register_schema(STRING, "ros2msg", b"string data"))
        bad = writer.register_channel(
            "/bad", "cdr", writer.register_schema("a/msg/T", "ros2msg", HOSTILE[name].encode())
        )
        for number, channel in enumerate((bad, good, bad, good), 1):
            writer.add_message(channel, number, SAID, number)
        writer.finish()  # type: ignore[no-untyped-call]
    with quick(), SessionFile.open(tmp_path / "foreign.mcap") as file:
        account = export_to(to, file, tmp_path / "out", ())
    rows = {row.stream: row for row in account.rows}
    assert (rows["/said"].declared, rows["/said"].taken) == (2, 2)
    assert rows["/bad"].declared == 2 == rows["/bad"].taken + rows["/bad"].left_out
    if to == "csv":
        assert (rows["/bad"].failed, bool(rows["/bad"].why)) == (2, True)


#: What ``rosbag2_storage`` of each release reads of ``metadata.yaml``, and of the channels of an MCAP file: the newest
#: version whose profiles are a string with rmw's numbers, and whether it takes the version into account at all.
#: Sources: yaml.hpp, qos.cpp and mcap_storage.cpp of ros2/rosbag2 in the branches of these names.
RELEASES = {"humble": None, "iron": None, "jazzy": 8, "kilted": 8}
RMW = {"history": (1, 2), "reliability": (1, 2), "durability": (1, 2), "liveliness": (1, 3)}
NAMES = {"reliability": {1: "reliable", 2: "best_effort"}, "durability": {1: "transient_local", 2: "volatile"}}


def profiles(release: str, version: int, value: object) -> list[dict[str, Any]]:
    """The profiles as that release reads them.  Raises like its parser where the form is another one."""
    newest = RELEASES[release]
    if newest is not None and version > newest:
        assert isinstance(value, list)
        raise AssertionError("names: no such bag is written")
    assert isinstance(value, str)
    found: list[dict[str, Any]] = YAML(typ="safe").load(value)
    for profile in found:
        assert all(type(profile[policy]) is int and profile[policy] in numbers for policy, numbers in RMW.items())
        assert all(type(profile[name][part]) is int for name in ("deadline", "lifespan") for part in ("sec", "nsec"))
    return found


@pytest.mark.parametrize("release", RELEASES)
def test_every_release_reads_the_quality_of_service(tmp_path: Path, release: str) -> None:
    offered = {"/a": Qos(depth=5), "/b": Qos(reliable=False), "/c": Qos(latched=True)}
    writer = SessionWriter(tmp_path / "some.mcap", {}, qos_of=lambda topic, _type: offered[topic])
    for number, topic in enumerate(offered, 1):
        writer.write(Entry(number, number, Kind.ROS_IN, topic, STRING, (SAID,)))
    writer.close({})
    bag, _ = exported(tmp_path, tmp_path / "some.mcap")
    side = YAML(typ="safe").load(bag / "metadata.yaml")["rosbag2_bagfile_information"]
    found = {
        one["topic_metadata"]["name"]: profiles(release, side["version"], one["topic_metadata"]["offered_qos_profiles"])
        for one in side["topics_with_message_count"]
    }
    with (bag / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        (record,) = (one for one in reader.iter_metadata() if one.name == "rosbag2")
        inner = YAML(typ="safe").load(record.metadata["serialized_metadata"])
        summary = reader.get_summary()
    assert summary
    assert inner == side
    for channel in summary.channels.values():
        assert profiles(release, inner["version"], channel.metadata["offered_qos_profiles"]) == found[channel.topic]
    read = {
        topic: (
            one["depth"],
            NAMES["reliability"][one["reliability"]] == "reliable",
            NAMES["durability"][one["durability"]] == "transient_local",
        )
        for topic, (one,) in found.items()
    }
    assert read == {topic: (qos.depth, qos.reliable, qos.latched) for topic, qos in offered.items()}


def test_rosbags_and_import_read_the_same_quality_of_service(tmp_path: Path) -> None:
    offered = Qos(depth=7, reliable=False, latched=True)
    writer = SessionWriter(tmp_path / "some.mcap", {}, qos_of=lambda _topic, _type: offered)
    writer.write(Entry(1, 1, Kind.ROS_IN, "/a", STRING, (SAID,)))
    writer.close({})
    bag, _ = exported(tmp_path, tmp_path / "some.mcap")
    with Reader(bag) as reader:
        (profile,) = reader.connections[0].ext.offered_qos_profiles  # type: ignore[union-attr]
    assert (profile.depth, profile.reliability.name, profile.durability.name) == (7, "BEST_EFFORT", "TRANSIENT_LOCAL")
    with closing(Rosbag2(bag)) as source:
        assert source.qos_of("/a", STRING) == offered
        assert source.notes == []


def test_services_and_actions_come_back_from_a_bag(tmp_path: Path) -> None:
    """Event by event; rosbags opens the bag, which it does not with the hash of such a type."""
    path = exchanges.write(tmp_path / "some.mcap")
    out, account = exported(tmp_path, path)
    with SessionFile.open(path) as file:
        given = [(each.stamp_ns, each.channel, each.type, each.data()) for each in file.entries()]
    assert sum(row.taken for row in account.rows) == len(given) and not account.notes
    with closing(Rosbag2(out)) as bag:
        assert [(each.time_ns, each.channel, each.type, bytes(each.payload)) for each in bag.items()] == given
        assert bag.notes == []
    with AnyReader([out]) as reader:
        feedback = [
            list(reader.deserialize(data, each.msgtype).feedback.sequence)  # type: ignore[attr-defined]
            for each, _, data in reader.messages()
            if each.topic.endswith("feedback")
        ]
    assert feedback == [[0, 1, 2], [0, 1, 2, 3]] * 4
    for place in (out / "bag_0.mcap", path):
        with place.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary
        events = {each.name: each for each in summary.schemas.values() if each.name.endswith("_Event")}
        assert {each.encoding for each in events.values()} == {"ros2msg"} and len(events) == 4
