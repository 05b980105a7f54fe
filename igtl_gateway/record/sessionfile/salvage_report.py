"""What was read of a damaged file and what was not."""

from __future__ import annotations

from dataclasses import dataclass, field

#: Losses that are reported one by one; the rest are counted.
MAX_LOSSES = 1_000

#: Kinds of losses.
CUT_OFF, CHUNK, BYTES, CHANNEL, NUMBER, METADATA, LEDGER, ATTACHMENT, HEADER = (
    "cut_off", "chunk", "bytes", "channel", "number", "metadata", "ledger", "attachment", "header",
)  # fmt: skip


@dataclass(slots=True)
class Loss:
    """Something that is missing.

    Attributes:
        what: kind of the loss.
        at: offset in the file.
        size: bytes of the file that could not be used.
        start_ns, end_ns: UTC nanoseconds between which it happened, as far as known; 0 = not known.
        text: the reason, for people.
    """

    what: str
    at: int
    size: int
    start_ns: int
    end_ns: int
    text: str


@dataclass(slots=True)
class SalvageReport:
    """What was read and what was not; complete after the last message.

    Attributes:
        size: bytes of the file.
        closed: the recording ended properly: nothing was still to come.
        indexed: the index is right.
        messages: messages that were read.
        start_ns, end_ns: UTC nanoseconds of the first and the last of them; 0 where there is none.
        missing: messages that were there and are lost, by the index; None where the index is lost, too.
        missing_numbers: entry numbers missing at the places of loss: the maximum of the entries that are lost there.
        lost: the losses, in order; the first MAX_LOSSES of them.
        more_lost: number of further losses.
    """

    size: int
    closed: bool = False
    indexed: bool = False
    messages: int = 0
    start_ns: int = 0
    end_ns: int = 0
    missing: int | None = None
    missing_numbers: int = 0
    lost: list[Loss] = field(default_factory=list)
    more_lost: int = 0

    @property
    def whole(self) -> bool:
        """Whether everything that was recorded has been read."""
        return self.closed and not self.lost

    def add(self, loss: Loss) -> None:
        """Report a loss, or count it if there are too many."""
        if len(self.lost) < MAX_LOSSES:
            self.lost.append(loss)
        else:
            self.more_lost += 1
