"""The account of a replay: it adds up for every recording, side and part."""

from __future__ import annotations

import threading
from collections import Counter
from pathlib import Path

from igtl_gateway.app.faulty import FaultyFeed
from igtl_gateway.app.player import PlaybackCounts, Player
from igtl_gateway.app.replay_account import (
    LEFT,
    LOST,
    NO_PEER,
    NOT_REACHED,
    OUTSIDE,
    REFUSED,
    ReplayAccount,
    account_lines,
)
from igtl_gateway.app.replay_plan import plan_replay, planned_entries
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import RosError
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.faults import Faults
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.source import FORMS, RECOMPUTED, STREAMS
from tests.app.test_replay_plan import split
from tests.places import FIXTURES
from tests.tables import table

TYPES = FIXTURES / "paper-types.mcap"


def played(
    path: Path,
    to: str,
    *,
    recompute: bool = False,
    streams: tuple[str, ...] = (),
    part: tuple[float, float] | None = None,
    faults: str = "",
    refuse: str = "",
    stop_after: int = 1 << 30,
) -> dict[str, object]:
    """The account of a replay whose sides accept everything except the stream ``refuse``."""
    with SessionFile.open(path) as file:
        how = plan_replay(file, to, recompute)
        account = ReplayAccount.of(file, how)
        start_ns, end_ns = (file.start_ns + round(s * 1e9) for s in part) if part else (None, None)
        faulty = FaultyFeed(Faults.parse(faults), 7)
        stop = threading.Event()
        sent: list[Entry] = []

        def feed(from_ns: int | None) -> object:
            account.begin()
            return faulty(
                planned_entries(
                    file, Config(), how, streams, from_ns, end_ns, "server", account.passed_over, account.made
                )
            )

        def send(entry: Entry) -> bool:
            if entry.channel == refuse:
                raise RosError("unknown type")
            sent.append(entry)
            if len(sent) == stop_after:
                stop.set()
            return len(sent) % 10 != 0

        player = Player(feed, send, SystemClock(), stop, rate=None, start_ns=start_ns)  # type: ignore[arg-type]
        run = player.run()
        facts = account.facts(
            run, failed=0, left=2, lost=faulty.counts["loss"], partial=part is not None, stopped=stop.is_set()
        )
    missed = facts["not_sent"]
    assert facts["recorded"] + facts["made"] == facts["sent"] + sum(missed.values())
    assert facts["sent"] == len(sent) - len(sent) // 10 - 2, "what was sent is what the sides took"
    assert missed.get(NO_PEER, 0) == len(sent) // 10 and missed[LEFT] == 2
    assert min(missed.values()) > 0
    assert account_lines(facts)[0].startswith(f"not sent: {sum(missed.values()):,} of ")
    return missed


@table("to", ["igtl", "ros", "both"])
@table("name", ["paper-types", "every-type", "acquisition", "lego"])
@table("recompute", [False, True])
def test_all_of_a_recording_is_accounted_for(name: str, to: str, recompute: bool) -> None:
    missed = played(FIXTURES / f"{name}.mcap", to, recompute=recompute)
    assert not {NOT_REACHED, OUTSIDE, REFUSED, LOST} & set(missed), missed
    assert (RECOMPUTED in missed) == recompute


@table("to", ["igtl", "ros", "both"])
def test_what_came_before_a_part_is_no_message_of_it(to: str, tmp_path: Path) -> None:
    """`info` has the number of the recording; the inputs of its prologue are not "not reached"."""
    with SessionFile.open(split(tmp_path)[1]) as file:
        most, least = file.entry_count + len(file.prologue()), file.entry_count
        assert most > least
        how = plan_replay(file, to, recompute=False)
        account = ReplayAccount.of(file, how)
        entries = planned_entries(
            file, Config(), how, (), file.start_ns, None, "server", account.passed_over, account.made
        )
        sent = Counter(entry.stamp_ns >= file.start_ns for entry in entries)
        played = PlaybackCounts(messages=sum(sent.values()))
        facts = account.facts(played, failed=0, left=0, lost=0, partial=False, stopped=False)
    assert facts["recorded"] == least + sent[False], "latched messages of before are sent"
    assert NOT_REACHED not in facts["not_sent"]


def test_each_reason_has_its_number() -> None:
    assert FORMS in played(TYPES, "igtl")
    assert STREAMS in played(TYPES, "igtl", streams=("STRING/*",))
    assert OUTSIDE in played(TYPES, "both", part=(0.5, 1.5))
    assert NOT_REACHED in played(TYPES, "igtl", stop_after=5)
    assert LOST in played(TYPES, "igtl", faults="loss=30%")
    missed = played(TYPES, "ros", refuse="/igtl/in/Greeting/string")
    assert missed[REFUSED] == 2
