"""Storage of the facts that were reported, for notes and warnings that are reported only once."""

from __future__ import annotations

from collections.abc import Hashable


class Once:
    """The keys of the reported facts.  Threads may share an instance without a lock.

    Args:
        most: maximum number of keys; facts with other keys are not reported.  None: no limit.
    """

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self._seen: dict[Hashable, object] = {}

    def first(self, *key: Hashable) -> bool:
        """Return whether this is the first call with this key; always false from ``most`` keys on."""
        if self._most is not None and len(self._seen) >= self._most:
            return False
        mine = object()
        return self._seen.setdefault(key, mine) is mine  # one operation, because there is no lock

    def is_over(self, *key: Hashable) -> bool:
        """Return whether ``first`` is false for this key."""
        return key in self._seen or (self._most is not None and len(self._seen) >= self._most)

    def forget(self) -> None:
        """Forget all keys, so that every fact is reported once more."""
        self._seen.clear()
