"""The report at the end of ``replay``: what was sent, what was not and why."""

from __future__ import annotations

import argparse
from typing import Any

from igtl_gateway.app.faulty import FaultyFeed
from igtl_gateway.app.player import Player
from igtl_gateway.app.replay_account import ReplayAccount, account_lines
from igtl_gateway.cli.common import count_text, size_text
from igtl_gateway.cli.replay_sides import ReplaySides
from igtl_gateway.cli.terminal import cell, print_json, print_line
from igtl_gateway.faults import LOSS


def print_report(
    options: argparse.Namespace,
    player: Player,
    side: ReplaySides,
    complete: bool,
    faulty: FaultyFeed | None,
    account: ReplayAccount,
    partial: bool,
) -> None:
    """Print what was sent, what was not and why; after the edges are closed."""
    played = player.played
    refused = dict(played.refused)
    for stream, number in side.failed().items():  # those that were held for their subscribers, and failed then
        if later := number - sum(many for (name, _), many in played.refused.items() if name == stream):
            refused[stream, "ROS did not take it"] = later
    failed = sum(refused.values()) - played.refused.total()
    undelivered, single = side.undelivered()
    facts = None
    if account.passes == 1:  # a loop or a jump sends messages again
        facts = account.facts(
            played,
            failed=failed,
            left=undelivered if single else 0,
            lost=faulty.counts[LOSS] if faulty else 0,
            partial=partial,
            stopped=not complete,
        )
    if options.json:
        result: dict[str, Any] = {
            "file": str(options.file),
            "complete": complete,
            "messages": played.messages - failed,
            "bytes": played.bytes,
            "unheard": played.without_peer,
            "undelivered": undelivered,
            "refused": [
                {"stream": stream, "messages": number, "reason": reason}
                for (stream, reason), number in sorted(refused.items())
            ],
            "sha256": played.digest,
            "streams": played.by_stream,
            "account": facts,
        }
        if options.to == "both":
            result["sides"] = {
                name: {"messages": part.messages, "bytes": part.bytes, "sha256": part.digest}
                for name, part in sorted(player.sides.items())
            }
        if faulty:
            result["faults"] = {"fault": options.fault, "seed": options.seed, "counts": faulty.counts}
        print_json(result)
        return
    sent = count_text(played.messages - failed, "message")
    print_line(f"{'sent' if complete else 'stopped after'} {sent}, {size_text(played.bytes)}")
    if played.without_peer:
        print_line(f"  {played.without_peer:,} of them while no peer was connected")
    if undelivered:
        print_line(f"  {undelivered:,} of them were still queued when their peer disconnected")
    if faulty:
        counts = faulty.counts
        hit = ", ".join(f"{name} {counts[name]:,}" for name in sorted(counts) if name != "messages" and counts[name])
        print_line(
            f"faults (seed {options.seed}): of {count_text(counts['messages'], 'message')}: {hit or 'none affected'}"
        )
    for stream, number in sorted(played.by_stream.items()):
        print_line(f"  {cell(stream, 40)} {number:>8,}")
    for line in account_lines(facts) if facts else ():
        print_line(line)
    for (stream, reason), number in sorted(refused.items()):
        print_line(f"! not published: {count_text(number, 'message')} of {stream}: {reason}")
    if options.to == "both" and played.digest:
        for name, part in sorted(player.sides.items()):
            print_line(f"{name}: sha256 {part.digest}")
    if played.digest:
        print_line(f"sha256 {played.digest}")
