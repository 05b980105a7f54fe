"""Time stamps in sealed files: accepted ones, and every reason why one is not."""

from __future__ import annotations

import json
import random
import shutil
from io import BytesIO
from pathlib import Path

import pytest
from mcap.reader import make_reader

from igtl_gateway.app.sealing import UNTIMED, seal_recording, stamp_recording, verify_seal
from igtl_gateway.base.errors import ConfigError, UnsupportedRecording
from igtl_gateway.cli import main
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.seal.time_stamps import check_reply
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.seal_check import CHANGED, CUT, SEALED, TIME_STAMP
from tests.places import ROOT
from tests.record.seal.authority import Authority, new_authority
from tests.record.seal.foreign import plain_mcap
from tools.fuzz_values import case_of
from tools.kinds.sealed import DIGEST
from tools.kinds.sealed import authority as known_authority

pytest.importorskip("rfc3161_client", reason='pip install "igtl-gateway[seal]"')
pytestmark = pytest.mark.skipif(not shutil.which("openssl"), reason="openssl makes the replies of the authority")

SOURCE = ROOT / "fixtures" / "acquisition.mcap"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("time")


@pytest.fixture(scope="module")
def authority(folder: Path) -> Authority:
    return new_authority(folder / "authority", "Clock", inner=True)


@pytest.fixture(scope="module")
def key(folder: Path) -> Path:
    path = folder / "key"
    path.touch(0o600)
    path.write_bytes(SigningKey.generate().private_pem())
    return path


@pytest.fixture(scope="module")
def sealed(folder: Path, key: Path) -> Path:
    seal_recording(SOURCE, key, folder / "sealed.mcap")
    return folder / "sealed.mcap"


def _last_seal(path: Path) -> str:
    return verify_seal(path).parts[-1].last_seal


@pytest.fixture(scope="module")
def stamped(folder: Path, sealed: Path, authority: Authority) -> Path:
    stamp_recording(sealed, authority.reply(_last_seal(sealed)), folder / "stamped.mcap")
    return folder / "stamped.mcap"


def test_a_time_stamp_in_the_file_is_confirmed(
    stamped: Path, sealed: Path, authority: Authority, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(stamped), "--seal", "--tsa", str(authority.root)]) == 0
    assert "confirmed by CN=Clock" in capsys.readouterr().out
    assert main(["verify", str(stamped), "--seal", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["parts"][0]["time_stamp"]
    assert (found["checked"], found["time_ns"]) == (False, 0)
    assert main(["verify", str(stamped)]) == 0
    assert stamped.stat().st_mode & 0o777 == 0o600
    reader = make_reader(BytesIO(stamped.read_bytes()), validate_crcs=True)
    reply = next(each for each in reader.iter_attachments() if each.media_type == "application/timestamp-reply")
    assert bytes.fromhex(_last_seal(sealed)) in reply.data
    with SessionFile.open(stamped) as new, SessionFile.open(sealed) as old:
        assert [each.data() for each in new.entries()] == [each.data() for each in old.entries()]


def test_every_reason_against_a_time_stamp_is_named(
    folder: Path, sealed: Path, stamped: Path, authority: Authority
) -> None:
    digest = _last_seal(sealed)

    def problem(path: Path, root: Path) -> str:
        found = verify_seal(path, (), (root,))
        assert found.state == UNTIMED and not found.good and found.parts[0].state == SEALED
        return found.problem

    other, expired = (new_authority(folder / name, name, days=days) for name, days in (("Other", 9), ("Expired", -1)))
    assert "signature of CN=Clock, which the given certificates do not confirm" in problem(stamped, other.root)
    assert "it has no time stamp" in problem(sealed, authority.root)
    stamp_recording(sealed, expired.reply(digest), folder / "expired.mcap")
    assert "when CN=Expired was valid" in problem(folder / "expired.mcap", expired.root)
    stamp_recording(sealed, other.reply(digest, certificates=False), folder / "bare.mcap")
    assert "no certificate of its signer" in problem(folder / "bare.mcap", other.root)
    assert verify_seal(folder / "bare.mcap", (), (other.root, other.folder / "tsa.pem")).good


def test_replies_that_are_not_of_this_seal_are_refused(
    folder: Path, sealed: Path, stamped: Path, authority: Authority
) -> None:
    out = folder / "refused.mcap"
    (folder / "text").write_text("no reply")
    for reply, text in (
        (authority.reply("ab" * 32), f"found a time stamp of {'ab' * 32}"),
        (authority.reply("cd" * 64, algorithm="sha512"), "found the hash algorithm"),
        (folder / "text", "found no reply of a time-stamp authority"),
        (folder, "found a folder"),
    ):
        with pytest.raises(ConfigError, match=text):
            stamp_recording(sealed, reply, out)
    reply = authority.reply(_last_seal(sealed))
    with pytest.raises(UnsupportedRecording, match="a time stamp already"):
        stamp_recording(stamped, reply, out)
    with pytest.raises(UnsupportedRecording, match="in the state 'unsealed'"):
        stamp_recording(SOURCE, reply, out)
    with pytest.raises(ConfigError, match="found no certificates in PEM"):
        verify_seal(sealed, (), (folder / "text",))
    assert not out.exists()


def test_every_byte_of_a_time_stamp_and_of_the_end_counts(stamped: Path, sealed: Path, tmp_path: Path) -> None:
    data, path = stamped.read_bytes(), tmp_path / "changed.mcap"
    begin = verify_seal(stamped).parts[0].end_of_seals
    stop = begin + 9 + int.from_bytes(data[begin + 1 : begin + 9], "little")
    chance = random.Random(3)
    places = [begin, begin + 3, stop, len(data) - 1, *(chance.randrange(begin, len(data)) for _ in range(60))]
    for at in places:
        path.write_bytes(data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :])
        report = verify_seal(path).parts[0]
        assert report.state == CHANGED and report.first, at
        if begin + 9 <= at < stop:
            assert report.first.kind == TIME_STAMP, at
    for end in (begin + 5, begin + 200, stop, stop + 50, len(data) - 1):
        path.write_bytes(data[:end])
        assert verify_seal(path).state == CUT, end
    path.write_bytes(data + b"x")
    assert verify_seal(path).state == CHANGED
    path.write_bytes(data[:begin] + data[stop:])
    assert verify_seal(path).state == CHANGED
    path.write_bytes(data[:stop] + sealed.read_bytes()[begin:])  # the end as it was before the time stamp
    assert verify_seal(path).state == CHANGED
    path.write_bytes(data[:stop] + data[begin:])
    assert verify_seal(path).state == CHANGED


def test_a_time_stamp_of_another_file_is_named(
    stamped: Path, key: Path, authority: Authority, folder: Path, tmp_path: Path
) -> None:
    other, out = tmp_path / "other.mcap", tmp_path / "swapped.mcap"
    seal_recording(SOURCE, key, other)
    data = stamped.read_bytes()
    begin = verify_seal(stamped).parts[0].end_of_seals
    stop = begin + 9 + int.from_bytes(data[begin + 1 : begin + 9], "little")
    stamp_recording(other, authority.reply(_last_seal(other)), out)
    foreign = out.read_bytes()
    start = verify_seal(out).parts[0].end_of_seals
    foreign_stop = start + 9 + int.from_bytes(foreign[start + 1 : start + 9], "little")
    out.write_bytes(foreign[:start] + data[begin:stop] + foreign[foreign_stop:])
    first = verify_seal(out).parts[0].first
    assert first and (first.kind, first.text) == (TIME_STAMP, "it is of another seal")


@pytest.mark.parametrize("summary", [False, True])
def test_a_file_of_another_program(summary: bool, key: Path, authority: Authority, tmp_path: Path) -> None:
    (tmp_path / "plain.mcap").write_bytes(plain_mcap(summary=summary))
    seal_recording(tmp_path / "plain.mcap", key, tmp_path / "sealed.mcap")
    reply = authority.reply(_last_seal(tmp_path / "sealed.mcap"))
    stamp_recording(tmp_path / "sealed.mcap", reply, tmp_path / "stamped.mcap")
    assert verify_seal(tmp_path / "stamped.mcap", (), (authority.root,)).good
    reader = make_reader(BytesIO((tmp_path / "stamped.mcap").read_bytes()), validate_crcs=True)
    assert sum(1 for _ in reader.iter_messages()) == 3


def test_an_empty_name_in_a_certificate_is_no_warning_on_the_terminal(recwarn: pytest.WarningsRecorder) -> None:
    (reply,) = case_of("time stamp/der.0.1.1.0.3.0.0.3.0.0.1.bytes=none/0").files.values()
    assert check_reply(reply, DIGEST, known_authority()[1]).problem
    assert [str(each.message) for each in recwarn] == []
