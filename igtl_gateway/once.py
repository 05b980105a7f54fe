"""Which facts were reported already: a note or warning that may be reported only once asks here."""

from __future__ import annotations

from collections.abc import Hashable


class Once:
    """The keys of what was reported.  Threads may share it without a lock."""

    def __init__(self) -> None:
        self._seen: dict[Hashable, object] = {}

    def first(self, *key: Hashable) -> bool:
        """Whether this is the first call with this key."""
        mine = object()
        return self._seen.setdefault(key, mine) is mine  # one operation, for it has no lock

    def forget(self) -> None:
        """Report everything once more."""
        self._seen.clear()
