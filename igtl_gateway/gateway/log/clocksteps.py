"""Steps of the host's clock, and what they do to gateway time.

Gateway time is the host's clock (UTC) and never decreases.  When the clock is set *forward*, gateway time
follows: there is a jump in the log.  When it is set *back* by more than ``STAND_NS``, gateway time goes on without the
step and is ahead of the clock from then on; by less, it stands until the clock has caught up.  A clock that is set
forward again first takes away what gateway time is ahead.

Each step is an input of the session, a note of code ``CLOCK_STEP``.  It is noticed at once on Linux, else some
hundredths of a second late, so a jump lies shortly before its note.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from igtl_gateway.base.quantities import duration_text
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note

CLOCK_STEP = "clock_step"
_MARK = CLOCK_STEP.encode()
#: Smaller steps are not noticed: reading two clocks one after the other may take as long.
LEAST_NS = 10 * NS_PER_MS
#: Up to this, a clock that was set back is waited for: a second, so that a leap second leaves nothing behind.
STAND_NS = NS_PER_S


@dataclass(frozen=True, slots=True)
class ClockStep:
    """One step.

    Attributes:
        step_ns: by how much the host's clock was set forward; negative: back.
        jump_ns: by how much gateway time jumped with it, 0 or more.
        ahead_ns: by how much gateway time is ahead of the host's clock from then on.
        at_ns: gateway time of the note; 0 where there is none yet.
    """

    step_ns: int
    jump_ns: int
    ahead_ns: int
    at_ns: int = 0

    @classmethod
    def after(cls, step_ns: int, ahead_ns: int) -> ClockStep:
        """What a step does to a gateway time that was so far ahead."""
        if step_ns >= 0:
            left_ns = ahead_ns - step_ns
            if abs(left_ns) < LEAST_NS:  # set right again
                return cls(step_ns, 0, 0)
            return cls(step_ns, max(0, -left_ns), max(0, left_ns))
        return cls(step_ns, 0, ahead_ns - step_ns if -step_ns > STAND_NS else ahead_ns)

    @classmethod
    def of(cls, entry: Entry) -> ClockStep | None:
        """Return the step that an entry reports; None for other entries."""
        if entry.kind is not Kind.EDGE_NOTE or _MARK not in (data := entry.data()):
            return None
        note = Note.of(data)
        step_ns, jump_ns, ahead_ns = (note.data.get(name) for name in ("step_ns", "jump_ns", "ahead_ns"))
        if note.code != CLOCK_STEP or not (type(step_ns) is type(jump_ns) is type(ahead_ns) is int):
            return None
        return cls(step_ns, jump_ns, ahead_ns, entry.stamp_ns)

    def note(self) -> Note:
        """The note about it."""
        data = {"step_ns": self.step_ns, "jump_ns": self.jump_ns, "ahead_ns": self.ahead_ns}
        return Note(Level.WARN, CLOCK_STEP, str(self), data=data)

    def __str__(self) -> str:
        way = "forward (or the machine slept)" if self.step_ns > 0 else "back"
        if self.jump_ns:
            then = f"gateway time jumps by {duration_text(self.jump_ns)}"
        elif self.ahead_ns:
            then = f"gateway time goes on, {duration_text(self.ahead_ns)} ahead of it"
        elif self.step_ns > 0:
            then = "gateway time is ahead of it no more"
        else:
            then = "gateway time stands until the clock has caught up"
        return f"the host's clock was set {way} by {duration_text(abs(self.step_ns))}: {then}"


class StreamTimes(Protocol):
    """Times of a stream, in gateway time: of its first and its last message, and the longest pause between two."""

    first_ns: int
    last_ns: int
    longest_pause_ns: int


def without_jump(stream: StreamTimes, step: ClockStep) -> None:
    """Take a jump out of what was measured of a stream before its note: no time has passed in it."""
    if not step.jump_ns or not stream.first_ns:
        return
    before_ns = step.at_ns - step.jump_ns
    if stream.last_ns <= before_ns:  # no message since: the next one is not later for it
        stream.first_ns += step.jump_ns
        stream.last_ns += step.jump_ns
    elif stream.first_ns <= before_ns:
        stream.first_ns += step.jump_ns
        if stream.longest_pause_ns >= step.jump_ns:
            stream.longest_pause_ns -= step.jump_ns
