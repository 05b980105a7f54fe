"""Whether the configured sources are there: reported some seconds after the start, and shown until they come.

A source that comes late withdraws its line, and one that leaves is missed again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.expected import (
    LEAVING,
    OF_PEERS,
    ExpectedSource,
    MissingSource,
    PresentSources,
    is_known,
    missing_sources,
)
from igtl_gateway.gateway.log.note import Note

#: Time after the start, after a first peer has come, after the first message of one, and after a source has left,
#: until it is missed.
WAIT_NS = 5 * NS_PER_S
#: Interval of the looks, and that of a bridge whose sources are all there.
_EVERY_NS, _SELDOM_NS = 2 * NS_PER_S, 5 * NS_PER_S


class AwaitedSources:
    """The sources of a bridge that are not there.

    Args:
        expected: the sources of its configuration.
        present: returns what is there now.
        on_note: takes a note about each source that has not come, and one when it comes.

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
        self._expected = list(expected)
        self._present = present
        self._on_note = on_note
        self._noted: dict[ExpectedSource, MissingSource] = {}  # without a note that they have come
        self._came: set[ExpectedSource] = set()
        self._gone_ns: dict[ExpectedSource, int] = {}
        self._first_ns: int | None = None  # of looks, and of messages from peers
        self._met_ns: int | None = None  # since then a peer is connected
        self._heard_ns: int | None = None
        self._looked_ns = 0

    def look(self, now_ns: int) -> None:
        """Look for the sources.

        Args:
            now_ns: monotonic time; the first call is at the start.
        """
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        every_ns = _EVERY_NS if self.missing or len(self._came) < len(self._expected) else _SELDOM_NS
        if not self._expected or now_ns - self._first_ns < WAIT_NS or now_ns - self._looked_ns < every_ns:
            return
        self._looked_ns = now_ns
        present = self._present()
        if not present.connected:
            self._met_ns = None
        elif self._met_ns is None:
            self._met_ns = now_ns
        if present.devices and self._heard_ns is None:
            self._heard_ns = now_ns
        absent = {each.source: each for each in missing_sources(self._expected, present)}
        self._there(absent, present)
        missing = (self._judged(each, now_ns) for each in absent.values())
        self.missing = tuple(each for each in missing if each)
        for each in self.missing:
            self._note(each)

    def _there(self, absent: dict[ExpectedSource, MissingSource], present: PresentSources) -> None:
        """Take those that are there now; one whose leaving does not show is not looked for any more."""
        for source in self._expected:
            if source in absent or not is_known(source, present):
                continue
            self._came.add(source)
            self._gone_ns.pop(source, None)
            if (noted := self._noted.pop(source, None)) and source.kind != "link":
                self._on_note(noted.arrival())
        self._expected = [each for each in self._expected if each.kind in LEAVING or each not in self._came]

    def _judged(self, missing: MissingSource, now_ns: int) -> MissingSource | None:
        """Return a source that is missing for long enough, and None before that."""
        source = missing.source
        if source in self._came:
            if now_ns - self._gone_ns.setdefault(source, now_ns) < WAIT_NS:
                return None
            return replace(missing, why=f"{missing.why} any more", near="")
        times = (self._met_ns, self._heard_ns) if source.kind in OF_PEERS else ()
        is_early = any(since_ns is not None and now_ns - since_ns < WAIT_NS for since_ns in times)
        return None if is_early else missing

    def _note(self, missing: MissingSource) -> None:
        """Note a source that was not noted, or not for this reason, or without a near name."""
        noted = self._noted.get(missing.source)
        if noted and (noted.why, bool(noted.near)) == (missing.why, bool(missing.near)):
            return
        self._noted[missing.source] = missing
        kind = missing.source.kind
        # of a link that is not up, and of a type or QoS that does not fit, its edge has a note
        if not (kind == "link" or (kind == "topic" and missing.is_there)):
            self._on_note(missing.note())
