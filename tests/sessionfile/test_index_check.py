"""A damaged index of messages is reported, and one of another program that is sound is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.cli import main
from igtl_gateway.sessionfile.reader import SessionFile
from igtl_gateway.sessionfile.writer import SessionWriter
from tests.record import samples

FIXTURES = Path(__file__).parents[2] / "fixtures"


@pytest.mark.parametrize("verb", ["info", "verify"])
def test_a_zeroed_index_is_reported(verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.mcap"
    writer = SessionWriter(path, samples.SESSION, chunk_bytes=1500)
    for number in range(1, 200):
        writer.write(samples.ros(number))
    writer.close({})
    with SessionFile.open(path) as file:
        chunks = [chunk for chunk in file._index.chunks if chunk.places]
        assert len(chunks) > 3 and file.damaged_indexes() == 0
    whole = bytearray(path.read_bytes())
    chunk = chunks[1]
    for at, size in ((0, chunk.index_length), (0, 8), (chunk.index_length - 8, 8)):
        start = chunk.at + chunk.length + at
        data = whole.copy()
        data[start : start + size] = bytes(size)
        if data == whole:
            continue
        path.write_bytes(data)
        with SessionFile.open(path) as file:
            found = file.damaged_indexes()
        assert found == (at == 0), "the last bytes are an offset, which may be any number"
    path.write_bytes(whole[: (start := chunk.at + chunk.length)] + bytes(8) + whole[start + 8 :])
    assert main([verb, str(path)]) == 1
    assert "DAMAGED: the index of messages of 1 chunk" in capsys.readouterr().out
    assert main(["recover", str(path), "-o", str(tmp_path / "b.mcap")]) == 0
    with SessionFile.open(tmp_path / "b.mcap") as file:
        assert file.damaged_indexes() == 0 and sum(1 for _ in file.entries()) == 199


@pytest.mark.parametrize("name", ["star", "every-type", "crtk", "lego"])
def test_recordings_are_sound(name: str) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        assert file.damaged_indexes() == 0
