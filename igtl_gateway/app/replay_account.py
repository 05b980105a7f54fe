"""The account of a replay: each recorded message was sent, or has the reason why it was not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.app.player import PlaybackCounts
from igtl_gateway.app.replay_plan import ReplayPlan
from igtl_gateway.base.quantities import count_text
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.layout import NOTE_KINDS
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.source import FORMS, RECOMPUTED, RELAY, STREAMS

NOTES, UNREAD, CALLED, LOST, NO_PEER, NOT_FOR_PEER, REFUSED, LEFT, OUTSIDE, NOT_REACHED = (
    "notes",
    "unread",
    "called",
    "lost",
    "no_peer",
    "not_for_peer",
    "refused",
    "peer_left",
    "outside",
    "not_reached",
)

#: Reason → its text for people.  The reason of messages that are not of a selected kind is their kind.
REASONS: Mapping[str, str] = {
    NOTES: "notes and links, which are for the recording only",
    Kind.IGTL_IN.value: "received from OpenIGTLink peers",
    Kind.IGTL_OUT.value: "sent to OpenIGTLink peers",
    Kind.ROS_IN.value: "received from ROS",
    Kind.ROS_OUT.value: "published on ROS",
    UNREAD: "in channels that cannot be read",
    STREAMS: "in streams that --streams does not select",
    FORMS: "of another header version of a message that was sent",
    RELAY: "sent to the other side of the relay",
    RECOMPUTED: "recorded outputs; the outputs of this version were sent instead",
    CALLED: "of services and actions, whose requests are sent instead (--services call)",
    LOST: "lost by --fault",
    NO_PEER: "while no peer was connected",
    NOT_FOR_PEER: "of types that no connected peer can read (--exact sends them)",
    LEFT: "still queued for a peer when it disconnected",
    REFUSED: "refused by ROS",
    OUTSIDE: "outside --start and --end",
    NOT_REACHED: "not reached before the end of the replay",
}


@dataclass(slots=True)
class ReplayAccount:
    """Counts the recorded messages that a replay does not send, by reason.

    Attributes:
        recorded: number of messages in the recording, including notes and links, and of those before it.
        before: number of messages of the prologue that a replay may send; it sends only the latched ones.
        passed_over: reason → number of messages, counted while the feed is read.
        made: number of messages that the gateway of this version computed, by kind.
        passes: how often the feed was opened; the account covers only the last pass.
    """

    recorded: int = 0
    before: int = 0
    passed_over: Counter[str] = field(default_factory=Counter)
    made: Counter[Kind] = field(default_factory=Counter)
    passes: int = 0
    _fixed: Counter[str] = field(default_factory=Counter)
    _kinds: frozenset[Kind] = frozenset()

    @classmethod
    def of(cls, file: SessionFile, how: ReplayPlan) -> ReplayAccount:
        """Return the account of a file and a plan, before the first message."""
        fixed: Counter[str] = Counter()
        for channel in file.channels:
            if channel.kind in NOTE_KINDS:
                fixed[NOTES] += channel.count
            elif channel.kind not in how.kinds:
                fixed[channel.kind.value] += channel.count
            elif how.recompute and not channel.kind.is_input:
                fixed[RECOMPUTED] += channel.count
        fixed[UNREAD] = sum(channel.count for channel in file.skipped)
        before = sum(entry.kind.is_input and entry.kind in how.kinds for entry in file.prologue())
        return cls(file.entry_count + fixed[UNREAD] + before, before, _fixed=fixed, _kinds=how.kinds)

    def begin(self) -> None:
        """Restart the counts, because the feed is opened."""
        self.passes += 1
        self.passed_over.clear()
        self.made.clear()

    def facts(
        self, played: PlaybackCounts, *, failed: int, left: int, lost: int, partial: bool, stopped: bool
    ) -> dict[str, Any]:
        """Return the account as JSON values: ``recorded`` + ``made`` = ``sent`` + the sum of ``not_sent``.

        Args:
            played: counts of the player.
            failed: messages in ``played`` that ROS refused later.
            left: messages in ``played`` that were still queued when the only peer disconnected.
            lost: messages that the fault injection dropped.
            partial: whether the replay is of a part of the recording only.
            stopped: whether the replay was stopped before its end.
        """
        made = sum(number for kind, number in self.made.items() if kind in self._kinds)
        missed = self._fixed + self.passed_over
        missed[LOST] = lost
        missed[NO_PEER] = played.without_peer
        missed[NOT_FOR_PEER] = played.left_out
        missed[LEFT] = left
        missed[REFUSED] = sum(played.refused.values()) + failed
        sent = played.messages - played.without_peer - failed - left
        rest = self.recorded + made - sent - missed.total()
        unsent_before = min(rest, self.before)  # no messages of the recording, whose number `info` shows
        missed[NOT_REACHED if stopped or not partial else OUTSIDE] = rest - unsent_before
        return {
            "recorded": self.recorded - unsent_before,
            "made": made,
            "sent": sent,
            "not_sent": {reason: missed[reason] for reason in REASONS if missed[reason]},
        }


def account_lines(account: dict[str, Any]) -> list[str]:
    """Return the account as lines for people; empty if all messages were sent."""
    not_sent: dict[str, int] = account["not_sent"]
    if not not_sent:
        return []
    made = f" and {account['made']:,} computed" if account["made"] else ""
    head = f"not sent: {sum(not_sent.values()):,} of {count_text(account['recorded'], 'message')} recorded{made}"
    return [head, *(f"  {number:>8,}  {REASONS[reason]}" for reason, number in not_sent.items())]
