"""The time line of a session: gateway time without the jumps that occur when the host's clock is set forward.

A replay keeps the recorded pauses, but not a jump of the clock, during which no time passed.
"""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP, ClockStep
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.only import only_of_kinds
from igtl_gateway.record.sessionfile.reader import SessionFile


class SessionTimeline:
    """Converts between gateway time and passed time, both in ns; monotonic, and equal except for jumps.

    A jump is detected shortly after it: the messages in between count as messages at the moment of the jump.
    """

    def __init__(self, steps: Iterable[ClockStep] = ()) -> None:
        self._jumps = tuple((step.at_ns, step.jump_ns) for step in steps if step.jump_ns)

    def passed_ns(self, recorded_ns: int) -> int:
        """Return the time that has passed at a moment of the session."""
        left_out_ns = 0
        for at_ns, jump_ns in self._jumps:
            left_out_ns += min(max(0, recorded_ns - (at_ns - jump_ns)), jump_ns)
        return recorded_ns - left_out_ns

    def recorded_ns(self, passed_ns: int) -> int:
        """Return the moment of the session after ``passed_ns``; the end of a jump if it is exactly there."""
        for at_ns, jump_ns in self._jumps:
            if passed_ns >= at_ns - jump_ns:
                passed_ns += jump_ns
        return passed_ns

    def behind_jump_ns(self, recorded_ns: int) -> int:
        """Return the end of the jump that contains a moment, or the moment itself."""
        for at_ns, jump_ns in self._jumps:
            if at_ns - jump_ns < recorded_ns < at_ns:
                return at_ns
        return recorded_ns


def clock_steps_of(file: SessionFile) -> list[ClockStep]:
    """Return the steps of the host's clock in a recording.  Raises DamagedRecording.

    The notes are read only if the ledger does not exclude them.
    """
    streams = (file.ledger or {}).get("streams")
    if file.foreign or (streams is not None and CLOCK_STEP not in streams.get("edges", {}).get("", {})):
        return []
    return [step for entry in only_of_kinds(file, {Kind.EDGE_NOTE}) if (step := ClockStep.of(entry))]
