"""The messages of a running bridge whose numbers a browser plots, in the process of the bridge.

While a browser asks, twenty messages a second of a stream are kept until the page takes them.  Messages that pass
natively are not seen here, so one of them is sent through Python each time.  Without a browser nothing is kept, and no
message takes another way.
"""

from __future__ import annotations

import base64
import threading
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import NS_PER_S, SystemClock
from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addon.streams import StreamUnits, arm_units

if TYPE_CHECKING:
    from igtl_gateway.addon.live import Bridge

#: Time between two messages of a stream that are kept, and how long after the last request, ns.
_EVERY_NS, _LOOKED_NS = NS_PER_S // 20, 3 * NS_PER_S
#: A message is kept up to the first number of bytes, and in a second up to the other one.
_MAX_BYTES, _BYTES_PER_S = 8 << 20, 4 << 20
#: Streams at a time, messages of each, and links with a unit of their own.
MAX_STREAMS, _MAX_MESSAGES, _MAX_LINKS = 4, 64, 1_000
_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_PLOTTED = {kind.value: kind for kind in (Kind.IGTL_IN, Kind.IGTL_OUT, Kind.ROS_IN, Kind.ROS_OUT)}

#: Side and stream.
_Key = tuple[str, str]


class _Look:
    """A stream that is looked at."""

    def __init__(self) -> None:
        self.until_ns = self.next_ns = 0
        self.type = ""
        self.links: tuple[int, ...] = ()
        self.problem = ""
        self._kept: deque[tuple[int, bytes]] = deque(maxlen=_MAX_MESSAGES)

    def keep(self, entry: Entry) -> None:
        """Copy a message."""
        self._kept.append((entry.stamp_ns, entry.data()))

    def taken(self) -> list[tuple[int, bytes]]:
        """Return what was kept since the last call."""
        return [self._kept.popleft() for _ in range(len(self._kept))]


class LiveNumbers:
    """A sink that keeps some messages of the streams that are looked at.

    Args:
        types: topic → its type, of those that have come.
    """

    def __init__(self, types: Mapping[str, str]) -> None:
        self._types = types
        self._still = threading.Event()  # never set
        self._clock = SystemClock()
        self._looks: dict[_Key, _Look] = {}
        self._lock = threading.Lock()
        self._runs = False
        self._bridge: Bridge | None = None
        self._arms: dict[int, str] = {}  # link → unit of arms

    def __call__(self, entry: Entry) -> Callable[[], None] | None:
        """Return a function that copies the message after the lock is free; None if the message is not kept."""
        if entry.kind is Kind.NOTE:
            self._take_unit(entry)
        if not self._looks or not (look := self._looks.get((entry.kind.value, entry.channel))):
            return None
        now_ns = self._clock.monotonic_ns()
        if now_ns < look.next_ns:
            return None
        look.type, look.links = entry.type, entry.links
        if entry.size > _MAX_BYTES:
            look.problem = f"messages above {_MAX_BYTES >> 20} MiB have no plot"
            return None
        look.next_ns = now_ns + max(_EVERY_NS, entry.size * NS_PER_S // _BYTES_PER_S)
        return partial(look.keep, entry)

    def _take_unit(self, entry: Entry) -> None:
        """Learn the unit of a peer that has one of its own."""
        if len(self._arms) < _MAX_LINKS:
            self._arms |= arm_units([entry])

    def take(self, bridge: Bridge, side: str, stream: str) -> dict[str, Any]:
        """Return the messages of a stream since the last call as JSON values; they are kept for some seconds from now.

        Returns:
            ``messages``: gateway time (UTC ns) and base64 of each; with them ``type``, ``unit`` of lengths in
            OpenIGTLink messages, and ``crc``, whether the session checks it; ``now_ns``: gateway time, UTC ns;
            ``problem``: why there are none.
        """
        if side not in _PLOTTED:
            return {"messages": [], "problem": f"found {side[:20]!r}, which has no numbers"}
        with self._lock:
            self._bridge = bridge
            look = self._looks.pop((side, stream), None) or _Look()
            look.until_ns = self._clock.monotonic_ns() + _LOOKED_NS
            self._looks = {**dict(list(self._looks.items())[1 - MAX_STREAMS :]), (side, stream): look}
            if not self._runs:
                self._runs = True
                threading.Thread(target=self._run, name="igtl-page-numbers", daemon=True).start()
        messages = [(stamp_ns, base64.b64encode(data).decode()) for stamp_ns, data in look.taken()]
        unit = self._unit(bridge, _PLOTTED[side], stream, look) if messages else ""
        check_crc = bridge.gateway.config.check_crc
        facts = {"type": look.type, "unit": unit, "crc": check_crc, "now_ns": bridge.hub.now_ns()}
        return {"messages": messages, **facts, "problem": look.problem}

    def _unit(self, bridge: Bridge, kind: Kind, stream: str, look: _Look) -> str:
        """Return the unit of lengths in the messages of a stream: an output has that of the stream it is made of."""
        if kind not in _IGTL:
            return ""
        totals = bridge.gateway.ledger.totals()
        known = [
            (_PLOTTED[side], name, self._types.get(name, name.partition("/")[0]))
            for side, names in totals.items()
            if side in _PLOTTED
            for name in names
        ]
        return StreamUnits(bridge.gateway.config, known, self._arms).of(kind, stream, look.type, look.links)

    def _run(self) -> None:
        """Have Python pass one message of each stream now and then, as long as one is looked at."""
        while True:
            now_ns = self._clock.monotonic_ns()
            with self._lock:
                self._looks = {key: look for key, look in self._looks.items() if look.until_ns > now_ns}
                if not self._looks:
                    self._runs = False
                    return
                bridge, looks = self._bridge, list(self._looks.items())
            for (side, stream), look in looks:
                if bridge and look.next_ns <= now_ns:
                    bridge.show(_PLOTTED[side], stream)
            self._still.wait(_EVERY_NS / NS_PER_S)
