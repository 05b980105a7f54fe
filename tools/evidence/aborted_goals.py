"""Sessions of action servers whose goals succeed, are cancelled or abort, and the judge: each abort has its file.

    .venv/bin/python -m tools.evidence.aborted_goals --aborts 1000 --seed 1

The black box has the rule ``action_aborted``.  The judge knows which goals abort: each has one row of one file, that
verifies and has all entries from 2 s before to 0.5 s after it, with the request of its goal if that is in this time.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.triggers import trigger
from igtl_gateway.gateway import LINKS_TOPIC
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.verify import DeclaredLosses, verify
from tests.calls import NS, Goal, entries_of, rows_of
from tests.exchanges import ABORTED, CANCELED, START_NS, SUCCEEDED
from tests.record.samples import string_cdr

BEFORE_S, AFTER_S = 2.0, 0.5
RULE = f"action_aborted,before={BEFORE_S},after={AFTER_S}"
_ACTIONS = ("/drive", "/arm/suture", "/needle/insert")
_SESSION = {"config": "{}"}
#: Aborts of one session.
_EACH = 100


@dataclass(slots=True)
class Outcome:
    """Goals that abort, those with one verifying file that has all of their window, files, and what is wrong."""

    aborts: int = 0
    whole: int = 0
    files: int = 0
    wrong: list[str] = field(default_factory=list)


def goals_of(chosen: Random, aborts: int) -> list[Goal]:
    """Return goals one after the other or several at once, of which as many abort."""
    found: list[Goal] = []
    at_ns, left = NS, aborts
    while left:
        at_ns += chosen.randrange(10**6, 4 * NS) if chosen.randrange(4) else chosen.randrange(10**6, 10**8)
        status = chosen.choice((SUCCEEDED, CANCELED, ABORTED, ABORTED))
        left -= status == ABORTED
        lasts_ns = chosen.randrange(10**7, 3 * NS)
        feedback = tuple(sorted(at_ns + chosen.randrange(3 * 10**6, lasts_ns) for _ in range(chosen.randrange(5))))
        found.append(
            Goal(
                chosen.randbytes(16),
                chosen.randrange(100),
                at_ns,
                at_ns + lasts_ns,
                status,
                cancel_ns=at_ns + lasts_ns // 2 if status == CANCELED else None,
                asked=chosen.random() < 0.8,
                feedback_ns=feedback,
            )
        )
    return found


def world(seed: int, aborts: int) -> Outcome:
    """Record a session, and judge its files."""
    chosen = Random(seed)
    action = chosen.choice(_ACTIONS)
    goals = goals_of(chosen, aborts)
    rows = list(rows_of(action, goals, events=chosen.random() < 0.8))
    rows += [
        (at_ns, "/chatter", "std_msgs/msg/String", string_cdr("a")) for at_ns in range(0, rows[-1][0] + 3 * NS, NS // 5)
    ]
    entries = entries_of(rows)
    outcome = Outcome(aborts=aborts)
    with tempfile.TemporaryDirectory(prefix="igtl-aborts-") as name:
        folder = Path(name)
        recorder = Recorder(
            folder / "box.mcap", _SESSION, qos_of=lambda _topic, _type: None, on_note=lambda _note: None,
            clock=ManualClock(), options=RecordOptions(snapshot_s=5.0, triggers=(trigger(RULE),)),
            rule=StateInputRule(frozenset({LINKS_TOPIC})), host=in_thread,
        )  # fmt: skip
        for entry in entries:
            recorder(entry)
        recorder.close({"streams": {}})
        _judge(folder, entries, goals, outcome)
    return outcome


def _judge(folder: Path, entries: list[Entry], goals: list[Goal], outcome: Outcome) -> None:
    rows = []
    counted: Counter[str] = Counter()
    for path in sorted(folder.glob("*.mcap")):
        with SessionFile.open(path) as file:
            content = list(file.entries())
            report = verify(content, Config(), DeclaredLosses.of(file.session, file.ledger), before=file.prologue())
            found = (file.ledger or {}).get("triggers", [])
        outcome.files += 1
        if not report.good or any(row["missing"] for row in found):
            outcome.wrong.append(f"{path.name}: {report.differences[:1]} {[row['missing'] for row in found]}")
        rows += [(row, {entry.seq for entry in content}) for row in found]
        counted.update({"rows": sum(row["count"] for row in found)})
    if counted["rows"] != outcome.aborts:
        outcome.wrong.append(f"found {counted['rows']} triggers, expected {outcome.aborts}: one for each goal")
    stamps = [entry.stamp_ns for entry in entries]
    for goal in goals:
        if goal.status != ABORTED or goal.ends_ns is None:
            continue
        first = bisect_left(stamps, START_NS + goal.ends_ns)
        at_ns = next(each.stamp_ns for each in entries[first:] if each.channel.endswith("/status"))
        begin = bisect_left(stamps, at_ns - round(BEFORE_S * NS))
        window = {each.seq for each in entries[begin : bisect_right(stamps, at_ns + round(AFTER_S * NS))]}
        own = [numbers for row, numbers in rows if row["at_ns"] <= at_ns <= row["last_ns"]]
        if len(own) == 1 and window <= own[0]:
            outcome.whole += 1
        else:
            outcome.wrong.append(
                f"goal {goal.id.hex()[:8]}: {len(own)} rows, {[len(window - each) for each in own]} lack"
            )


def run(aborts: int, seed: int) -> Outcome:
    """Play sessions until they have that many aborts."""
    outcome = Outcome()
    while outcome.aborts < aborts and not outcome.wrong:
        one = world(seed + outcome.aborts, min(_EACH, aborts - outcome.aborts))
        outcome.aborts += one.aborts
        outcome.whole += one.whole
        outcome.files += one.files
        outcome.wrong += one.wrong
    return outcome


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--aborts", type=int, default=1_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    found = run(options.aborts, options.seed)
    print(f"{found.whole:,} of {found.aborts:,} aborted goals have all of their window in one of {found.files:,} files")
    print(*found.wrong[:20], sep="\n")
    return bool(found.wrong)


if __name__ == "__main__":
    sys.exit(main())
