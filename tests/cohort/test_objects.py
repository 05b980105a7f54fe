"""Objects are listed by their names and read by ranges; the store is one in memory."""

from __future__ import annotations

import io
import random
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("obstore", reason='needs obstore: pip install "igtl-gateway[cohort]"')

import obstore

from igtl_gateway.cohort import objects
from igtl_gateway.cohort.jobs import run_job
from igtl_gateway.cohort.objects import BLOCK, ObjectFile, Unreachable
from igtl_gateway.cohort.sources import locate

FIXTURES = Path(__file__).parents[2] / "fixtures"


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Any:
    """An empty store behind every URL."""
    from obstore.store import MemoryStore

    memory = MemoryStore()
    monkeypatch.setattr(objects, "_store", lambda root: memory)
    return memory


def test_objects_are_found_by_name_folder_and_wildcard(store: Any) -> None:
    for name in ("2026/a.mcap", "2026/b/c.mcap", "2026/notes.txt", "2025/d.mcap"):
        obstore.put(store, name, b"12345")
    assert [each.name for each in locate(["s3://bucket/2026/"])] == [
        "s3://bucket/2026/a.mcap",
        "s3://bucket/2026/b/c.mcap",
    ]
    assert [each.name for each in locate(["s3://bucket/202?/[ad].mcap"])] == [
        "s3://bucket/2025/d.mcap",
        "s3://bucket/2026/a.mcap",
    ]
    [one] = locate(["s3://bucket/2025/d.mcap"])
    before = one.mark
    obstore.put(store, "2025/d.mcap", b"54321")
    assert locate(["s3://bucket/2025/d.mcap"])[0].mark != before
    with pytest.raises(Unreachable, match=r"s3://bucket/none\.mcap"):
        locate(["s3://bucket/none.mcap"])


def test_ranges_give_the_bytes_and_small_reads_share_requests(store: Any) -> None:
    data = random.Random(1).randbytes(9 * BLOCK + 1234)
    obstore.put(store, "x.mcap", data)
    raw = ObjectFile("s3://bucket/x.mcap", len(data))
    with io.BufferedReader(raw, 4096) as stream:
        chance = random.Random(2)
        for _ in range(300):
            start, count = chance.randrange(len(data)), chance.choice((1, 9, 900, BLOCK + 7))
            stream.seek(start)
            assert stream.read(count) == data[start : start + count]
        assert raw.requests < 120  # one for each large read, ten for the small ones


def test_info_reads_the_index_of_an_object_and_not_the_whole(store: Any) -> None:
    path = FIXTURES / "star.mcap"
    obstore.put(store, "star.mcap", path.read_bytes())
    size = path.stat().st_size
    job = {"name": "s3://bucket/star.mcap", "size": size, "verb": "info", "settings": {}, "limits": [], "content": ""}
    found = run_job(job)
    local = run_job(job | {"name": str(path)})
    assert found["rows"] == local["rows"]
    assert found["status"] == "ok"
    assert found["bytes_read"] < size // 2, found
    assert run_job(job | {"name": "s3://bucket/gone.mcap"})["status"] == "unreachable"
    assert run_job(job | {"size": size - 5})["status"] == "broken"
