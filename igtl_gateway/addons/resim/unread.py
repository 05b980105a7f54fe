"""Streams whose type no reader of sessions takes, such as the events of a service: their digests stand for them.

A file of outputs has the digests of all its streams in its ledger.  A file without them, such as a live recording,
states nothing about these streams: they are named as not compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from igtl_gateway.addon.reading import SessionFile

_KEY = "resim_streams"


@dataclass(frozen=True, slots=True)
class Digest:
    """Number of messages, session time of the first one (UTC ns), and their digest; ``""`` if it is not known."""

    messages: int
    first_ns: int
    digest: str


def ledger_of(streams: Mapping[str, Digest]) -> dict[str, Any]:
    """The ledger of a file of outputs with these streams."""
    return {_KEY: {name: [each.messages, each.first_ns, each.digest] for name, each in streams.items()}}


def unread_streams(file: SessionFile) -> dict[str, Digest]:
    """The streams of a file that are not read."""
    known = (file.ledger or {}).get(_KEY)
    found = {}
    for each in file.skipped:
        match known.get(each.topic) if isinstance(known, dict) else None:
            case [int(messages), int(first_ns), str(digest)]:
                found[each.topic] = Digest(messages, first_ns, digest)
            case _ if each.count:
                found[each.topic] = Digest(each.count, file.start_ns, "")
    return found
