"""A file with digests as the programs of others see it: it opens, its inputs are shown, and its digests are right."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.large_outputs import LARGE_BYTES
from tests.record.sessionfile.test_derived import session, written

BIN = Path(sys.executable).parent
DEADLINE_S = 120
DIGESTS = layout.DIGEST_TOPIC


@pytest.fixture(scope="module")
def log() -> list[Entry]:
    return session(2).log


@pytest.fixture(scope="module")
def recording(log: list[Entry], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("judged") / "digest.mcap"
    written(path, log, "digest")
    return path


def test_mcap_ros2_support_finds_the_inputs_and_the_sha_256_of_the_outputs(log: list[Entry], recording: Path) -> None:
    with recording.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
    assert len(decoded) == len(log)
    found = 0
    for entry, (_, channel, message, fields) in zip(log, decoded, strict=True):
        assert message.sequence == entry.seq
        if channel.topic.startswith(DIGESTS):
            content = bytes(fields.data)
            assert int.from_bytes(content[:8], "little") == entry.size >= LARGE_BYTES
            assert content[8:] == hashlib.sha256(entry.data()).digest(), entry.channel
            found += 1
        elif entry.kind in (Kind.ROS_IN, Kind.ROS_OUT):
            assert channel.topic == entry.channel and bytes(message.data) == entry.data()
        elif entry.kind in layout.WIRE_TOPICS:
            assert bytes(fields.data) == entry.data()
    assert found == sum(not entry.kind.is_input and entry.size >= LARGE_BYTES for entry in log)


def test_rosbags_decodes_every_message(log: list[Entry], recording: Path) -> None:
    with AnyReader([recording]) as reader:
        decoded = [(each.topic, reader.deserialize(data, each.msgtype)) for each, _, data in reader.messages()]
    assert len(decoded) == len(log)
    pictures = [message for topic, message in decoded if topic == "/igtl/out/Picture/camera"]
    expected = [entry for entry in log if entry.kind is Kind.ROS_IN and entry.channel == "/igtl/out/Picture/camera"]
    for picture, entry in zip(pictures, expected, strict=True):
        pixels = bytes(picture.data)  # type: ignore[attr-defined]
        assert len(pixels) > LARGE_BYTES and entry.data().endswith(pixels)


@pytest.mark.slow
def test_pymcap_doctor_finds_no_errors(recording: Path) -> None:
    done = subprocess.run(
        [BIN / "pymcap-cli", "doctor", recording],
        capture_output=True, text=True, check=False, timeout=DEADLINE_S, env={**os.environ, "COLUMNS": "500"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\b0 errors\b", done.stdout + done.stderr)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("rerun") is None, reason="no rerun here: install the extra 'view'")
def test_rerun_shows_the_inputs(log: list[Entry], recording: Path, tmp_path: Path) -> None:
    out, environment = tmp_path / "session.rrd", {**os.environ, "RERUN_ANALYTICS": "0"}
    done = subprocess.run(
        [BIN / "rerun", "mcap", "convert", recording, "-o", out],
        capture_output=True, text=True, check=False, timeout=DEADLINE_S, env=environment,
    )  # fmt: skip
    assert done.returncode == 0 and "ERROR" not in done.stderr, done.stderr
    printed = subprocess.run(
        [BIN / "rerun", "rrd", "print", out],
        capture_output=True,
        text=True,
        check=True,
        timeout=DEADLINE_S,
        env=environment,
    ).stdout
    rows: Counter[str] = Counter()
    for number, topic in re.findall(r"with (\d+) rows.*? - (/\S+) - data columns", printed):
        rows[topic] += int(number)
    for topic, count in Counter(entry.channel for entry in log if entry.kind is Kind.ROS_IN).items():
        assert rows[topic] >= count, topic
