"""Which facts were reported already: a note or warning that may be reported only once asks here."""

from __future__ import annotations

from collections.abc import Hashable


class Once:
    """The keys of what was reported.  Threads may share it without a lock.

    Args:
        most: number of keys from which on nothing is reported any more; None: no bound.
    """

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self._seen: dict[Hashable, object] = {}

    def first(self, *key: Hashable) -> bool:
        """Whether this is the first call with this key."""
        if self._most is not None and len(self._seen) >= self._most:
            return False
        mine = object()
        return self._seen.setdefault(key, mine) is mine  # one operation, for it has no lock

    def forget(self) -> None:
        """Report everything once more."""
        self._seen.clear()
