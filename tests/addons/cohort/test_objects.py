"""Objects are listed by their names and read by ranges; the store is one in memory."""

from __future__ import annotations

import io
import random
from collections.abc import Iterator
from datetime import timedelta
from typing import Any

import pytest

pytest.importorskip("obstore", reason='needs obstore: pip install "igtl-gateway[cohort]"')

import obstore

from igtl_gateway.addons.cohort import objects
from igtl_gateway.addons.cohort.jobs import run_job
from igtl_gateway.addons.cohort.objects import BLOCK, ObjectFile, Unreachable
from igtl_gateway.addons.cohort.sources import Located, locate
from igtl_gateway.base.errors import ConfigError
from tests.addons.cohort import s3_server
from tests.places import FIXTURES
from tests.timing import at_once

INFO: dict[str, Any] = {"verb": "info", "settings": {}, "limits": [], "content": ""}


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
    job = {"name": "s3://bucket/star.mcap", "size": size, "e_tag": "", **INFO}
    found = run_job(job)
    local = run_job(job | {"name": str(path)})
    assert found["rows"] == local["rows"]
    assert found["status"] == "ok"
    assert found["bytes_read"] < size // 2, found
    assert run_job(job | {"name": "s3://bucket/gone.mcap"})["status"] == "unreachable"
    assert "found another object" in run_job(job | {"size": size - 5})["error"]


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[s3_server.Bucket]:
    """A server with one session of 7 MB; requests are tried again for a moment only."""
    backoff = {"init_backoff": timedelta(milliseconds=5), "max_backoff": timedelta(milliseconds=20), "base": 2}
    monkeypatch.setattr(objects, "RETRY", {"max_retries": 2, "retry_timeout": timedelta(seconds=3), "backoff": backoff})
    with s3_server.bucket() as server:
        for name, value in (
            ("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}"),
            ("AWS_ALLOW_HTTP", "true"),
            ("AWS_ACCESS_KEY_ID", "AKIASECRET"),
            ("AWS_SECRET_ACCESS_KEY", "hunter2"),
            ("AWS_DEFAULT_REGION", "us-east-1"),
            ("AWS_TIMEOUT", "400ms"),
        ):
            monkeypatch.setenv(name, value)
        server.objects["a b/#?ä%.mcap"] = (FIXTURES / "star.mcap").read_bytes()
        yield server


def job_of(found: Located) -> dict[str, Any]:
    return {"name": found.name, "size": found.size, "e_tag": found.e_tag, **INFO}


def test_info_reads_ranges_over_the_network(bucket: s3_server.Bucket) -> None:
    [found] = locate(["s3://bucket"])
    assert found.name == "s3://bucket/a b/#?ä%.mcap"
    reply = run_job(job_of(found))
    assert reply["status"] == "ok", reply
    assert reply["rows"] == run_job(job_of(found) | {"name": str(FIXTURES / "star.mcap")})["rows"]
    assert bucket.reads == reply["requests"] < 40
    assert bucket.sent - reply["bytes_read"] < 1000  # the rest is the list
    assert reply["bytes_read"] < found.size // 2


@pytest.mark.parametrize("fault", [s3_server.wait(1.0), s3_server.refuse, s3_server.cut], ids=["slow", "500", "cut"])
@pytest.mark.parametrize("after", [0, 1])
def test_a_store_with_a_fault_is_a_row_without_data(bucket: s3_server.Bucket, fault: Any, after: int) -> None:
    [found] = locate(["s3://bucket"])
    bucket.fault = lambda handler: bucket.reads > after and fault(handler)
    with at_once():
        reply = run_job(job_of(found))
    assert (reply["status"], reply["rows"]) == ("unreachable", {})
    assert reply["error"].startswith("s3://bucket/a b/#?ä%.mcap: ")
    assert "hunter2" not in str(reply)
    assert "AKIASECRET" not in str(reply)


def test_a_fault_that_ends_is_no_fault(bucket: s3_server.Bucket) -> None:
    [found] = locate(["s3://bucket"])
    bucket.fault = lambda handler: bucket.reads == 2 and s3_server.refuse(handler)
    assert run_job(job_of(found))["status"] == "ok"


@pytest.mark.parametrize("longer", [0, 1])
def test_an_object_that_changes_in_the_middle_is_a_row_without_data(bucket: s3_server.Bucket, longer: int) -> None:
    [found] = locate(["s3://bucket"])

    def change(handler: Any) -> bool:
        if bucket.reads == 2:
            name, data = bucket.objects.popitem()
            bucket.objects[name] = data[:-9] + bytes(9 + longer)
        return False

    bucket.fault = change
    for job in (job_of(found), job_of(found) | {"e_tag": ""})[: 1 + longer]:
        bucket.reads = 0
        reply = run_job(job)
        assert (reply["status"], reply["rows"]) == ("unreachable", {})
        assert "found another object than at the beginning" in reply["error"]


def test_a_password_in_a_url_is_refused_and_not_shown() -> None:
    with pytest.raises(ConfigError, match="expected credentials in the environment") as raised:
        locate(["https://me:hunter2@host/x.mcap"])
    assert "hunter2" not in str(raised.value)
