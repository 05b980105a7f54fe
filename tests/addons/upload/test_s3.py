"""The protocol of S3 by tables: what a request has, what an answer means, and where keys and endpoint come from."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.upload import s3
from igtl_gateway.addons.upload.place import UploadPlace
from igtl_gateway.addons.upload.s3 import RateLimit, S3Store, StoredObject, StoreError, sign
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import ConfigError
from tests.addons.upload.store import Store, running_store
from tests.tables import table

PLACE, SECRET = UploadPlace("bucket", "or1"), "s3cr3t/KEY+of=the+store"
ENVIRONMENT = (
    "AWS_ENDPOINT_URL AWS_ENDPOINT_URL_S3 AWS_ACCESS_KEY_ID AWS_SECRET_ACCESS_KEY AWS_SESSION_TOKEN AWS_PROFILE "
    "AWS_REGION AWS_DEFAULT_REGION AWS_SHARED_CREDENTIALS_FILE AWS_CONFIG_FILE AWS_ALLOW_HTTP"
).split()


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nothing of the user who runs the tests."""
    for name in ENVIRONMENT:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with running_store() as found:
        monkeypatch.setenv("AWS_ENDPOINT_URL", found.url)
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "key")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
        yield found


def opened(place: UploadPlace = PLACE) -> S3Store:
    clock = ManualClock(1_369_353_600_000_000_000)
    return S3Store(place, RateLimit(0, clock), clock)


#: The examples of the documentation of AWS, "Signature Calculations for the Authorization Header".
EXAMPLES = {
    "GET of a list": (
        "GET\n/\nmax-keys=2&prefix=J", {}, hashlib.sha256(b"").hexdigest(),
        "34b48302e7b5fa45bde8084f4b7868a86f0a534bc59db6670ed5711ef69dc6f7",
    ),
    "PUT": (
        "PUT\n/test%24file.text\n",
        {"date": "Fri, 24 May 2013 00:00:00 GMT", "x-amz-storage-class": "REDUCED_REDUNDANCY"},
        hashlib.sha256(b"Welcome to Amazon S3.").hexdigest(),
        "98ad721746da40c64f1a55b78f14c238d841ea1380cd77a1b5971af0ece108bd",
    ),
}  # fmt: skip


@table("name", EXAMPLES)
def test_signatures_are_those_of_the_documentation(name: str) -> None:
    target, headers, digest, expected = EXAMPLES[name]
    given = headers | {
        "host": "examplebucket.s3.amazonaws.com", "x-amz-content-sha256": digest, "x-amz-date": "20130524T000000Z"
    }  # fmt: skip
    found = sign("wJalrXUtnFEMI/K7MDENG/bPxRfiCYEXAMPLEKEY", "20130524T000000Z", "us-east-1", target, given, digest)
    assert found == expected


#: Environment → encrypted, host, port; or the error.
ENDPOINTS: dict[str, tuple[dict[str, str], tuple[bool, str, int] | str]] = {
    "usual": ({}, (True, "s3.us-east-1.amazonaws.com", 443)),
    "region": ({"AWS_REGION": "eu-west-1", "AWS_DEFAULT_REGION": "x"}, (True, "s3.eu-west-1.amazonaws.com", 443)),
    "default region": ({"AWS_DEFAULT_REGION": "eu-west-3"}, (True, "s3.eu-west-3.amazonaws.com", 443)),
    "no region": ({"AWS_REGION": "a/b"}, (True, "s3.us-east-1.amazonaws.com", 443)),
    "a long region": ({"AWS_REGION": "a" * 41}, (True, "s3.us-east-1.amazonaws.com", 443)),
    "host": ({"AWS_ENDPOINT_URL": "https://store.example"}, (True, "store.example", 443)),
    "port": ({"AWS_ENDPOINT_URL": "https://store.example:9000/"}, (True, "store.example", 9000)),
    "that of S3 first": (
        {"AWS_ENDPOINT_URL": "https://a.example", "AWS_ENDPOINT_URL_S3": "https://b.example"}, (True, "b.example", 443)
    ),
    "local": ({"AWS_ENDPOINT_URL": "http://localhost"}, (False, "localhost", 80)),
    "loopback": ({"AWS_ENDPOINT_URL": "http://127.0.0.5:9000"}, (False, "127.0.0.5", 9000)),
    "loopback of IPv6": ({"AWS_ENDPOINT_URL": "http://[::1]:9000"}, (False, "::1", 9000)),
    "plain": ({"AWS_ENDPOINT_URL": "http://store.example"}, "found http://store.example, expected https://"),
    "plain address": ({"AWS_ENDPOINT_URL": "http://10.0.0.1"}, "found http://10.0.0.1, expected https://"),
    "plain, allowed": (
        {"AWS_ENDPOINT_URL": "http://store.example", "AWS_ALLOW_HTTP": "true"}, (False, "store.example", 80)
    ),
    "a path": ({"AWS_ENDPOINT_URL": "https://store.example/a"}, "expected https://HOST"),
    "a user": ({"AWS_ENDPOINT_URL": f"https://{SECRET}@store.example"}, "expected https://HOST"),
    "another scheme": ({"AWS_ENDPOINT_URL": "ftp://store.example"}, "expected https://HOST"),
    "no host": ({"AWS_ENDPOINT_URL": "https://"}, "expected https://HOST"),
    "no port": ({"AWS_ENDPOINT_URL": "https://store.example:x"}, "expected https://HOST"),
}  # fmt: skip


@table("name", ENDPOINTS)
def test_the_endpoint(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given, expected = ENDPOINTS[name]
    for key, value in given.items():
        monkeypatch.setenv(key, value)
    if isinstance(expected, str):
        with pytest.raises(ConfigError, match=expected) as error:
            opened()
        assert SECRET not in str(error.value)
        return
    found = opened()
    assert (found._secure, found._host, found._port) == expected


CREDENTIALS = f"[default]\naws_access_key_id = file\naws_secret_access_key = {SECRET}\n[lab]\naws_access_key_id = lab\n"
#: Environment, file of keys → access key, token; or the error.
KEYS: dict[str, tuple[dict[str, str], str, tuple[str, str] | str]] = {
    "environment": ({"AWS_ACCESS_KEY_ID": "env", "AWS_SECRET_ACCESS_KEY": "x"}, CREDENTIALS, ("env", "")),
    "token": (
        {"AWS_ACCESS_KEY_ID": "env", "AWS_SECRET_ACCESS_KEY": "x", "AWS_SESSION_TOKEN": "t"}, "", ("env", "t")
    ),
    "half of the environment": ({"AWS_ACCESS_KEY_ID": "env"}, CREDENTIALS, ("file", "")),
    "the other half": ({"AWS_SECRET_ACCESS_KEY": "x"}, CREDENTIALS, ("file", "")),
    "file": ({}, CREDENTIALS, ("file", "")),
    "token of the file": ({}, CREDENTIALS.replace("[lab]", "aws_session_token = t\n[lab]"), ("file", "t")),
    "half of a profile": ({"AWS_PROFILE": "lab"}, CREDENTIALS, "found no keys"),
    "no profile": ({"AWS_PROFILE": "none"}, CREDENTIALS, "found no keys"),
    "no file": ({}, "", "found no keys"),
    "no such file": ({}, "not a file of keys", "found no keys"),
    "a line break": ({"AWS_ACCESS_KEY_ID": "a\nb", "AWS_SECRET_ACCESS_KEY": "x"}, "", "spaces or control characters"),
    "a space in the token": (
        {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "x", "AWS_SESSION_TOKEN": "t t"}, "",
        "spaces or control characters",
    ),
}  # fmt: skip


@table("name", KEYS)
def test_where_keys_come_from(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    given, text, expected = KEYS[name]
    path = tmp_path / "credentials"
    path.write_text(text)
    for key, value in {"AWS_SHARED_CREDENTIALS_FILE": str(path), **given}.items():
        monkeypatch.setenv(key, value)
    if isinstance(expected, str):
        with pytest.raises(StoreError, match=expected) as error:
            s3._keys()
        assert SECRET not in str(error.value)
        return
    found = s3._keys()
    assert (found.access, found.token) == expected
    assert found.secret == (SECRET if found.access == "file" else "x")


def test_the_region_of_a_profile(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "config"
    path.write_text("[default]\nregion = eu-west-1\n[profile lab]\nregion = eu-west-2\n")
    monkeypatch.setenv("AWS_CONFIG_FILE", str(path))
    assert s3._region() == "eu-west-1"
    monkeypatch.setenv("AWS_PROFILE", "lab")
    assert s3._region() == "eu-west-2"
    path.write_text("[profile lab]\nregion = eu-west-3\n")
    assert s3._region() == "eu-west-3", "a file that changes is read again"


def test_an_object_is_stated_as_the_store_states_it(store: Store) -> None:
    found = opened()
    assert found.find("or1/a") is None
    found.put("or1/a", b"data", "sha")
    tag = hashlib.md5(b"data", usedforsecurity=False).hexdigest()
    assert found.find("or1/a") == StoredObject(4, tag, "sha", "")
    store.fault = lambda *_: (200, {"etag": '"t"', "x-amz-checksum-sha256": "c", "content-length": "7"}, b"")
    assert found.find("or1/a") == StoredObject(7, "t", "", "c")
    with pytest.raises(StoreError) as error:
        store.fault = lambda *_: None
        found.put("or1/a", b"other", "sha")
    assert error.value.exists and store.objects["or1/a"][0] == b"data"
    found.close()


def test_an_object_of_parts(store: Store) -> None:
    found = opened()
    upload = found.begin("or1/a", "sha")
    parts = [bytes([number]) * 9 for number in range(5)]
    tags = [found.put_part("or1/a", upload, number, data) for number, data in enumerate(parts, 1)]
    assert tags == [hashlib.md5(data, usedforsecurity=False).hexdigest() for data in parts]
    assert found.parts("or1/a", upload) == {number: (tag, 9) for number, tag in enumerate(tags, 1)}, "two a page"
    found.complete(
        "or1/a", upload, [(tag, hashlib.sha256(data).digest()) for tag, data in zip(tags, parts, strict=True)]
    )
    assert store.objects["or1/a"][0] == b"".join(parts)
    upload = found.begin("or1/b", "sha")
    found.abort("or1/b", upload)
    with pytest.raises(StoreError, match=r"no such bucket or upload \(NoSuchUpload\)") as error:
        found.parts("or1/b", upload)
    assert error.value.status == 404
    found.close()


#: Answer of the store → text, status and code of the error.
ANSWERS: dict[str, tuple[tuple[int, dict[str, str], bytes], str, int, str, bool]] = {
    "denied": ((403, {}, b"<Code>AccessDenied</Code>"), "access denied (AccessDenied)", 403, "AccessDenied", False),
    "exists": ((412, {}, b"<Code>PreconditionFailed</Code>"), "status 412", 412, "PreconditionFailed", True),
    "conflict": ((409, {}, b""), "status 409", 409, "", True),
    "redirect": ((301, {"location": "/"}, b""), "found a redirect (301), which is not followed", 301, "", False),
    "error": ((500, {}, b"<Code>a&amp;b</Code>"), "status 500 (a&b)", 500, "a&b", False),
    "no bucket": ((404, {}, b"<Code>NoSuchBucket</Code>"), "no such bucket or upload", 404, "NoSuchBucket", False),
}


@table("name", ANSWERS)
def test_what_an_answer_means(name: str, store: Store) -> None:
    answer, text, status, code, exists = ANSWERS[name]
    store.fault = lambda *_: answer
    with pytest.raises(StoreError) as error:
        opened().put("or1/a", b"data", "sha")
    assert text in str(error.value) and "127.0.0.1" in str(error.value)
    assert (error.value.status, error.value.code, error.value.exists) == (status, code, exists)


@table(("body", "status"), [(b"", None), (b"<Code>NoSuchKey</Code>", None), (b"<Code>NoSuchBucket</Code>", 404)])
def test_no_object_is_no_error_and_no_bucket_is(body: bytes, status: int | None) -> None:
    """HEAD has no content: the code is read where a store sends one."""
    found: Any = S3Store.__new__(S3Store)

    def ask(*_: object, **__: object) -> None:
        raise StoreError("x", 404, s3._Answer(404, {}, body).word("Code"))

    found._ask = ask
    if status is None:
        assert found.find("a") is None
        return
    with pytest.raises(StoreError):
        found.find("a")


def test_an_error_behind_the_status_of_success(store: Store) -> None:
    for code, exists in (("PreconditionFailed", True), ("InternalError", False)):
        store.fault = lambda *_, code=code: (200, {}, f"<Error><Code>{code}</Code></Error>".encode())
        with pytest.raises(StoreError, match=f"the store reports {code}") as error:
            opened().complete("or1/a", "u", [])
        assert (error.value.exists, error.value.code) == (exists, code)
    store.fault = lambda *_: (200, {}, b"<X></X>")
    with pytest.raises(StoreError, match="without an UploadId"):
        opened().begin("or1/a", "sha")


def test_what_is_sent_is_counted_and_in_its_place(store: Store) -> None:
    sent: list[int] = []
    clock = ManualClock(1_369_353_600_000_000_000)
    found = S3Store(UploadPlace("bucket"), RateLimit(0, clock), clock, sent.append)
    assert (found.key("a b/ä.mcap"), opened().key("a")) == ("a b/ä.mcap", "or1/a")
    data = bytes(70_000)
    found.put("a b/ä.mcap", data, "sha")
    assert sent == [32_768, 32_768, 70_000 - 65_536]
    assert store.objects["a b/ä.mcap"][0] == data
    found.complete("x", found.begin("x", "sha"), [])
    assert len(sent) == 3, "the list of parts is no content"


@table(
    ("url", "host"),
    [
        ("http://localhost:80", "localhost"),
        ("http://localhost:443", "localhost:443"),
        ("https://a.example", "a.example"),
        ("https://a.example:443", "a.example"),
        ("https://a.example:80", "a.example:80"),
    ],
)
def test_the_usual_port_is_not_in_the_host(url: str, host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", url)
    headers = opened()._signed(
        s3._Keys("key", SECRET, "", "us-east-1"), "GET", "/bucket/a", "", s3._EMPTY, {"range": "x"}
    )
    assert (headers["host"], headers["x-amz-date"]) == (host, "20130524T000000Z")
    assert "x-amz-security-token" not in headers
    assert "SignedHeaders=host;range;x-amz-content-sha256;x-amz-date" in headers["authorization"]
    assert "Credential=key/20130524/us-east-1/s3/aws4_request" in headers["authorization"]
    token = opened()._signed(s3._Keys("key", SECRET, "t", "us-east-1"), "GET", "/bucket/a", "", s3._EMPTY, {})
    assert token["x-amz-security-token"] == "t" and ";x-amz-security-token" in token["authorization"]


def _connection(store: S3Store) -> object:
    return store._connection


def test_a_connection_is_kept_until_it_is_closed(store: Store) -> None:
    found = opened()
    found.find("or1/a")
    connection = found._connection
    assert connection and connection.sock
    found.find("or1/b")
    assert _connection(found) is connection, "one for all requests"
    found.close()
    assert _connection(found) is None and vars(connection)["sock"] is None
    store.fault = lambda *_: (200, {"connection": "close", "content-length": "0"}, b"")
    found.find("or1/a")
    assert _connection(found) is None
    assert (StoreError("x").status, StoreError("x").code) == (0, "")


def test_a_part_list_that_repeats_itself_ends(store: Store) -> None:
    row = "<Part><PartNumber>3</PartNumber><ETag>&quot;t&quot;</ETag><Size>9</Size></Part>"
    bad = (
        "<Part><PartNumber>x</PartNumber><Size>9</Size></Part><Part><PartNumber>10001</PartNumber><Size>1</Size></Part>"
    )
    body = f"<X><IsTruncated>true</IsTruncated><NextPartNumberMarker>3</NextPartNumberMarker>{row}{bad}</X>".encode()
    store.fault = lambda *_: (200, {}, body)
    assert opened().parts("or1/a", "u") == {3: ("t", 9)}
    assert [query["part-number-marker"] for _, _, query in store.requests] == ["0", "3"]


def test_an_answer_without_end_is_not_read(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(s3, "_MOST_ANSWER", 1_000)
    store.fault = lambda *_: (200, {}, bytes(1_000))
    opened().parts("or1/a", "u")
    store.fault = lambda *_: (200, {}, bytes(1_001))
    with pytest.raises(StoreError, match="found an answer of more than 1000 bytes"):
        opened().parts("or1/a", "u")


def test_the_checksum_of_what_is_sent(store: Store) -> None:
    assert s3._checksum(b"data")["x-amz-checksum-sha256"] == base64.b64encode(hashlib.sha256(b"data").digest()).decode()


def test_a_rate_waits_for_what_was_sent_before(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, waits = ManualClock(0), list[float]()
    limit = RateLimit(100.0, clock)
    monkeypatch.setattr(limit._never, "wait", waits.append)
    limit.wait(50)
    limit.wait(100)
    clock.advance(10_000_000_000)
    limit.wait(25)
    assert waits == [0.5, 1.5, 0.25]
    free = RateLimit(0, clock)
    monkeypatch.setattr(free._never, "wait", waits.append)
    free.wait(1 << 40)
    assert len(waits) == 3
