"""A copy has the messages, channels and definitions of the other file, and an index."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from igtl_gateway.base.errors import RecordingError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.systems.files import lock
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.compression import COMPRESSIONS, Compression
from igtl_gateway.record.sessionfile.copying import CopyWriter
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage

SCHEMA = Schema(id=9, data=b"string data", encoding="ros2msg", name="std_msgs/msg/String")
QOS = {layout.QOS_KEY: layout.qos_yaml(Qos(latched=True)), layout.TYPE_HASH_KEY: "RIHS01_00"}
CHANNELS = [
    (SCHEMA, Channel(id=40, topic="/a", message_encoding="cdr", metadata=QOS, schema_id=9)),
    (None, Channel(id=7, topic="/b", message_encoding="json", metadata={}, schema_id=0)),
]


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_copy_is_the_same(tmp_path: Path, compression: Compression) -> None:
    path = tmp_path / "copy.mcap"
    with CopyWriter(path, "ros2", "another program", {}, compression=compression) as writer:
        writer.add_metadata(Metadata(name="m", metadata={"a": "b"}))
        writer.add_attachment(Attachment(create_time=1, log_time=2, name="n", media_type="text/plain", data=b"abc"))
        for number in range(100):
            schema, channel = CHANNELS[number % 2]
            writer.write(schema, channel, Message(channel.id, 1_000 - number, b"%d" % number, 5, number))
        part = writer.close({"a": 1})
    assert (part.path, part.start_ns, part.end_ns, part.entries) == (path, 901, 1_000, 100)
    assert part.size == path.stat().st_size
    assert [(topic.topic, topic.type, topic.type_hash, topic.count) for topic in part.topics] == [
        ("/a", SCHEMA.name, "RIHS01_00", 50), ("/b", "", "", 50),
    ]  # fmt: skip
    assert (layout.parse_qos_yaml(part.topics[0].qos), part.topics[1].qos) == (Qos(latched=True), "")
    with Salvage.open(path) as file:
        assert (file.profile, file.library.partition(";")[0]) == ("ros2", "another program")
        assert [(each.name, each.data, each.log_time) for each in file.attachments()] == [("n", b"abc", 2)]
        assert [each.name for each in file.metadata()] == ["m"]
        found = [(each.channel.topic, each.schema and each.schema.name, each.message) for each in file.read()]
        assert file.report.whole and file.ledger == {"a": 1}
    assert [(topic, name) for topic, name, _ in found[:2]] == [("/a", SCHEMA.name), ("/b", None)]
    assert [(each.log_time, each.data, each.sequence) for *_, each in found] == [
        (1_000 - number, b"%d" % number, number) for number in range(100)
    ]
    with SessionFile.open(path) as file:
        assert file.entry_count == 50 and [channel.topic for channel in file.skipped] == ["/b"]


def test_an_error_closes_the_file(tmp_path: Path) -> None:
    path = tmp_path / "copy.mcap"
    with pytest.raises(ZeroDivisionError), CopyWriter(path, "", "", {}, compression="none"):
        raise ZeroDivisionError
    with path.open() as file:
        lock(file.fileno())
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="exists already"):
        CopyWriter(path, "", "", {}, compression="none")
