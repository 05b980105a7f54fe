"""The guard: does not forward old data as new, and reports implausible streams.

It has two functions, for each stream (of OpenIGTLink: for each stream of a link):

* *Maximum age* (``max_age_s`` of a row; default: none).  A message whose own stamp is older on arrival is withheld.  A
  message without its own stamp has no age: it passes, and that is reported once.
* *Watchers* (``watch``): jumps by a factor of 1000, and stamps that decrease, do not change or are in the future.
  Watchers report only.

``watched`` has one stream.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.gateway.guarded_stream import CODES, STALE, GuardedStream, Place, findings_of
from igtl_gateway.gateway.log.clock_offset import PeerClocks
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.outcome import Item
from igtl_gateway.gateway.verdicts import Verdicts
from igtl_gateway.wire.transform import Position, Transform

__all__ = ["CODES", "MAX_WATCHED", "STALE", "Guard", "GuardedStream", "check_stamp", "translation_of"]

#: Maximum number of guarded streams, 1 kB each: enough for eight peers with ``max_streams`` each.  Further ones share
#: one state for the maximum age and are not watched.
MAX_WATCHED = 4_096


class Guard:
    """All guarded streams of a session.

    Attributes:
        ahead_ns: how far gateway time is ahead of the host's clock; see ``gateway/log/clocksteps.py``.
        clock_text: returns by which clock the stamps of a link show an age, see ``PeerClocks.text``.
        verdicts: the results of the commands to robots in the input, if it is one of a prologue.
    """

    def __init__(self, *, watch: bool) -> None:
        self.watch = watch
        self.ahead_ns = 0
        self.verdicts: Verdicts | None = None
        self.clock_text = PeerClocks().text
        self._streams: dict[tuple[int, str], GuardedStream] = {}
        self._others: dict[int, GuardedStream] = {}

    def of(self, link: int, stream: str, max_age_s: float) -> GuardedStream | None:
        """Return a stream of a link (0: of ROS); None if it is neither guarded nor watched."""
        max_age_ns = round(max_age_s * NS_PER_S)
        watched = self._streams.get((link, stream))
        if watched is not None:
            if watched.max_age_ns != max_age_ns:  # the setting has changed
                watched.max_age_ns, watched.look_ns = max_age_ns, 0
        elif not (self.watch or max_age_ns):
            return None
        else:
            if len(self._streams) >= MAX_WATCHED:  # shared state: maximum age only
                watched = self._others.setdefault(max_age_ns, GuardedStream("(other streams)", max_age_ns, watch=False))
            else:
                watched = self._streams[link, stream] = GuardedStream(stream, max_age_ns, watch=self.watch)
                watched.clock_text = partial(self.clock_text, link)
            watched.ahead_ns = self.ahead_ns
        return watched

    def clock_stepped(self, ahead_ns: int) -> None:
        """The host's clock was set: take the new ``ahead_ns``, and restart the estimates of other clocks."""
        self.ahead_ns = ahead_ns
        for watched in (*self._streams.values(), *self._others.values()):
            watched.ahead_ns = ahead_ns
            watched.timing.reset()

    def on_link_down(self, link: int) -> None:
        """Remove the streams of a closed link."""
        for key in [key for key in self._streams if key[0] == link]:
            del self._streams[key]

    def items(self) -> Iterable[tuple[tuple[int, str], GuardedStream]]:
        """Return (link, name) and stream in the order of appearance; callable from any thread."""
        return list(self._streams.items())


def check_stamp(
    entry: Entry, watched: GuardedStream, own_ns: int, shown_ns: int, place: Place | None
) -> tuple[bool, list[Item]]:
    """Return whether a message is too old to be forwarded, and the findings about it.

    Args:
        entry: the input.
        watched: the stream of the message.
        own_ns: the stamp of the message itself, UTC ns; 0: none.
        shown_ns: the stamp that it is forwarded with.
        place: translation of a pose; None for other messages.
    """
    withheld, remarks = watched.judge(entry.stamp_ns, own_ns)
    remarks += watched.observe(entry.stamp_ns, shown_ns, place)
    return withheld, findings_of(entry, remarks) if remarks else []


def translation_of(content: object) -> Place | None:
    """Return the translation of a single pose, in the unit of its side (mm or m); None for other contents."""
    match content:
        case Transform():
            x, y, z = content.wire_matrix[9:]
        case Position():
            x, y, z = content.position
        case TransformStamped():
            x, y, z = content.translation
        case PoseStamped():
            x, y, z = content.pose[:3]
        case _:
            return None
    return x, y, z
