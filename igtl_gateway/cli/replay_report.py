"""The report at the end of ``replay``: what was sent, what was not and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from igtl_gateway.app.replay_account import account_lines
from igtl_gateway.app.replay_options import ReplayOptions
from igtl_gateway.app.replaying import ReplayResult
from igtl_gateway.base.natural import natural
from igtl_gateway.base.quantities import count_text, size_text
from igtl_gateway.cli.terminal import aligned, print_json, print_line


def print_report(options: ReplayOptions, result: ReplayResult, *, as_json: bool) -> None:
    """Print what was sent, what was not and why."""
    if as_json:
        print_json(_facts(options, result))
        return
    played = f"{count_text(result.messages, 'message')}, {size_text(result.bytes)}"
    if result.sent == result.messages:
        print_line(f"{'sent' if result.complete else 'stopped after'} {played}")
    else:
        print_line(f"{'' if result.complete else 'stopped: '}sent {result.sent:,} of the {played}, that were played")
    if result.without_peer:
        print_line(f"  {result.without_peer:,} of them while no peer was connected")
    if result.undelivered:
        print_line(f"  {result.undelivered:,} of them were still queued when their peer disconnected")
    if result.faults is not None:
        counts = Counter(result.faults)
        hit = ", ".join(f"{name} {counts[name]:,}" for name in sorted(counts) if name != "messages" and counts[name])
        print_line(
            f"faults (seed {options.seed}): of {count_text(counts['messages'], 'message')}: {hit or 'none affected'}"
        )
    if result.streams:
        streams = sorted(result.streams.items(), key=lambda item: natural(item[0]))
        rows = [("stream", "messages"), *((stream, f"{many:,}") for stream, many in streams)]
        print_line(*aligned(rows))
    for line in account_lines(result.account) if result.account else ():
        print_line(line)
    for line in _what_peers_got(result):
        print_line(line)
    for line in _what_was_called(result):
        print_line(line)
    for refused in result.refused:
        print_line(f"! not published: {count_text(refused.messages, 'message')} of {refused.stream}: {refused.reason}")
    if options.to == "both" and result.sha256:
        for name, part in result.sides.items():
            print_line(f"{name}: sha256 {part.sha256}")
    if result.sha256:
        print_line(f"sha256 {result.sha256}")


def _facts(options: ReplayOptions, result: ReplayResult) -> dict[str, Any]:
    """The report as JSON values."""
    facts: dict[str, Any] = {
        "file": str(result.file),
        "complete": result.complete,
        "messages": result.messages,
        "sent": result.sent,
        "bytes": result.bytes,
        "without_peer": result.without_peer,
        "unheard": result.without_peer,  # the name in 0.1, until 0.3: in the ledger it means no subscriber
        "undelivered": result.undelivered,
        "refused": [
            {"stream": each.stream, "messages": each.messages, "reason": each.reason} for each in result.refused
        ],
        "sha256": result.sha256,
        "streams": result.streams,
        "account": result.account,
        "left_out": _by_peer(result.left_out),
        "adapted": _by_peer(result.adapted),
        "services": {name: {"done": each.done, "left": dict(each.left)} for name, each in result.calls.items()},
    }
    if options.to == "both":
        facts["sides"] = {
            name: {"messages": part.messages, "bytes": part.bytes, "sha256": part.sha256}
            for name, part in result.sides.items()
        }
    if result.faults is not None:
        facts["faults"] = {"fault": options.fault, "seed": options.seed, "counts": result.faults}
    return facts


def _what_peers_got(result: ReplayResult) -> list[str]:
    """Return a line for each peer that did not get the recorded bytes of all messages."""
    words = (
        (result.left_out, "did not get what it cannot read", " (--exact sends it)"),
        (result.adapted, "got in a form that it can read", ""),
    )
    return [
        f"{address} ({profile}) {what}: {', '.join(f'{name} {number:,}' for name, number in types.items())}{end}"
        for counts, what, end in words
        for (address, profile), types in _of_peers(counts).items()
    ]


def _what_was_called(result: ReplayResult) -> list[str]:
    """Return a line for each service and action that was answered or called, and for each reason why not."""
    done = [f"{name}: {each.text}" for name, each in result.calls.items() if each.done]
    return done + [
        f"! {name}: {why}: {number:,}"
        for name, each in result.calls.items()
        for why, number in each.left.items()
        if number
    ]


def _of_peers(counts: Mapping[tuple[str, str, str], int]) -> dict[tuple[str, str], dict[str, int]]:
    found: dict[tuple[str, str], dict[str, int]] = {}
    for (address, profile, igtl_type), number in sorted(counts.items()):
        found.setdefault((address, profile), {})[igtl_type] = number
    return found


def _by_peer(counts: Mapping[tuple[str, str, str], int]) -> list[dict[str, Any]]:
    """Return counts as JSON values."""
    return [
        {"peer": address, "profile": profile, "types": types} for (address, profile), types in _of_peers(counts).items()
    ]
