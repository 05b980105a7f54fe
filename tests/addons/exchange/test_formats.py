"""Which importer a file gets."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.formats import FORMATS, open_source
from igtl_gateway.base.errors import UnsupportedRecording
from tests.tables import table


@table(
    ("start", "name"),
    [
        (b"#ROSBAG V2.0\n", "rosbag1"),
        (b"\x89MCAP0\r\n", "rosbag2"),
        (b"SQLite format 3\0", "rosbag2"),
        (b"ObjectType = Image\n", "sequence"),
        (b"NRRD0004\n", "sequence"),
        (b"\xd4\xc3\xb2\xa1", "pcap"),
        (b"\0\1TRANSFORM".ljust(58, b"\0"), "igtl"),
        (b"\0\1TRANSFORM", None),
        (b"PK\3\4", None),
        (b"", None),
    ],
)
def test_the_content_tells(start: bytes, name: str | None) -> None:
    assert [kind.name for kind in FORMATS if kind.recognise(start)] == ([name] if name else [])


def test_what_cannot_be_imported_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedRecording, match="no such file"):
        open_source(tmp_path / "absent.bag")
    with pytest.raises(UnsupportedRecording, match="found a directory without"):
        open_source(tmp_path)
    (tmp_path / "some.zip").write_bytes(b"PK\3\4")
    with pytest.raises(UnsupportedRecording, match=r"expected one of these: \.bag"):
        open_source(tmp_path / "some.zip")
