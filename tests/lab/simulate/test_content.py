"""The hash of a session's content: it sees every field, and nothing of the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.compression import COMPRESSIONS
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway_lab.simulate.content import ContentDigest
from tests.record import samples

ENTRIES = [samples.ros(1), samples.igtl(2), samples.ros(3)]


def digest(entries: list[Entry]) -> str:
    content = ContentDigest()
    for entry in entries:
        content.update(entry)
    return content.hexdigest()


def test_every_field_counts() -> None:
    one = ENTRIES[1]
    others = [
        replace(one, seq=one.seq + 1),
        replace(one, stamp_ns=one.stamp_ns + 1),
        replace(one, source_ns=one.source_ns + 1),
        replace(one, links=(*one.links, 9)),
        replace(one, channel=one.channel + "x"),
        replace(one, type=one.type + "x"),
        replace(one, payload=(*one.payload, b"x")),
    ]
    assert len({digest([entry]) for entry in [one, *others]}) == len(others) + 1
    assert digest(ENTRIES) != digest(ENTRIES[::-1])


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_whatever_packs_the_file_the_content_is_the_same(compression: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = SessionWriter(path, {}, compression=compression)  # type: ignore[arg-type]
    for entry in ENTRIES:
        writer.write(entry)
    writer.close({})
    with SessionFile.open(path) as file:
        assert digest(list(file.entries())) == digest(ENTRIES)
