"""The hash of what a session holds: equal on every machine, whatever packed the file.

Files of equal sessions may differ, for zstandard and lz4 pack the same bytes in other ways from version to version.
So what is promised to be equal is hashed entry by entry, before compression.
"""

from __future__ import annotations

import hashlib

from igtl_gateway.gateway.log.entry import Entry


class ContentDigest:
    """SHA-256 of entries, in order: number, moments, kind, links, channel and type, and the bytes of the payload."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def update(self, entry: Entry) -> None:
        """Take the next entry."""
        links = ",".join(map(str, entry.links))
        head = (entry.seq, entry.stamp_ns, entry.source_ns, entry.kind.value, links, entry.channel, entry.type)
        text = "\0".join((*map(str, head), str(entry.size))) + "\0"
        self._hash.update(text.encode("utf-8", "surrogateescape"))
        for part in entry.payload:
            self._hash.update(part)

    def hexdigest(self) -> str:
        """Of all that it was given."""
        return self._hash.hexdigest()
