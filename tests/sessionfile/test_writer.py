"""The file as others see it: rosbags, mcap-ros2-support, pymcap-cli and rerun open our recordings."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.sessionfile import layout
from igtl_gateway.sessionfile.compression import COMPRESSIONS
from igtl_gateway.sessionfile.writer import SessionWriter
from tests.record import samples

BIN = Path(sys.executable).parent
DEADLINE_S = 120


@pytest.fixture(scope="module", params=sorted(COMPRESSIONS))
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session with every kind of entry, in each compression."""
    path = tmp_path_factory.mktemp("conformance") / "session.mcap"
    writer = SessionWriter(
        path,
        samples.SESSION,
        qos_of=lambda topic, _type: Qos(1, latched=True) if topic == "/chatter" else None,
        compression=request.param,
        chunk_bytes=3000,
    )
    for entry in entries():
        writer.write(entry)
    writer.close({"streams": {}})
    return path


def entries() -> list[Entry]:
    """With names that need escaping, too."""
    given = samples.every_kind(20)
    at = len(given)
    odd = samples.START_NS + at
    return [
        *given,
        Entry(at + 1, odd + 1, Kind.IGTL_IN, "ODD \udcff/Größe\0\\", "ODD \udcff", (b"bytes",)),
        Entry(at + 2, odd + 2, Kind.NOTE, payload=(b"\xff no note",)),
    ]


def test_rosbags_reads_every_message(recording: Path) -> None:
    with AnyReader([recording]) as reader:
        assert reader.message_count == len(entries())
        read = [(connection, reader.deserialize(data, connection.msgtype)) for connection, _, data in reader.messages()]
        (chatter,) = [connection for connection in reader.connections if connection.topic == "/chatter"]
    for entry, (connection, message) in zip(entries(), read, strict=True):
        if entry.kind in layout.ROS_KINDS:
            assert connection.topic == entry.channel
            assert bytes(samples.string_cdr(message.data)) == entry.data()  # type: ignore[attr-defined]
        elif entry.kind in layout.WIRE_TOPICS:
            assert message.data.tobytes() == entry.data()  # type: ignore[attr-defined]
            assert layout.unescape(message.type) == entry.type  # type: ignore[attr-defined]
        else:
            assert message.kind == entry.kind.value  # type: ignore[attr-defined]
    (qos,) = chatter.ext.offered_qos_profiles  # type: ignore[union-attr]
    assert (qos.depth, qos.durability.name) == (1, "TRANSIENT_LOCAL")


def test_mcap_ros2_support_decodes_every_message(recording: Path) -> None:
    with recording.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
        assert [attachment.name for attachment in reader.iter_attachments()] == [layout.CONFIGURATION_ATTACHMENT]
        assert reader.get_header().profile == "ros2"
    assert len(decoded) == len(entries())
    for entry, (_, channel, message, fields) in zip(entries(), decoded, strict=True):
        assert (message.sequence, message.log_time) == (entry.seq, entry.stamp_ns)
        assert message.publish_time == (entry.source_ns or entry.stamp_ns)
        assert channel.metadata[layout.KIND_KEY] == entry.kind.value
        if entry.kind in layout.WIRE_TOPICS:
            assert bytes(fields.data) == entry.data()
        elif entry.kind in layout.NOTE_KINDS:
            assert fields.kind == entry.kind.value


def test_pymcap_doctor_finds_no_errors(recording: Path) -> None:
    done = subprocess.run(
        [BIN / "pymcap-cli", "doctor", recording],
        capture_output=True, text=True, check=False, timeout=DEADLINE_S, env={**os.environ, "COLUMNS": "500"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\b0 errors\b", done.stdout + done.stderr)


@pytest.mark.skipif(find_spec("rerun") is None, reason="no rerun here: install the extra 'view'")
def test_rerun_opens_it(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "session.rrd"
    done = subprocess.run(
        [BIN / "rerun", "mcap", "convert", recording, "-o", out],
        capture_output=True, text=True, check=False, timeout=DEADLINE_S, env={**os.environ, "RERUN_ANALYTICS": "0"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "ERROR" not in done.stderr
    told = subprocess.run(
        [BIN / "rerun", "rrd", "print", out],
        capture_output=True, text=True, check=True, timeout=DEADLINE_S, env={**os.environ, "RERUN_ANALYTICS": "0"},
    ).stdout  # fmt: skip
    # rows per topic: the importer has decoded every message, our own and those of ROS
    rows: dict[str, int] = {}
    for number, topic in re.findall(r"with (\d+) rows.*? - (/\S+) - data columns: \[(?:igtl_msgs|TextDocument)", told):
        rows[topic] = rows.get(topic, 0) + int(number)
    assert rows["/chatter"] == 20
    assert rows["/igtl_gateway/wire/in/transform/ProbeToTracker"] == 20
    assert rows["/igtl_gateway/notes"] == 61
