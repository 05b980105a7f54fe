"""A replay from its options to its result: what the verb ``replay`` and the Python API share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

from igtl_gateway.app.faulty import FaultyFeed
from igtl_gateway.app.player import Jump, Player
from igtl_gateway.app.replay_account import ReplayAccount
from igtl_gateway.app.replay_calls import CallCounts
from igtl_gateway.app.replay_options import ReplayOptions
from igtl_gateway.app.replay_plan import (
    ReplayPlan,
    check_sends,
    check_streams,
    is_of_dialogue,
    plan_replay,
    planned_entries,
    unplayed,
)
from igtl_gateway.app.replay_sides import ReplaySides, open_sides
from igtl_gateway.app.rows import with_sends
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.faults import LOSS, Fate, Faults
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.moment import check_part
from igtl_gateway.replay.recorded_config import absent_sources, config_to_run, recorded_acceptance
from igtl_gateway.replay.recorded_marks import marked_moment, marks_of
from igtl_gateway.replay.restamp import Restamper
from igtl_gateway.replay.shared_names import shared_names
from igtl_gateway.replay.simclock import period_ns, with_ticks
from igtl_gateway.replay.source import without_messages
from igtl_gateway.replay.timeline import SessionTimeline, clock_steps_of


@dataclass(frozen=True, slots=True)
class SentMessages:
    """What one side of a replay was sent.

    Attributes:
        messages: number of messages.
        bytes: their bytes.
        sha256: SHA-256 of all bytes in the order of sending; None if it was not computed.
    """

    messages: int
    bytes: int
    sha256: str | None


@dataclass(frozen=True, slots=True)
class RefusedMessages:
    """Messages of a stream that ROS did not take, and why.

    Attributes:
        stream: the topic.
        reason: why.
        messages: number of messages.
        at_once: whether ROS rejected them, and not only failed to deliver them later.
    """

    stream: str
    reason: str
    messages: int
    at_once: bool


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """The result of a replay.

    Attributes:
        file: the recording.
        complete: whether the replay reached its end, and everything was sent.
        messages: number of messages that were played.
        bytes: their bytes.
        without_peer: how many of them found no connected peer.
        undelivered: how many of them were still queued when their peer disconnected, once for each peer.
        refused: messages that ROS did not take.
        sha256: SHA-256 of all bytes in the order of sending; None if it was not computed.
        streams: number of messages by stream.
        account: for each recorded message whether it was sent, or why not; None after a loop or a jump.
        sides: the same for OpenIGTLink (``"igtl"``) and ROS (``"ros"``) alone.
        faults: number of injected faults by name; None without fault injection.
        left_out: (address, profile, type) → number of messages that a peer did not get, because it cannot read them.
        adapted: (address, profile, type) → number of messages that a peer got in a form that it can read.
        calls: service or action → what was answered or called.
    """

    file: Path
    complete: bool
    messages: int
    bytes: int
    without_peer: int
    undelivered: int
    refused: tuple[RefusedMessages, ...]
    sha256: str | None
    streams: dict[str, int]
    account: dict[str, Any] | None
    sides: dict[str, SentMessages]
    faults: dict[str, int] | None
    left_out: dict[tuple[str, str, str], int] = field(default_factory=dict)
    adapted: dict[tuple[str, str, str], int] = field(default_factory=dict)
    calls: dict[str, CallCounts] = field(default_factory=dict)

    @property
    def sent(self) -> int:
        """How many messages were played to a peer or to ROS."""
        return int(self.account["sent"]) if self.account else self.messages - self.without_peer


@dataclass(frozen=True, slots=True)
class ReplayEvents:
    """Functions that a replay calls.

    Attributes:
        on_line: a line of text about what it does.
        jumped: a jump of the playback, with the first recorded time (UTC ns).
        fault: the fate of a message with an injected fault.
        controls: returns a context in which the player can be controlled; the replay runs inside.
        ended: the result, after the sides are closed, also if an error ended the replay.
    """

    on_line: Callable[[str], None] = lambda text: None
    jumped: Callable[[Jump, int], None] = lambda jump, start_ns: None
    fault: Callable[[Fate[Entry]], None] = lambda fate: None
    controls: Callable[[SessionFile, Player, ReplaySides], AbstractContextManager[object]] = (
        lambda _file, _player, _side: ExitStack()
    )
    ended: Callable[[ReplayResult], None] = lambda result: None


def run_replay(path: Path, options: ReplayOptions, stop: Event, events: ReplayEvents) -> ReplayResult | None:
    """Replay a recording until its end, or until ``stop`` is set.

    Returns:
        The result; None if ``stop`` was set before the replay started.

    Raises:
        ConfigError: an invalid option, or an option that does not fit the recording.
        GatewayError: the recording has no message for the side; UnsupportedRecording, DamagedRecording, RosError,
            Unavailable.
    """
    clock_ns = None if options.clock_hz is None else period_ns(options.clock_hz)
    results: list[ReplayResult] = []
    with SessionFile.open(path) as file, ExitStack() as at_end, ExitStack() as stack:
        if not file.entry_count:
            raise without_messages(file)  # before it waits for a receiver
        start_ns, end_ns = _part(options, file)
        config = with_sends(config_to_run(file.session, options.config), options.send)
        if options.side and config.relay:
            raise ConfigError(f"--side {options.side}: found a recording of a relay, whose messages are those of peers")
        how = plan_replay(file, options.to, options.through_gateway, options.side)
        check_sends(file, how, options.send)
        faults_of_streams = check_streams(file, config, how, options.streams)
        for fault in faults_of_streams:
            events.on_line(f"! --streams {fault}")
        for text in _mixed(file, how):
            events.on_line(f"! {text}")
        for absent in absent_sources(file, config) if options.config and how.recompute else ():
            events.on_line(f"? {absent}")
        events.on_line(f"{path}: {how.why}")
        pace = SessionTimeline(clock_steps_of(file))
        side = open_sides(options, file, how, stop, stack, events.on_line, relay=config.relay)
        if side is None:
            events.on_line("stopped before the replay started")
            return None

        account = ReplayAccount.of(file, how)
        faults = Faults.parse(options.fault)
        faulty = FaultyFeed(faults, options.seed, events.fault) if faults else None
        role = "client" if options.connect and not options.listen else "server"

        def feed(from_ns: int | None) -> Iterable[Entry]:
            account.begin()
            entries: Iterable[Entry] = planned_entries(
                file, config, how, options.streams, from_ns, end_ns, role, account.passed_over, account.made
            )
            entries = side.calls.select(entries, account.passed_over) if side.calls else entries
            entries = faulty(entries) if faulty else entries
            return entries if clock_ns is None else with_ticks(entries, from_ns, clock_ns, pace)

        player = Player(
            feed,
            side.send,
            SystemClock(),
            stop,
            rate=options.rate,
            paused=options.paused,
            loop=options.loop,
            span=(start_ns or file.start_ns, file.end_ns if end_ns is None else end_ns),
            start_ns=start_ns,
            restamp=_restamper(options, file, events.on_line),
            admit=side.admit,
            admit_all=side.admit_all,
            on_jump=lambda jump: events.jumped(jump, file.start_ns),
            send_all=side.send_all,
            digest=options.digest,
            pace=pace,
        )
        complete = False

        def end() -> None:
            partial = any(each is not None for each in (options.start, options.end, options.duration))
            results.append(_result(path, player, side, complete, faulty, account, partial))
            events.ended(results[0])

        # when the edges are closed: what still left then counts as sent, and what did not does not
        at_end.callback(end)
        stack.enter_context(events.controls(file, player, side))
        stop.wait(options.delay_s)
        try:
            player.run()
        finally:
            complete = side.finish() and not stop.is_set()
        if complete and not faults_of_streams:
            for fault in unplayed(options.streams, player.played.by_stream):
                events.on_line(f"! --streams {fault}")
    if complete and (why := _why_nothing(player, options, how)):
        raise GatewayError(f"{path}: found no messages for {options.to}: {why}")
    return results[0]


def _why_nothing(player: Player, options: ReplayOptions, how: ReplayPlan) -> str:
    """Return why nothing that was asked for was sent; "" if something was."""
    played = player.played
    if not played.messages:
        if played.refused:
            return next(iter(played.refused))[1]
        if played.left_out:
            return f"no connected peer can read the {count_text(played.left_out, 'message')}; --exact sends them"
        return "see `igtl-gateway info`, --side and --send"
    asked = options.side or options.streams or options.to != "igtl"
    if asked or not all(is_of_dialogue(name.partition("/")[0]) for name in played.by_stream):
        return ""
    types = ", ".join(sorted({name.partition("/")[0] for name in played.by_stream}))
    return f"only {types} was sent; expected data of devices: see `igtl-gateway info`, --side and --send"


def _part(options: ReplayOptions, file: SessionFile) -> tuple[int | None, int | None]:
    """Return first and last time in UTC ns; None without an option."""
    # a file that begins midway begins with the state there, as any part does
    start_ns = file.start_ns if file.prologue() else None
    end_ns = None
    marks = partial(marks_of, file)
    if options.start is not None:
        start_ns = marked_moment(options.start, file.start_ns, "--start", marks)
    if options.end is not None:
        end_ns = marked_moment(options.end, file.start_ns, "--end", marks)
    elif options.duration is not None:
        end_ns = (file.start_ns if start_ns is None else start_ns) + round(options.duration * NS_PER_S)
    check_part(start_ns, end_ns, file.start_ns, file.end_ns, is_empty_part=False)
    return start_ns, end_ns


def _restamper(options: ReplayOptions, file: SessionFile, tell: Callable[[str], None]) -> Restamper | None:
    if options.restamp == "keep":
        return None
    return Restamper(
        options.restamp,
        lambda name: tell(f"! stamps of {name} are not changed: unknown type"),
        file.definitions,
        recorded_acceptance(file),
    )


def _mixed(file: SessionFile, how: ReplayPlan) -> Iterator[str]:
    """Yield what receivers of a replay would take for one movement, and is not."""
    if file.merge:
        yield from (f"reported by {each}" for each in file.merge.reported)
    elif how.kinds & {Kind.IGTL_IN, Kind.ROS_OUT}:
        yield from (note.text for note in shared_names(file))


def _result(
    path: Path,
    player: Player,
    side: ReplaySides,
    complete: bool,
    faulty: FaultyFeed | None,
    account: ReplayAccount,
    partial: bool,
) -> ReplayResult:
    """Return what was sent, what was not and why; after the sides are closed."""
    played = player.played
    refused = {key: (number, True) for key, number in played.refused.items()}
    for stream, number in side.failed().items():  # those that were held for their subscribers, and failed then
        if later := number - sum(many for (name, _), many in played.refused.items() if name == stream):
            refused[stream, "ROS did not take it"] = later, False
    failed = sum(number for number, at_once in refused.values() if not at_once)
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
    return ReplayResult(
        path,
        complete,
        played.messages - failed,
        played.bytes,
        played.without_peer,
        undelivered,
        tuple(RefusedMessages(*key, *counts) for key, counts in sorted(refused.items())),
        played.digest,
        dict(played.by_stream),
        facts,
        {name: SentMessages(part.messages, part.bytes, part.digest) for name, part in sorted(player.sides.items())},
        dict(faulty.counts) if faulty else None,
        dict(side.listeners.left_out) if side.listeners else {},
        dict(side.listeners.adapted) if side.listeners else {},
        dict(sorted(side.calls.counts().items())) if side.calls else {},
    )
