"""A damaged index of messages is reported, and one of another program that is sound is not."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES
from tests.record import samples


@pytest.mark.parametrize("verb", ["info", "verify", "lint"])
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
        assert found == 1
    path.write_bytes(whole[: (start := chunk.at + chunk.length)] + bytes(8) + whole[start + 8 :])
    assert main([verb, str(path)]) == 1
    out = capsys.readouterr().out
    assert ("the index of messages is damaged in 1 chunk" if verb == "lint" else "index of messages of 1 chunk") in out
    assert main(["recover", str(path), "-o", str(tmp_path / "b.mcap")]) == 0
    with SessionFile.open(tmp_path / "b.mcap") as file:
        assert file.damaged_indexes() == 0 and sum(1 for _ in file.entries()) == 199


@pytest.mark.parametrize("verb", ["info", "verify"])
def test_bytes_that_another_program_overwrites_while_it_is_recorded_are_found_later(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Chunks and the session have checksums, schemas and channels are in the summary, too.

    What no reader needs is not looked at: the second copy of the session, and the configuration as a file.
    """
    path, random, silent = tmp_path / "a.mcap", Random(29), []
    SessionWriter(path, samples.SESSION).close({})
    with SessionFile.open(path) as file:
        session, copy, configuration = *file._index.metadata[:2], file._index.attachments[0]
        needed = range(session.at, copy.at - 40), range(configuration.at + configuration.length, 1 << 20)
    path.unlink()
    for _ in range(25):
        writer = SessionWriter(path, samples.SESSION, chunk_bytes=3000)
        for one in range(1, 60):
            writer.write(samples.ros(one) if one % 3 else samples.igtl(one))
        written = path.stat().st_size
        at = random.choice([at for places in needed for at in places if at < written - 40])
        with path.open("r+b") as other:
            other.seek(at)
            other.write(random.randbytes(40))
        for one in range(60, 120):
            writer.write(samples.ros(one) if one % 3 else samples.igtl(one))
        writer.close({})
        code = main([verb, str(path)])
        said = "".join(capsys.readouterr())
        path.unlink()
        if code == 0 and "DAMAGED" not in said:
            silent.append(at)
    assert not silent


def test_zeros_on_offsets_only_are_found(tmp_path: Path) -> None:
    """Of each message except the first one of the chunk, which is at offset 0."""
    path = tmp_path / "a.mcap"
    writer = SessionWriter(path, samples.SESSION, chunk_bytes=4000)
    for number in range(1, 100):
        writer.write(samples.ros(number) if number % 3 else samples.igtl(number))
    writer.close({})
    with SessionFile.open(path) as file:
        chunk = [chunk for chunk in file._index.chunks if len(chunk.message_indexes) == 2][1]
    whole = path.read_bytes()
    places = [
        at
        for start in chunk.message_indexes.values()
        for at in range(start + 15 + 8, start + 9 + int.from_bytes(whole[start + 1 : start + 9], "little"), 16)
    ]
    assert len(places) > 5
    for place in places:
        for value in (0, chunk.size - 30, 1 << 63):
            data = bytearray(whole)
            data[place : place + 8] = value.to_bytes(8, "little")
            path.write_bytes(data)
            with SessionFile.open(path) as file:
                assert file.damaged_indexes() == (data != whole), (place, value)
    for start in chunk.message_indexes.values():  # from the number of its rows on: an index without rows
        length = int.from_bytes(whole[start + 1 : start + 9], "little")
        path.write_bytes(whole[: start + 11] + bytes(length - 2) + whole[start + 9 + length :])
        with SessionFile.open(path) as file:
            assert file.damaged_indexes() == 1


@pytest.mark.parametrize("name", ["star", "every-type", "crtk", "lego"])
def test_recordings_are_sound(name: str) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        assert file.damaged_indexes() == 0
