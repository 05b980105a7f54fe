"""The pace of a session: gateway time without the jumps that it made because the host's clock was set forward.

A replay keeps the pauses of that day, but nobody waited for the hour by which a clock was set.
"""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.session.clocksteps import CLOCK_STEP, ClockStep
from igtl_gateway.session.entry import Kind
from igtl_gateway.sessionfile.reader import SessionFile


class SessionTimeline:
    """Gateway time ⇄ time that has passed, both in ns; monotone, and the same but for jumps.

    A jump is noticed shortly after it: messages in between are of the moment of the jump.
    """

    def __init__(self, steps: Iterable[ClockStep] = ()) -> None:
        self._jumps = tuple((step.at_ns, step.jump_ns) for step in steps if step.jump_ns)

    def passed_ns(self, recorded_ns: int) -> int:
        """The time that has passed at a moment of the session."""
        left_out_ns = 0
        for at_ns, jump_ns in self._jumps:
            left_out_ns += min(max(0, recorded_ns - (at_ns - jump_ns)), jump_ns)
        return recorded_ns - left_out_ns

    def recorded_ns(self, passed_ns: int) -> int:
        """The moment of the session at which so much time has passed; behind a jump where that is just then."""
        for at_ns, jump_ns in self._jumps:
            if passed_ns >= at_ns - jump_ns:
                passed_ns += jump_ns
        return passed_ns

    def behind_jump_ns(self, recorded_ns: int) -> int:
        """The end of the jump that a moment lies in; the moment itself where it lies in none."""
        for at_ns, jump_ns in self._jumps:
            if at_ns - jump_ns < recorded_ns < at_ns:
                return at_ns
        return recorded_ns


def clock_steps_of(file: SessionFile) -> list[ClockStep]:
    """The steps of the host's clock in a recording.  Raises DamagedRecording.

    The notes are only looked for where the ledger does not say that there are none.
    """
    streams = (file.ledger or {}).get("streams")
    if file.foreign or (streams is not None and CLOCK_STEP not in streams.get("edges", {}).get("", {})):
        return []
    return [step for entry in file.entries_of({Kind.EDGE_NOTE}) if entry.seq and (step := ClockStep.of(entry))]
