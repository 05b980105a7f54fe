"""Objects of an object store: found by their names, and read by ranges.

Credentials and endpoints are those of the environment (``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL`` …).
"""

from __future__ import annotations

import fnmatch
import io
import re
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from datetime import timedelta
from pathlib import PurePosixPath
from typing import Any

from igtl_gateway.addon import ConfigError, Unavailable, extras

#: Bytes of one request for small reads, and how many of these blocks are kept.
BLOCK = 64 << 10
_KEPT = 64
#: How often and how long a request is tried again, each for 30 s at most (``AWS_TIMEOUT`` …).
RETRY: Any = {"max_retries": 4, "retry_timeout": timedelta(seconds=60)}
_URL = re.compile(r"(?P<root>(?P<scheme>[a-zA-Z][a-zA-Z0-9+.-]*)://[^/]*)/?(?P<name>.*)", re.DOTALL)
_WILD = re.compile(r"[*?\[]")


class Unreachable(Unavailable):
    """The object store does not answer, or refuses: not a property of the file, so a later run tries again."""


def is_url(source: str) -> bool:
    """Return whether a source is a URL."""
    return _URL.fullmatch(source) is not None


def list_objects(url: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield URL and properties (``size``, ``e_tag``, ``version``, ``last_modified``) of the sessions behind a URL.

    Args:
        url: of an object; of a "folder", whose objects ``*.mcap`` are the sessions; or with ``*``, ``?`` and ``[…]``,
            of which ``*`` matches any characters.

    Raises Unreachable, Unavailable; ConfigError for a URL with a password, which would stand in the tables.
    """
    root, name = _parts(url)
    if "@" in root:
        raise ConfigError(
            f"source {url.partition(':')[0]}://…: found a user in the URL, expected credentials in the environment"
        )
    store = _store(root)
    wild = _WILD.search(name)
    prefix = name[: wild.start()].rpartition("/")[0] if wild else name.rstrip("/")
    try:
        import obstore

        if not wild and PurePosixPath(name).suffix == ".mcap":
            yield url, dict(obstore.head(store, name))
            return
        for page in obstore.list(store, prefix=prefix or None, chunk_size=1000):
            for each in page:
                path = str(each["path"])
                fits = fnmatch.fnmatchcase(path, name) if wild else path.endswith(".mcap")
                if fits:
                    yield f"{root}/{path}", dict(each)
    except Exception as error:  # obstore has its own errors, one for each reason
        raise Unreachable(f"{url}: {_reason(error)}") from None


class ObjectFile(io.RawIOBase):
    """An object, read by ranges; large reads are one request, small ones are served from blocks that are kept.

    Args:
        url: of the object.
        size: bytes.
        e_tag: what the object must still have, ``""`` for any.

    Attributes:
        requests, bytes_read: what was requested so far.

    Reads raise Unreachable, also if the object has changed: its bytes are those of one version, or none.
    """

    def __init__(self, url: str, size: int, e_tag: str = "") -> None:
        root, self._name = _parts(url)
        self._store, self._url, self._size, self._tag = _store(root), url, size, e_tag
        self._at = self.requests = self.bytes_read = 0
        self._blocks: OrderedDict[int, bytes] = OrderedDict()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(0, start + offset)
        return self._at

    def readinto(self, buffer: Any, /) -> int:
        count = min(len(buffer), self._size - self._at)
        if count <= 0:
            return 0
        if count >= BLOCK:
            data = self._range(self._at, count)
        else:
            number, inside = divmod(self._at, BLOCK)
            data = self._block(number)[inside : inside + count]  # the rest at the next call
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def _block(self, number: int) -> bytes:
        data = self._blocks.pop(number, None)
        if data is None:
            start = number * BLOCK
            data = self._range(start, min(BLOCK, self._size - start))
            while len(self._blocks) >= _KEPT:
                self._blocks.popitem(last=False)
        self._blocks[number] = data
        return data

    def _range(self, start: int, count: int) -> bytes:
        import obstore

        options: dict[str, Any] = {"range": (start, start + count)}
        if self._tag:
            options["if_match"] = self._tag
        try:
            found = obstore.get(self._store, self._name, options=options)
            facts, data = found.meta, bytes(found.bytes())
        except Exception as error:
            changed = type(error).__name__ == "PreconditionError"
            raise self._changed() if changed else Unreachable(f"{self._url}: {_reason(error)}") from None
        if facts["size"] != self._size or (self._tag and facts.get("e_tag") != self._tag):
            raise self._changed()
        self.requests += 1
        self.bytes_read += len(data)
        if len(data) != count:
            raise Unreachable(f"{self._url}: found {len(data)} bytes at {start}, expected {count}; run again")
        return data

    def _changed(self) -> Unreachable:
        return Unreachable(f"{self._url}: found another object than at the beginning of the run; run again")


def _parts(url: str) -> tuple[str, str]:
    found = _URL.fullmatch(url)
    if found is None:
        raise Unreachable(f"{url}: found no URL, expected SCHEME://BUCKET/NAME")
    return found["root"], found["name"]


def _store(root: str) -> Any:
    try:
        from obstore.store import from_url
    except ImportError as error:
        raise Unavailable(extras.missing("obstore", error)) from None
    try:
        return from_url(root, retry_config=RETRY)
    except Exception as error:
        raise Unreachable(f"{root}: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    """The first line of an error of obstore, which has pages of debugging behind it."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)[:300]
