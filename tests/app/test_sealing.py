"""Seals of whole recordings: split ones, recorders that are killed, and files that are sealed later."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from igtl_gateway.app.sealed_folder import ABSENT, FOLLOWS
from igtl_gateway.app.sealing import seal_recording, verify_seal
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import ConfigError, GatewayError, RecordingError, UnsupportedRecording
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.retention.side_files import closed_part
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.seal_check import CHANGED, CUT, SEALED, UNSEALED, check_seal
from igtl_gateway.record.sessionfile.side_file import write_side_file
from tests.places import FIXTURES
from tests.record import samples
from tools.evidence.seal_kills import fault, killed


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "key"
    path.touch(0o600)
    signing = SigningKey.generate()
    path.write_bytes(signing.private_pem())
    (tmp_path / "key.pub").write_bytes(signing.public_pem())
    return path


def _record(path: Path, key: Path, count: int, **options: object) -> None:
    recorder = Recorder(
        path,
        samples.SESSION,
        qos_of=lambda _topic, _type: None,
        on_note=lambda _note: None,
        clock=ManualClock(),
        host=in_thread,
        options=RecordOptions(seal=key, **options),  # type: ignore[arg-type]
    )
    for number in range(1, count + 1):
        recorder(samples.ros(number))
    summary = recorder.close({})
    assert not summary.failure


@pytest.fixture
def split(tmp_path: Path, key: Path) -> Path:
    _record(tmp_path / "out.mcap", key, 40, split_bytes=1, chunk_bytes=100)
    return tmp_path / "out"


def test_the_parts_of_a_recording_continue_each_other(split: Path, tmp_path: Path) -> None:
    parts = sorted(split.glob("*.mcap"))
    assert len(parts) > 3
    result = verify_seal(split, [tmp_path / "key.pub"])
    assert (result.state, result.problem) == (SEALED, "")
    numbers = [part.part for part in result.parts]
    assert numbers == list(range(len(parts)))
    one = split / "out_1.mcap"
    data = one.read_bytes()
    one.unlink()
    assert (verify_seal(split).state, verify_seal(split).problem[:14]) == (CHANGED, "out_2.mcap: fo")
    one.write_bytes(data)
    last = split / f"out_{len(parts) - 1}.mcap"
    last.unlink()
    assert verify_seal(split).state == CUT
    first, second = split / "out_0.mcap", split / "out_1.mcap"
    first.rename(split / "x")
    second.rename(first)
    (split / "x").rename(second)
    assert verify_seal(split).state == CHANGED


def test_a_killed_recorder_leaves_a_beginning_that_verifies(tmp_path: Path, key: Path) -> None:
    chance = random.Random(3)
    for number, seconds in enumerate((0.05, 0.3)):
        path = tmp_path / f"killed_{number}.mcap"
        size = killed(path, key, seconds, chance)
        assert fault(check_seal(path), size) == ""


@pytest.mark.parametrize("name", ["star.mcap", "every-type.mcap"])
def test_a_file_is_sealed_later_and_reads_as_before(tmp_path: Path, key: Path, name: str) -> None:
    output = tmp_path / "sealed.mcap"
    seal_recording(FIXTURES / name, key, output)
    assert verify_seal(output, [tmp_path / "key.pub"]).good
    with SessionFile.open(FIXTURES / name) as before, SessionFile.open(output) as after:
        assert (before.session, before.ledger) == (after.session, after.ledger)
        assert list(before.entries()) == list(after.entries())
    with pytest.raises(UnsupportedRecording, match="found a seal"):
        seal_recording(output, key, tmp_path / "twice.mcap")


def test_what_cannot_be_sealed_is_refused(tmp_path: Path, key: Path) -> None:
    source = tmp_path / "cut.mcap"
    data = (FIXTURES / "star.mcap").read_bytes()
    for content in (b"", b"no recording", data[:5000], data[:-1], data[:-30] + data[-8:]):
        source.write_bytes(content)
        with pytest.raises(UnsupportedRecording):
            seal_recording(source, key, tmp_path / "out.mcap")
        assert not (tmp_path / "out.mcap").exists()
        assert verify_seal(source).state == UNSEALED
    with pytest.raises(ConfigError, match="another name"):
        seal_recording(source, key, source)
    with pytest.raises(GatewayError, match="no folder"):
        seal_recording(FIXTURES / "star.mcap", key, tmp_path / "none" / "out.mcap")


def test_a_recording_does_not_start_with_a_key_that_others_may_read(tmp_path: Path, key: Path) -> None:
    key.chmod(0o644)
    with pytest.raises(RecordingError, match="found mode 0644, expected 0600"):
        _record(tmp_path / "out.mcap", key, 1)
    assert not (tmp_path / "out.mcap").exists()


# -- beside the parts -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_side_file_of_a_split_recording_follows_from_its_sealed_parts(split: Path) -> None:
    side = split / "metadata.yaml"
    text = side.read_text("utf-8")
    assert verify_seal(split).good and verify_seal(split).side_file == FOLLOWS
    one, two = ('    - "out_1.mcap"\n', '    - "out_2.mcap"\n')
    changes = {
        "relative_file_paths": (f"{one}{two}", f"{two}{one}"),
        "files": ('    - path: "out_1.mcap"', '    - path: "other.mcap"'),
        "message_count": ("  message_count: 40\n", "  message_count: 41\n"),
        "starting_time": ("nanoseconds_since_epoch: ", "nanoseconds_since_epoch: 1"),
        "topics_with_message_count": ('        name: "/', '        name: "/x/'),
        "storage_identifier": ("storage_identifier: mcap", "storage_identifier: sqlite3"),
        "custom_data": ("custom_data: ~", "custom_data: {a: b}"),
    }
    for key, (before, after) in changes.items():
        assert before in text, key
        side.write_text(text.replace(before, after, 1), "utf-8")
        result = verify_seal(split)
        assert (result.state, result.problem[: len(key) + 15]) == (CHANGED, f"metadata.yaml: {key}"), result.problem
    same = (f"# a note\n{text}", text.replace("\n", "\r\n"), f"\ufeff{text}", text.replace("mcap\n", "mcap \n", 1))
    for content in (b"", b"\xff", b"[1]", text.encode()[:-200], *(each.encode() for each in same)):
        side.write_bytes(content)
        assert verify_seal(split).problem.startswith("metadata.yaml: "), content
    side.write_text(text.replace("ros_distro: jazzy", "ros_distro: kilted"), "utf-8")
    assert verify_seal(split).good, "the distribution is that of the writer"
    side.unlink()
    result = verify_seal(split)
    assert (result.good, result.state, result.problem) == (False, CHANGED, f"metadata.yaml: {ABSENT}")


def test_a_file_that_a_reader_would_take_for_a_part_is_named(split: Path) -> None:
    stranger = split / "zz.mcap"
    stranger.write_bytes((split / "out_0.mcap").read_bytes())
    result = verify_seal(split)
    assert (result.state, result.problem) == (CHANGED, "zz.mcap: found a file beside the parts of the recording")


def test_the_side_file_of_a_recording_that_was_cut_off_may_lack_its_last_part(split: Path) -> None:
    parts = sorted(split.glob("out_*.mcap"), key=lambda path: int(path.stem.rpartition("_")[2]))
    parts[-1].unlink()
    assert (verify_seal(split).state, verify_seal(split).side_file[:17]) == (CUT, "duration: differs"), "a part is gone"
    rows = [row for part in parts[:-1] if (row := closed_part(part))]
    for count, follows in ((len(rows), True), (len(rows) - 1, True), (len(rows) - 2, False)):
        write_side_file(split, rows[:count])
        result = verify_seal(split)
        assert result.state == CUT and (result.side_file == FOLLOWS) is follows, count
    (split / "metadata.yaml").unlink()
    result = verify_seal(split)
    assert (result.state, result.side_file) == (CUT, ABSENT), "it is written when a part is closed"
