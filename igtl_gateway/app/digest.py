"""SHA-256 of the bytes sent.  Large parts are hashed in a second thread, so sending does not wait for them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from igtl_gateway.base.buffers import Buffer

#: Size in bytes from which a part is hashed in the second thread; for shorter parts the switch takes longer.
_LARGE = 1 << 18


class Digest:
    """An incremental hash.  The buffers of a part must not change until the next call of any method."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._executor: ThreadPoolExecutor | None = None
        self._busy: Future[None] | None = None

    def update(self, parts: Sequence[Buffer], size: int) -> None:
        """Add these buffers, with ``size`` bytes in total."""
        self._wait()
        if size < _LARGE:
            self._hash.update(parts[0] if len(parts) == 1 else b"".join(parts))
            return
        if not self._executor:
            self._executor = ThreadPoolExecutor(1, "igtl-digest")
        self._busy = self._executor.submit(self._update, parts)

    def copy(self) -> Digest:
        """Return an independent hash of the same bytes."""
        self._wait()
        other = Digest()
        other._hash = self._hash.copy()
        return other

    def hexdigest(self) -> str:
        """Return the SHA-256 of all added bytes as hexadecimal digits."""
        self._wait()
        return self._hash.hexdigest()

    def _update(self, parts: Sequence[Buffer]) -> None:
        for part in parts:
            self._hash.update(part)

    def _wait(self) -> None:
        if self._busy:
            self._busy.result()
            self._busy = None
