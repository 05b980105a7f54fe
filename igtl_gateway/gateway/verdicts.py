"""The results of the commands to robots in an input of a prologue.

The prologue of a recording has the last commands only, and whether the guard accepted one may follow from more.  So it
has the outputs that show it, and the guard does not judge again.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import REFUSED_COMMANDS, REFUSED_DEVICE
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.robot_command import Refused


class Verdicts:
    """The verdicts on the commands of one input.

    Args:
        outputs: those of the input in the prologue, in order; older recordings have none, and no refused command in
            their prologue.
    """

    def __init__(self, outputs: Iterable[Entry]) -> None:
        self._of: defaultdict[str, deque[Refused | Entry]] = defaultdict(deque)
        for output in outputs:
            if output.kind is Kind.ROS_OUT:
                self._of[output.channel.removeprefix("/")].append(output)
            elif output.kind is Kind.NOTE and (note := Note.of(output.data())).code in REFUSED_COMMANDS:
                self._of[str(note.data.get(REFUSED_DEVICE, ""))].append(Refused(note.code, note.text))

    def next(self, device: str) -> Entry | None:
        """Return what was published of the next command with this device; None: not known.

        Raises Refused, if it was refused.
        """
        verdict = self._of[device].popleft() if self._of[device] else None
        if isinstance(verdict, Refused):
            raise verdict
        return verdict
