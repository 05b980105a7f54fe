"""The time stamp behind a seal: one spelling of its record, and an end of the file that follows from the sealed one."""

from __future__ import annotations

import io
from pathlib import Path

import blake3
import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.record.seal.statement import EndOfFile
from igtl_gateway.record.seal.time_stamps import MAX_BYTES
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.file_end import FileEnd
from igtl_gateway.record.sessionfile.layout import TIME_STAMP_ATTACHMENT
from igtl_gateway.record.sessionfile.stamped import Stamp, has_sealed_end, stamp_at, stamp_record, stamped_copy
from tests.tables import table
from tools import mcap_build as build

REPLY = b"reply of the authority"
RECORD = stamp_record(REPLY)
MEDIA = "application/timestamp-reply"


def found(data: bytes, at: int = 0) -> Stamp | None:
    return stamp_at(io.BytesIO(data), at, len(data))


def test_the_record_is_an_attachment_without_times() -> None:
    assert RECORD == build.record(build.ATTACHMENT, build.attachment(TIME_STAMP_ATTACHMENT, MEDIA, REPLY))


def test_it_is_found_where_it_lies() -> None:
    assert found(b"12345" + RECORD + b"end", 5) == Stamp(5, len(RECORD), REPLY)
    assert found(b"12345" + RECORD, 5) == Stamp(5, len(RECORD), REPLY)
    stamp = found(RECORD)
    assert stamp is not None and stamp.end == len(RECORD)


@table("size", range(0, len(RECORD), 5))
def test_a_record_that_is_cut_is_none(size: int) -> None:
    assert found(RECORD[:size]) is None


def test_another_record_is_none() -> None:
    assert found(build.record(build.METADATA, build.metadata("a", {}))) is None


@table(
    ("record", "problem"),
    [
        (build.record(build.ATTACHMENT, build.attachment("other", MEDIA, REPLY)), "it has another spelling than that"),
        (build.record(build.ATTACHMENT, build.attachment(TIME_STAMP_ATTACHMENT, "a/b", REPLY)), "another spelling"),
        (
            build.record(build.ATTACHMENT, build.attachment(TIME_STAMP_ATTACHMENT, MEDIA, REPLY, 1)),
            "another spelling",
        ),
        (RECORD[:-4] + bytes(4), "another spelling"),  # without a checksum
        (RECORD[:-1] + bytes([RECORD[-1] ^ 1]), "its checksum is wrong"),
        (build.record(build.ATTACHMENT, b"short"), "its checksum is wrong"),
        (stamp_record(bytes(MAX_BYTES + 1024)), "bytes"),
    ],
)
def test_another_spelling_has_a_problem(record: bytes, problem: str) -> None:
    stamp = found(record + b"end")
    assert stamp is not None and (stamp.size, stamp.reply) == (len(record), b"")
    assert problem in stamp.problem


def test_a_large_reply_is_not_read_and_its_size_is_named() -> None:
    stamp = found(stamp_record(bytes(MAX_BYTES + 1024)))
    assert stamp is not None and stamp.problem == f"it has {len(stamp_record(bytes(MAX_BYTES + 1024))) - 9:,} bytes"
    assert found(stamp_record(bytes(MAX_BYTES))) == Stamp(0, len(stamp_record(bytes(MAX_BYTES))), bytes(MAX_BYTES))


ENDS = {
    "no summary": FileEnd(build.record(build.DATA_END, bytes(4)), None),
    "statistics": FileEnd(
        build.record(build.DATA_END, bytes(4)),
        ((records.STATISTICS, build.record(build.STATISTICS, build.statistics(1, 1, 1, 0, 2, 0, 1, 1, {1: 1}))),),
    ),
}
AT = 1000


def stamped(name: str) -> tuple[Stamp, bytes, EndOfFile]:
    """A stamp at an offset, the end of the file behind it, and the sealed one."""
    before = ENDS[name].pack(AT)
    stamp = Stamp(AT, len(RECORD), REPLY)
    index = build.record(
        build.ATTACHMENT_INDEX,
        AT.to_bytes(8, "little") + len(RECORD).to_bytes(8, "little") + bytes(16) + len(REPLY).to_bytes(8, "little")
        + build.text(TIME_STAMP_ATTACHMENT) + build.text(MEDIA),
    )  # fmt: skip
    end = ENDS[name]
    if end.groups is not None:
        statistics = build.record(build.STATISTICS, build.statistics(1, 1, 1, 1, 2, 0, 1, 1, {1: 1}))
        end = FileEnd(end.data_end, ((records.STATISTICS, statistics), (records.ATTACHMENT_INDEX, index)))
    return stamp, end.pack(stamp.end), EndOfFile(len(before), blake3.blake3(before).digest(), True)


def follows(stamp: Stamp, rest: bytes, sealed: EndOfFile) -> bool:
    data = bytes(stamp.end) + rest
    return has_sealed_end(io.BytesIO(data), len(data), stamp, sealed)


@table("name", ENDS)
def test_the_sealed_end_follows_from_the_present_one(name: str) -> None:
    stamp, rest, sealed = stamped(name)
    assert follows(stamp, rest, sealed)
    assert not follows(stamp, rest + b"\0", sealed) and not follows(stamp, rest[:-1], sealed)
    assert not follows(stamp, rest, EndOfFile(sealed.size, bytes(32), True))
    assert not follows(stamp, rest, EndOfFile(sealed.size + 1, sealed.digest, True))
    assert not follows(stamp, ENDS["statistics"].pack(stamp.end), sealed) or name == "no summary"


@table("name", ENDS)
def test_every_byte_of_the_end_counts(name: str) -> None:
    stamp, rest, sealed = stamped(name)
    for at in range(len(rest)):
        assert not follows(stamp, rest[:at] + bytes([rest[at] ^ 1]) + rest[at + 1 :], sealed), at


def test_another_attachment_is_not_the_stamp() -> None:
    stamp, rest, sealed = stamped("statistics")
    assert not follows(Stamp(stamp.at, stamp.size, REPLY + b"x"), rest, sealed)


def test_another_file_as_reply_is_refused_before_there_is_a_copy(tmp_path: Path) -> None:
    (tmp_path / "reply").write_bytes(b"no reply")
    (tmp_path / "a.mcap").write_bytes(b"x" * 100)
    with pytest.raises(ConfigError):
        stamped_copy(tmp_path / "a.mcap", 50, tmp_path / "reply", bytes(32), tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
