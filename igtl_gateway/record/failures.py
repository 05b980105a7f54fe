"""What has failed of a recording, and when a disk that has failed is tried again."""

from __future__ import annotations

from igtl_gateway.base.stamp import NS_PER_S

#: A disk that has failed is tried again after this time, ns, doubled at each fourth attempt up to the second one; from
#: the first one again when it has worked for the third one.
_AGAIN_NS, _LONGEST_NS, _WORKS_NS = NS_PER_S, 60 * NS_PER_S, 30 * NS_PER_S


class Failures:
    """Failures of a recording.

    Attributes:
        present: why nothing can be written now, or ``""``.
        first: why a file that was asked for is missing, or has an end too early, the first one; or ``""``.
        taken_away: the last file that was removed or changed while it was written, and where it goes on; or ``""``.
        again_ns: when the disk is tried again, monotonic; None: it works, or nothing is to be written.
    """

    def __init__(self) -> None:
        self.present = self.first = self.taken_away = ""
        self.again_ns: int | None = None
        self._attempts = 0
        self._failed_ns = self._worked_ns = 0  # the disk, since then; monotonic

    @property
    def summary(self) -> str:
        """Why the recording is not what was asked for, or ``""``."""
        return self.first or self.taken_away

    def miss(self, text: str) -> None:
        """A file that was asked for is missing, or lacks its end."""
        self.first = self.first or text

    def fail(self, text: str) -> bool:
        """Nothing can be written now; returns whether that is new."""
        self.miss(text)
        is_new, self.present = self.present != text, text
        return is_new

    def clear(self) -> None:
        """A file is begun, or was closed on request: nothing has to be tried again."""
        self.present, self.again_ns = "", None

    def try_later(self, now_ns: int) -> None:
        """Try the disk again: after a second, then after longer times, as long as it does not work."""
        if now_ns - self._worked_ns > _WORKS_NS and not self.again_ns:
            self._attempts = 0
        if not self._attempts:
            self._failed_ns = now_ns
        self.again_ns = now_ns + min(_AGAIN_NS << self._attempts // 4, _LONGEST_NS)
        self._attempts += 1

    def is_due(self, now_ns: int) -> bool:
        """Return whether the disk is to be tried now."""
        return self.again_ns is not None and now_ns >= self.again_ns

    def works_again(self, now_ns: int) -> float:
        """The disk has taken a file; returns for how long it had not, s."""
        self._worked_ns = now_ns
        self.clear()
        return (now_ns - self._failed_ns) / NS_PER_S
