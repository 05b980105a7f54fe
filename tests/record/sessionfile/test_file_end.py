"""The end of a file: taken apart and put together at another offset, with one attachment more or less."""

from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import AttachmentIndex, DataEnd, Statistics

from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.file_end import FileEnd, counted, pack_summary
from igtl_gateway.record.sessionfile.records import MAGIC, Malformed, pack
from tests.tables import table
from tools import mcap_build as build

DATA_END = pack(DataEnd(data_section_crc=7))
AT = 5000


def statistics(attachments: int = 0, metadata: int = 0) -> bytes:
    return pack(
        Statistics(
            attachment_count=attachments, channel_count=1, channel_message_counts={1: 2}, chunk_count=0,
            message_count=2, message_end_time=9, message_start_time=1, metadata_count=metadata, schema_count=1,
        )
    )  # fmt: skip


def index(offset: int = 4000) -> AttachmentIndex:
    return AttachmentIndex(
        offset=offset, length=99, log_time=1, create_time=2, data_size=5, name="a", media_type="text/plain"
    )


#: Ends with and without attachments, statistics and a summary.
ENDS = {
    "no summary": FileEnd(DATA_END, None),
    "empty summary": FileEnd(DATA_END, ()),
    "statistics": FileEnd(DATA_END, ((records.STATISTICS, statistics()),)),
    "an attachment": FileEnd(
        DATA_END, ((records.STATISTICS, statistics(1)), (records.ATTACHMENT_INDEX, pack(index(3000))))
    ),
    "a group behind it": FileEnd(
        DATA_END,
        ((records.ATTACHMENT_INDEX, pack(index(3000))), (records.STATISTICS, statistics(1))),
    ),
    "an empty group": FileEnd(DATA_END, ((records.STATISTICS, statistics()), (records.ATTACHMENT_INDEX, b""))),
    "no statistics": FileEnd(b"", ((records.SCHEMA, build.record(build.SCHEMA, build.schema(1, "a", "", b""))),)),
}


def test_the_bytes_of_a_summary_are_those_of_the_format() -> None:
    """https://mcap.dev/spec: groups, an offset for each, then a footer whose checksum covers all but itself."""
    group = statistics()
    offset = build.record(build.SUMMARY_OFFSET, struct.pack("<BQQ", records.STATISTICS, AT, len(group)))
    begin = build.record(build.FOOTER, struct.pack("<QQ", AT, AT + len(group)), 20)
    crc = zlib.crc32(group + offset + begin)
    assert pack_summary(AT, [(records.STATISTICS, group)]) == group + offset + begin + struct.pack("<I", crc) + MAGIC


@table("name", ENDS)
def test_an_end_is_taken_apart_and_put_together_anywhere(name: str) -> None:
    end = ENDS[name]
    for at in (AT, 0, 2**40):
        data = end.pack(at)
        assert data.startswith(end.data_end) and data.endswith(MAGIC)
        if at or end.data_end or end.groups is None:  # at 0: there is no summary
            assert FileEnd.parse(data, at) == end


def test_the_end_of_a_file_of_the_library_is_read() -> None:
    """Those of other writers only if they spell it as we do: here without anything."""
    data = build.record(build.DATA_END, bytes(4)) + build.record(build.FOOTER, bytes(20)) + MAGIC
    assert FileEnd.parse(data, AT) == FileEnd(build.record(build.DATA_END, bytes(4)), None)


@table(
    ("data", "reason"),
    [
        (b"", "end: found no footer"),
        (bytes(36), "end: found no footer"),
        (DATA_END + build.record(build.FOOTER, bytes(16) + b"\1\0\0\0") + MAGIC, "in another spelling"),
        (DATA_END + build.record(build.FOOTER, bytes(20)) + MAGIC[:-1] + b"\0", "in another spelling"),
        (build.record(build.FOOTER, struct.pack("<QQI", AT - 1, AT, 0)) + MAGIC, "found a footer with other offsets"),
        (build.record(build.FOOTER, struct.pack("<QQI", AT, AT + 1, 0)) + MAGIC, "found a footer with other offsets"),
        (build.record(build.FOOTER, struct.pack("<QQI", AT + 5, AT, 0)) + MAGIC, "found a footer with other offsets"),
        (build.record(build.FOOTER, struct.pack("<QQI", AT, AT, 1)) + MAGIC, "in another spelling than that of"),
    ],
)
def test_what_is_another_end(data: bytes, reason: str) -> None:
    with pytest.raises(Malformed) as error:
        FileEnd.parse(data, AT)
    assert reason in str(error.value)


@given(st.sampled_from(sorted(ENDS)), st.data())
def test_every_changed_byte_is_found_or_is_of_a_group(name: str, data: st.DataObject) -> None:
    end = ENDS[name]
    whole = bytearray(end.pack(AT))
    place = data.draw(st.integers(len(end.data_end), len(whole) - 1))
    whole[place] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(Malformed):  # the checksum of the summary covers it
        FileEnd.parse(bytes(whole), AT)


@table("name", ENDS)
def test_an_attachment_that_comes_and_goes_leaves_the_end_as_it_was(name: str) -> None:
    end = ENDS[name]
    more = end.with_attachment(index())
    assert end in list(more.without_attachment(index()))
    assert len(list(more.without_attachment(index()))) <= 2
    if end.groups is None:
        assert more is end
        return
    groups = dict(more.groups or ())
    assert groups[records.ATTACHMENT_INDEX] == dict(end.groups).get(records.ATTACHMENT_INDEX, b"") + pack(index())
    if records.STATISTICS in groups:
        before = records.parse_statistics(dict(end.groups)[records.STATISTICS][9:])
        after = records.parse_statistics(groups[records.STATISTICS][9:])
        assert after.attachment_count == before.attachment_count + 1
        assert after.metadata_count == before.metadata_count


def test_the_end_without_an_attachment_that_it_has_not() -> None:
    for end in (ENDS["an attachment"], ENDS["a group behind it"]):
        assert list(end.without_attachment(index(4001))) == []
    with pytest.raises(Malformed, match="found another number of attachments"):
        list(ENDS["statistics"].without_attachment(index()))


def test_an_attachment_that_another_one_follows_is_not_the_last() -> None:
    both = FileEnd(
        DATA_END, ((records.STATISTICS, statistics(2)), (records.ATTACHMENT_INDEX, pack(index(1), index(2))))
    )
    assert list(both.without_attachment(index(1))) == []
    one = FileEnd(DATA_END, ((records.STATISTICS, statistics(1)), (records.ATTACHMENT_INDEX, pack(index(1)))))
    assert {each == one for each in both.without_attachment(index(2))} == {True}


@table(
    ("before", "more", "after"),
    [
        ((0, 0), (1, 2), (1, 2)),
        ((5, 7), (-5, -7), (0, 0)),
        ((2**32 - 2, 0), (1, 0), (2**32 - 1, 0)),
        ((2**32 - 1, 0), (1, 0), None),
        ((0, 0), (-1, 0), None),
        ((0, 0), (0, -1), None),
        ((0, 2**32 - 1), (0, 1), None),
    ],
)
def test_counts(before: tuple[int, int], more: tuple[int, int], after: tuple[int, int] | None) -> None:
    if after is None:
        with pytest.raises(Malformed, match="end: found another number of attachments or metadata records"):
            counted(statistics(*before), attachments=more[0], metadata=more[1])
        return
    assert counted(statistics(*before), attachments=more[0], metadata=more[1]) == statistics(*after)
