"""An object store with the protocol of S3: the few requests that an upload needs, over HTTP and TLS of Python.

A client library is not used: the usual one excludes versions of other libraries that this project pins, and those
without that problem cannot continue an upload that was interrupted.  Keys come from the environment or from the files
of AWS; they are in no message and in no file that this package writes.
"""

from __future__ import annotations

import base64
import configparser
import hashlib
import hmac
import html
import http.client
import os
import re
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import lru_cache
from ipaddress import ip_address
from pathlib import Path
from typing import Final
from urllib.parse import quote, urlsplit

from igtl_gateway.addon import NS_PER_S, Clock, ConfigError, UnsupportedRecording
from igtl_gateway.addon.untrusted import open_file, printable, whole_number
from igtl_gateway.addons.upload.place import UploadPlace

#: Longest wait for a step of a connection, seconds.
TIMEOUT_S = 30.0
#: Longest answer that is read, bytes: that to a list of 1,000 parts has 300 kB.
_MOST_ANSWER = 4 << 20
#: Largest number of a part that S3 has.
_MOST_PARTS = 10_000
#: Bytes that are sent at once.
_BLOCK = 32 << 10
_EMPTY: Final = hashlib.sha256(b"").hexdigest()
#: What a key may be: it goes to a header.
_WORD = re.compile(r"[!-~]{1,8192}")
_MOST_CONFIG = 1 << 20
_DENIED, _EXISTS = 403, (409, 412)


class StoreError(Exception):
    """The store did not do what it was asked for.

    Attributes:
        status: of the answer; 0 without one.
        code: the store's word for it, or "".
    """

    def __init__(self, text: str, status: int = 0, code: str = "") -> None:
        super().__init__(text)
        self.status = status
        self.code = code

    @property
    def exists(self) -> bool:
        """Whether there is an object with this key already."""
        return self.status in _EXISTS


@dataclass(frozen=True, slots=True)
class StoredObject:
    """What the store states about an object: bytes, its tag, our SHA-256 in its metadata, its own checksum or ""."""

    size: int
    etag: str
    sha256: str
    checksum: str


@dataclass(frozen=True, slots=True)
class _Keys:
    access: str
    secret: str
    token: str
    region: str


class RateLimit:
    """Limits the bytes of a second.

    Args:
        bytes_per_s: the limit; 0: there is none.
        clock: measures the time.
    """

    def __init__(self, bytes_per_s: float, clock: Clock) -> None:
        self._rate = bytes_per_s
        self._clock = clock
        self._free_ns = 0  # on the monotonic clock: when everything so far may have been sent
        self._never = threading.Event()

    def wait(self, count: int) -> None:
        """Wait until ``count`` bytes may be sent."""
        if self._rate <= 0:
            return
        now_ns = self._clock.monotonic_ns()
        self._free_ns = max(self._free_ns, now_ns) + int(count / self._rate * NS_PER_S)
        self._never.wait((self._free_ns - now_ns) / NS_PER_S)


@dataclass(frozen=True, slots=True)
class _Answer:
    status: int
    headers: Mapping[str, str]  # names in lower case
    body: bytes

    def word(self, name: str) -> str:
        """The text of the first element with this name, or ""."""
        found = re.search(rf"<{name}>([^<]{{1,2048}})</{name}>".encode(), self.body)
        return html.unescape(found[1].decode("utf-8", "replace")) if found else ""


class S3Store:
    """A bucket, or what is below a prefix of it.

    Args:
        place: the bucket and the prefix.
        rate: limits what is sent.
        clock: stamps requests.
        on_sent: called with the number of sent bytes of content.

    Raises ConfigError for a wrong endpoint in the environment.
    """

    def __init__(
        self, place: UploadPlace, rate: RateLimit, clock: Clock, on_sent: Callable[[int], None] = lambda _count: None
    ) -> None:
        self._place = place
        self._rate = rate
        self._clock = clock
        self._on_sent = on_sent
        self._region = _keys().region if _has_keys() else _region()
        text = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
        self._secure, self._host, self._port = _endpoint(text or f"https://s3.{self._region}.amazonaws.com")
        self._connection: http.client.HTTPConnection | None = None

    def key(self, name: str) -> str:
        """Return the key of a file."""
        return f"{self._place.prefix}/{name}" if self._place.prefix else name

    def find(self, key: str) -> StoredObject | None:
        """Return an object; None if there is none.  Raises StoreError."""
        try:
            answer = self._ask("HEAD", key, headers={"x-amz-checksum-mode": "ENABLED"})
        except StoreError as error:
            if error.status == 404 and error.code in ("", "NoSuchKey", "NotFound"):
                return None
            raise
        size = whole_number(answer.headers.get("content-length"))
        return StoredObject(
            -1 if size is None else size,
            answer.headers.get("etag", "").strip('"'),
            answer.headers.get("x-amz-meta-sha256", ""),
            answer.headers.get("x-amz-checksum-sha256", ""),
        )

    def put(self, key: str, data: bytes, sha256: str) -> None:
        """Create an object.  Raises StoreError, also if it exists."""
        self._ask("PUT", key, data=data, headers={"x-amz-meta-sha256": sha256, "if-none-match": "*"} | _checksum(data))

    def begin(self, key: str, sha256: str) -> str:
        """Begin an object of parts; return the identifier of the upload.  Raises StoreError."""
        headers = {"x-amz-meta-sha256": sha256, "x-amz-checksum-algorithm": "SHA256"}
        found = self._ask("POST", key, {"uploads": ""}, headers=headers).word("UploadId")
        if not found:
            raise StoreError("found an answer without an UploadId")
        return found

    def parts(self, key: str, upload: str) -> dict[int, tuple[str, int]]:
        """Return number → (tag, bytes) of the parts that the store has.  Raises StoreError."""
        found: dict[int, tuple[str, int]] = {}
        marker = 0
        while True:
            answer = self._ask("GET", key, {"uploadId": upload, "part-number-marker": str(marker)})
            for part in re.findall(rb"<Part>(.{1,4096}?)</Part>", answer.body, re.DOTALL):
                row = _Answer(200, {}, part)
                number, size = whole_number(row.word("PartNumber"), _MOST_PARTS), whole_number(row.word("Size"))
                if number is not None and size is not None:
                    found[number] = row.word("ETag").strip('"'), size
            after = whole_number(answer.word("NextPartNumberMarker"), _MOST_PARTS)
            if answer.word("IsTruncated") != "true" or after is None or after <= marker:
                return found
            marker = after

    def put_part(self, key: str, upload: str, number: int, data: bytes) -> str:
        """Send a part, from 1 on; return its tag.  Raises StoreError."""
        query = {"partNumber": str(number), "uploadId": upload}
        return self._ask("PUT", key, query, data, _checksum(data)).headers.get("etag", "").strip('"')

    def complete(self, key: str, upload: str, parts: list[tuple[str, bytes]]) -> None:
        """Make the object of its parts: tag and SHA-256 of each.  Raises StoreError, also if the object exists."""
        rows = "".join(
            f"<Part><PartNumber>{number}</PartNumber><ETag>&quot;{html.escape(tag)}&quot;</ETag>"
            f"<ChecksumSHA256>{base64.b64encode(digest).decode()}</ChecksumSHA256></Part>"
            for number, (tag, digest) in enumerate(parts, 1)
        )
        data = f"<CompleteMultipartUpload>{rows}</CompleteMultipartUpload>".encode()
        answer = self._ask("POST", key, {"uploadId": upload}, data, {"if-none-match": "*"}, counted=False)
        if code := answer.word("Code"):  # an error may come after the status
            raise StoreError(f"the store reports {printable(code)}", 409 if code == "PreconditionFailed" else 500, code)

    def abort(self, key: str, upload: str) -> None:
        """Remove the parts of an upload.  Raises StoreError."""
        self._ask("DELETE", key, {"uploadId": upload})

    def close(self) -> None:
        """Close the connection."""
        if self._connection:
            self._connection.close()
            self._connection = None

    # -- requests ------------------------------------------------------------------------------------------------

    def _ask(
        self,
        method: str,
        key: str,
        query: Mapping[str, str] | None = None,
        data: bytes = b"",
        headers: Mapping[str, str] | None = None,
        *,
        counted: bool = True,
    ) -> _Answer:
        keys = _keys()
        path = f"/{self._place.bucket}/{quote(key, safe='/-_.~')}"
        words = "&".join(
            f"{quote(name, safe='')}={quote(value, safe='')}" for name, value in sorted((query or {}).items())
        )
        digest = hashlib.sha256(data).hexdigest() if data else _EMPTY
        sent = self._signed(keys, method, path, words, digest, dict(headers or {}))
        try:
            answer = self._exchange(method, f"{path}?{words}" if words else path, sent, data, counted=counted)
        except (OSError, http.client.HTTPException) as error:
            self.close()
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise StoreError(f"{self._host}: {printable(reason)[:200]}") from None
        if 200 <= answer.status < 300:
            return answer
        code = printable(answer.word("Code"))[:80]
        if 300 <= answer.status < 400:
            raise StoreError(
                f"{self._host}: found a redirect ({answer.status}), which is not followed", answer.status, code
            )
        what = {_DENIED: "access denied", 404: "no such bucket or upload"}.get(answer.status, f"status {answer.status}")
        raise StoreError(f"{self._host}: {what}{f' ({code})' if code else ''}", answer.status, code)

    def _exchange(self, method: str, target: str, headers: Mapping[str, str], data: bytes, *, counted: bool) -> _Answer:
        """Send a request and read its answer.  Raises OSError, HTTPException."""
        connection = self._connection
        if connection is None:
            kind = http.client.HTTPSConnection if self._secure else http.client.HTTPConnection
            connection = self._connection = kind(self._host, self._port, timeout=TIMEOUT_S)
        connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.putheader("content-length", str(len(data)))
        connection.endheaders()
        for at in range(0, len(data), _BLOCK):
            block = data[at : at + _BLOCK]
            self._rate.wait(len(block))
            connection.send(block)
            if counted:
                self._on_sent(len(block))
        answer = connection.getresponse()
        body = answer.read(_MOST_ANSWER + 1)
        if len(body) > _MOST_ANSWER:
            raise http.client.HTTPException(f"found an answer of more than {_MOST_ANSWER} bytes")
        if answer.will_close:
            self.close()
        return _Answer(answer.status, {name.lower(): value for name, value in answer.getheaders()}, body)

    def _signed(
        self, keys: _Keys, method: str, path: str, query: str, digest: str, headers: dict[str, str]
    ) -> dict[str, str]:
        """Return the headers with the signature, version 4 of AWS."""
        now = datetime.fromtimestamp(self._clock.utc_ns() // NS_PER_S, timezone.utc)
        stamp, day = f"{now:%Y%m%dT%H%M%SZ}", f"{now:%Y%m%d}"
        usual = self._port == (443 if self._secure else 80)
        headers |= {"host": self._host if usual else f"{self._host}:{self._port}"}
        headers |= {"x-amz-date": stamp, "x-amz-content-sha256": digest}
        if keys.token:
            headers["x-amz-security-token"] = keys.token
        names = ";".join(sorted(headers))
        scope = f"{day}/{self._region}/s3/aws4_request"
        signature = sign(keys.secret, stamp, self._region, "\n".join([method, path, query]), headers, digest)
        headers["authorization"] = (
            f"AWS4-HMAC-SHA256 Credential={keys.access}/{scope}, SignedHeaders={names}, Signature={signature}"
        )
        return headers


def sign(secret: str, stamp: str, region: str, target: str, headers: Mapping[str, str], digest: str) -> str:
    """Return the signature of a request, version 4 of AWS, as hexadecimal digits.

    Args:
        secret: the secret key.
        stamp: UTC time of the request, as ``20130524T000000Z``.
        region: of the store.
        target: method, path and query, a line each.
        headers: those that are signed, by names in lower case.
        digest: SHA-256 of the content, as hexadecimal digits.
    """
    lines = "".join(f"{name}:{headers[name].strip()}\n" for name in sorted(headers))
    request = "\n".join([target, lines, ";".join(sorted(headers)), digest])
    scope = f"{stamp[:8]}/{region}/s3/aws4_request"
    text = "\n".join(["AWS4-HMAC-SHA256", stamp, scope, hashlib.sha256(request.encode()).hexdigest()])
    key = f"AWS4{secret}".encode()
    for word in scope.split("/"):
        key = hmac.digest(key, word.encode(), "sha256")
    return hmac.digest(key, text.encode(), "sha256").hex()


def _checksum(data: bytes) -> dict[str, str]:
    return {"x-amz-checksum-sha256": base64.b64encode(hashlib.sha256(data).digest()).decode()}


def _endpoint(text: str) -> tuple[bool, str, int]:
    """Parse the URL of a store: whether it is encrypted, host, port.  Raises ConfigError."""
    place = "environment: AWS_ENDPOINT_URL"
    with suppress(ValueError):
        found = urlsplit(text)
        if found.username is None and found.scheme in ("http", "https") and found.hostname and found.path in ("", "/"):
            secure = found.scheme == "https"
            if not secure and not _is_local(found.hostname) and os.environ.get("AWS_ALLOW_HTTP") != "true":
                raise ConfigError(f"{place}: found http://{found.hostname}, expected https:// (or AWS_ALLOW_HTTP=true)")
            return secure, found.hostname, found.port or (443 if secure else 80)
    raise ConfigError(f"{place}: expected https://HOST[:PORT]")


def _is_local(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _has_keys() -> bool:
    try:
        _keys()
    except StoreError:
        return False
    return True


def _keys() -> _Keys:
    """Return the keys of the environment, else those of the files of AWS.  Raises StoreError if there are none."""
    env = os.environ
    if env.get("AWS_ACCESS_KEY_ID") and env.get("AWS_SECRET_ACCESS_KEY"):
        access, secret, token = env["AWS_ACCESS_KEY_ID"], env["AWS_SECRET_ACCESS_KEY"], env.get("AWS_SESSION_TOKEN", "")
    else:
        section = _section("AWS_SHARED_CREDENTIALS_FILE", "~/.aws/credentials", env.get("AWS_PROFILE", "default"))
        access, secret = section.get("aws_access_key_id", ""), section.get("aws_secret_access_key", "")
        token = section.get("aws_session_token", "")
    if not (access and secret):
        raise StoreError("found no keys, expected AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or ~/.aws/credentials")
    if not all(_WORD.fullmatch(each) for each in (access, secret, token or "-")):
        raise StoreError("found keys with spaces or control characters, or of more than 8,192, expected those of S3")
    return _Keys(access, secret, token, _region())


def _region() -> str:
    env = os.environ
    profile = env.get("AWS_PROFILE", "default")
    section = _section("AWS_CONFIG_FILE", "~/.aws/config", profile if profile == "default" else f"profile {profile}")
    found = env.get("AWS_REGION") or env.get("AWS_DEFAULT_REGION") or section.get("region") or "us-east-1"
    return found if re.fullmatch(r"[a-z0-9-]{1,40}", found) else "us-east-1"


def _section(variable: str, usual: str, name: str) -> Mapping[str, str]:
    """Return a section of a file of AWS, empty if there is none."""
    try:
        path = Path(os.environ.get(variable) or usual).expanduser()
        found = path.stat()
        return _parsed(path, (found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns))[name]
    except (UnsupportedRecording, OSError, ValueError, KeyError, RuntimeError, configparser.Error):
        return {}


@lru_cache(maxsize=4)
def _parsed(path: Path, identity: tuple[int, int, int, int]) -> configparser.ConfigParser:
    """Return a file of AWS as it is with this identity.  Raises as `open_file` and the parser do."""
    parser = configparser.ConfigParser(interpolation=None)
    with open_file(path) as stream:
        parser.read_string(stream.read(_MOST_CONFIG).decode())
    return parser
