"""Whether the configured sources have come: reported some seconds after the start, and shown until they come."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.expected import ExpectedSource, MissingSource, PresentSources, missing_sources
from igtl_gateway.gateway.log.note import Note

#: Time after the start, and after the first message of a peer, until a source is missed; interval of the looks.
WAIT_NS, _EVERY_NS = 5 * NS_PER_S, 2 * NS_PER_S
_OF_PEERS = frozenset({"device", "stream"})


class AwaitedSources:
    """The sources of a bridge that have not come.

    Args:
        expected: the sources of its configuration.
        present: returns what is there now.
        on_note: takes a note about each source that has not come.

    Attributes:
        missing: those that are missing now; empty in the first seconds.
    """

    def __init__(
        self,
        expected: Sequence[ExpectedSource],
        present: Callable[[], PresentSources],
        on_note: Callable[[Note], None],
    ) -> None:
        self.missing: tuple[MissingSource, ...] = ()
        self._awaited = list(expected)
        self._present = present
        self._on_note = on_note
        self._noted: set[ExpectedSource] = set()
        self._first_ns: int | None = None  # of looks, and of messages from peers
        self._heard_ns: int | None = None
        self._looked_ns = 0

    def look(self, now_ns: int) -> None:
        """Look for the sources.

        Args:
            now_ns: monotonic time; the first call is at the start.
        """
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        if not self._awaited or now_ns - self._first_ns < WAIT_NS or now_ns - self._looked_ns < _EVERY_NS:
            return
        self._looked_ns = now_ns
        present = self._present()
        if present.devices is not None and self._heard_ns is None:
            self._heard_ns = now_ns
        missing = missing_sources(self._awaited, present)
        # who has come once may pause: silence has notes of its own
        absent = {each.source for each in missing}
        self._awaited = [each for each in self._awaited if each in absent or present.names(each.kind) is None]
        too_early = self._heard_ns is None or now_ns - self._heard_ns < WAIT_NS
        self.missing = tuple(each for each in missing if not (too_early and each.source.kind in _OF_PEERS))
        for each in self.missing:
            if each.source not in self._noted:
                self._noted.add(each.source)
                self._on_note(each.note())
