"""Objects of an object store: found by their names, and read by ranges.

Credentials and endpoints are those of the environment (``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL`` …).
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterator, Mapping
from datetime import timedelta
from pathlib import PurePosixPath
from typing import Any

from igtl_gateway.addon import ConfigError, Unavailable
from igtl_gateway.addon.processes import extras
from igtl_gateway.addon.reading import RangeFile
from igtl_gateway.addon.terminal import counted

#: Bytes of one request for small reads.
BLOCK = 64 << 10
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


class ObjectFile(RangeFile):
    """An object, read by ranges.

    Args:
        url: of the object.
        size: bytes.
        e_tag: what the object must still have, ``""`` for any.

    Reads raise Unreachable, also if the object has changed: its bytes are those of one version, or none.
    """

    def __init__(self, url: str, size: int, e_tag: str = "") -> None:
        root, self._name = _parts(url)
        self._store, self._url, self._tag = _store(root), url, e_tag
        super().__init__(size, BLOCK)

    def fetch(self, start: int, count: int) -> bytes:
        """Raises Unreachable."""
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
        if len(data) != count:
            raise Unreachable(
                f"{self._url}: found {counted(len(data), 'byte')} at {start}, expected {count}; run again"
            )
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
