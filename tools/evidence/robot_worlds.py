"""Worlds of what a robot gets: ``python tools/evidence/robot_worlds.py --worlds 10000``.

Strategy: each seed is a world of ``tests/app/robot_world.py``, played recorded and not recorded.  Hub, core, guard and
the publishing half of the edge (DDS with and without events of matches, Zenoh) are the real ones; below them is a
middleware on manual time, whose source stamps are known.  The judge there subscribes as robots do, and integrates what
they got by source stamps.  ``--mutate`` takes out one part of the guard at the write after the other: for each, a world
must break a promise.

The exit code is 1 if a world breaks a promise, or a mutation breaks none.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from igtl_gateway.app.ros_traffic import RosTraffic
from igtl_gateway.edges.interface import publishers
from igtl_gateway.edges.ros import publishing
from igtl_gateway.gateway import command_guard
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.orders import Heard, Order, Unwritten, unwritten
from tests.app.robot_world import judged

#: Broken worlds that are shown.
_SHOWN = 10


def _held(traffic: RosTraffic, order: Order) -> Unwritten | None:
    """Publish a command as any other message, which is held for subscribers."""
    traffic._written.append(order.cdr)
    traffic.side.publish(order.topic, order.type, order.cdr, order.qos)
    return None


def _without(**changes: Any) -> Callable[..., Unwritten | None]:
    """Return the rule of the write with some of what it knows replaced."""

    def rule(order: Order, heard: Heard, now_ns: int, passed_ns: int | None) -> Unwritten | None:
        if changes.get("subscribers"):
            heard = Heard(1, heard.joined, heard.unsettled)
        if changes.get("unsettled"):
            heard = Heard(heard.subscribers, heard.joined)
        if changes.get("joined"):
            heard = Heard(heard.subscribers, False, heard.unsettled)
        now_ns = order.stamp_ns if changes.get("age") else now_ns
        return unwritten(order, heard, now_ns, None if changes.get("speed") else passed_ns)

    return rule


def _rule(**changes: Any) -> AbstractContextManager[Any]:
    return mock.patch.object(publishers, "unwritten", _without(**changes))


#: What is taken out → how.
MUTATIONS: Mapping[str, Callable[[], AbstractContextManager[Any]]] = {
    "commands are held and sent late, as other messages": lambda: _both(
        mock.patch.object(RosTraffic, "_write", _held),
        mock.patch.object(publishing.Publishing, "expect_orders", lambda *_: None),
    ),
    "no check at the write": lambda: mock.patch.object(publishers, "unwritten", lambda *_: None),
    "written without a subscriber": lambda: _rule(subscribers=True),
    "another vendor's reader is taken as ready": lambda: _rule(unsettled=True),
    "a stream goes on for a newcomer": lambda: _rule(joined=True),
    "no age at the write": lambda: _rule(age=True),
    "no speed at the write": lambda: _rule(speed=True),
    "the arm need not follow": lambda: mock.patch.object(command_guard.CommandGuard, "_behind_s", lambda *_: 0.0),
    "a refusal at the write is no input": lambda: mock.patch.object(
        command_guard, "note_of", lambda stream, _orders: Note(Level.INFO, "other", "", stream)
    ),
}


def _both(*contexts: AbstractContextManager[Any]) -> ExitStack:
    stack = ExitStack()
    for each in contexts:
        stack.enter_context(each)
    return stack


def _play(seed: int) -> tuple[int, list[str], Counter[str]]:
    try:
        return seed, *judged(seed)
    except Exception as error:  # the seed is what is needed
        return seed, [f"error: {type(error).__name__}: {error}"], Counter()


def _mutant(name: str, first: int, worlds: int) -> tuple[str, int, str]:
    """Return the mutation, the number of the first world that breaks a promise (0: none), and the promise."""
    with MUTATIONS[name]():
        for number in range(1, worlds + 1):
            _, broken, _ = _play(first + number - 1)
            if broken:
                return name, number, broken[0]
    return name, 0, ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0, help="of the first world")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--mutate", action="store_true", help="take out one part after the other")
    options = parser.parse_args()
    begun = time.monotonic()
    failed = 0
    with multiprocessing.get_context("fork").Pool(options.processes) as pool:
        if options.mutate:
            jobs = [(name, options.seed, options.worlds) for name in MUTATIONS]
            for name, number, text in pool.starmap(_mutant, jobs, 1):
                print(f"{name}: {f'world {number}: {text}' if number else 'NOT FOUND'}", flush=True)
                failed += not number
        else:
            total: Counter[str] = Counter()
            rules: Counter[str] = Counter()
            for seed, broken, counts in pool.imap_unordered(
                _play, range(options.seed, options.seed + options.worlds), 8
            ):
                total += counts
                rules.update({text.partition(":")[0] for text in broken})
                failed += bool(broken)
                if broken and failed <= _SHOWN:
                    print(f"world {seed}: {broken[0]} ({len(broken)} in all)", flush=True)
            print(json.dumps({"broken worlds": failed, "rules": rules, **dict(sorted(total.items()))}, indent=1))
    print(f"{time.monotonic() - begun:.0f} s")
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
