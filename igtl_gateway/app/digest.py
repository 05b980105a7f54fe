"""SHA-256 of what is sent: of large parts in a thread beside, so that sending need not wait for it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from igtl_gateway.buffers import Buffer

#: What is shorter is done before a thread is woken.
_LARGE = 1 << 18


class Digest:
    """A hash that grows.  What it was given must not change until the next part is given."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._beside: ThreadPoolExecutor | None = None
        self._busy: Future[None] | None = None

    def update(self, parts: Sequence[Buffer], size: int) -> None:
        """Take these buffers, of so many bytes together."""
        self._wait()
        if size < _LARGE:
            self._hash.update(parts[0] if len(parts) == 1 else b"".join(parts))
            return
        if not self._beside:
            self._beside = ThreadPoolExecutor(1, "igtl-digest")
        self._busy = self._beside.submit(self._update, parts)

    def copy(self) -> Digest:
        """One that has been given the same."""
        self._wait()
        other = Digest()
        other._hash = self._hash.copy()
        return other

    def hexdigest(self) -> str:
        """Of all that it was given."""
        self._wait()
        return self._hash.hexdigest()

    def _update(self, parts: Sequence[Buffer]) -> None:
        for part in parts:
            self._hash.update(part)

    def _wait(self) -> None:
        if self._busy:
            self._busy.result()
            self._busy = None
