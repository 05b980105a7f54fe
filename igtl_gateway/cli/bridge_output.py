"""The output of ``bridge``: lines for people with a live status, or JSON lines for programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.entry_watch import EntryWatch
from igtl_gateway.app.note_rate import Event
from igtl_gateway.app.passage import NATIVE_PASSAGE
from igtl_gateway.app.ros_log import note_text
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.globs import matches
from igtl_gateway.base.natural import natural
from igtl_gateway.base.near import did_you_mean, near_names
from igtl_gateway.base.quantities import count_text, seconds_text, size_text
from igtl_gateway.base.stamp import NS_PER_S, utc_text
from igtl_gateway.base.systems import service
from igtl_gateway.base.version import __version__
from igtl_gateway.cli.losses import losses
from igtl_gateway.cli.terminal import clear_live_line, live_line, print_json, print_line
from igtl_gateway.cli.type_tables import mapping, profiles
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.notations import uses_websocket
from igtl_gateway.edges.interface import DISCOVERY_NS
from igtl_gateway.edges.tcp.sockets import address_text
from igtl_gateway.gateway import FAULT
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.expected import NO_SOURCE
from igtl_gateway.gateway.log.clock_offset import PEER_CLOCK_STEP, PEER_NO_CLOCK
from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire.registry import BODIES

if TYPE_CHECKING:
    from igtl_gateway.app.metrics import MetricsServer
    from igtl_gateway.record.recorder import Recorder
    from igtl_gateway.record.reports import RecordingSummary

#: Level of a note → priority in the journal.
_PRIORITIES = {Level.INFO: service.INFO, Level.WARN: service.WARNING, Level.ERROR: service.ERROR}
_MAX_LOSSES = 20  # lines at the end; all are in the recording
_MAX_CAUSES = (
    1000  # causes of notes that are counted apart: a peer that invents device names must not flood the terminal
)


#: Codes of notes that are each printed: they name a file or a source that is missing, or a clock that was set.
_EACH = frozenset(
    {
        CLOCK_STEP,
        NO_SOURCE,
        PEER_CLOCK_STEP,
        PEER_NO_CLOCK,
        "record_failed",
        "record_continued",
        "record_part_lost",
        "record_stalled",
        "record_again",
        "record_space_low",
        "trigger_incomplete",
    }
)


class BridgeOutput(Protocol):
    """How a bridge reports what it does."""

    def started(self, bridge: Bridge, config: Config, notes: list[str], metrics: MetricsServer | None) -> None: ...
    def page(self, link: str, spectators: str) -> None: ...
    def waiting(self, node_name: str) -> None: ...
    def problem(self, text: str) -> None: ...
    def events(self, events: list[Event]) -> None: ...
    def status(self, bridge: Bridge, watch: EntryWatch, seconds: float) -> None: ...
    def stopped(self, bridge: Bridge, watch: EntryWatch) -> None: ...


def _state_of(recorder: Recorder) -> str:
    """Return the state of a recording for the status line, with a space; "": it runs."""
    if recorder.failure:
        return "(FAILED) "
    return "(stopped) " if recorder.rests else "(paused) " if recorder.paused else ""


def _where(bridge: Bridge, summary: RecordingSummary) -> str:
    """Return the file of a recording, or how many files it has."""
    if bridge.options.recording.snapshot_s:
        what = "file" if bridge.options.recording.triggers else "snapshot"
        return f"{count_text(len(summary.files), what)} of {summary.path}"
    beside = [path for path in summary.files if path.parent == summary.path.parent]  # parts are inside of the path
    if len(beside) > 1:
        return f"{count_text(len(beside), 'file')}, the last one {beside[-1]}"
    return str(beside[0] if beside else summary.path)  # the next name if another program took the first file away


class StatusLine:
    """The state of a bridge in one line, with the rates since the last call."""

    def __init__(self) -> None:
        self._last: tuple[float, Counter[Kind]] = (0.0, Counter())

    def __call__(self, bridge: Bridge, watch: EntryWatch, seconds: float) -> str:
        """Return the line, which begins with what matters most; ``seconds`` is the time since the start."""
        before_s, before = self._last
        self._last = (seconds, Counter(watch.counts))
        rates = {kind: (watch.counts[kind] - before[kind]) / max(seconds - before_s, 1e-3) for kind in Kind}
        peers = sum(link.connected for link in bridge.tcp.links())
        dropped = sum(sum(counts.dropped.values()) for counts in bridge.tcp.counters().values())
        recorded = ""
        if bridge.recorder:
            counters = bridge.recorder.counters()
            state = _state_of(bridge.recorder)
            recorded = f"recorded {state}{counters['written_entries']:,}" + (
                f" LOST {counters['dropped_entries']:,}" if counters["dropped_entries"] else ""
            )
        parts = (
            count_text(peers, "peer"),
            recorded,
            f"dropped {dropped:,}" if dropped else "",
            f"rejected {watch.refused:,}" if watch.refused else "",
            f"IGTL {rates[Kind.IGTL_IN]:.0f} in, {rates[Kind.IGTL_OUT]:.0f} out/s",
            f"ROS {rates[Kind.ROS_IN]:.0f} in, {rates[Kind.ROS_OUT]:.0f} out/s",
        )
        return " | ".join(filter(None, parts))


class TextOutput:
    """Lines for people; on a terminal the last one is a live status.

    Marks: ``=`` state, ``!`` fault, ``?`` warning.

    Args:
        terminal: whether the output is one.
        logs: whether notes of a level are shown; the node has a lowest level.
    """

    _MARKS = {Level.INFO: "=", Level.WARN: "?", Level.ERROR: "!"}  # noqa: RUF012

    def __init__(self, terminal: bool, logs: Callable[[Level], bool] = lambda _level: True) -> None:
        self._terminal = terminal
        self._logs = logs
        self._status = ""
        self._status_line = StatusLine()
        self._repeats: Counter[tuple[str, str]] = Counter()
        self._firsts: dict[tuple[str, str], Note] = {}

    def _print(self, text: str, priority: int = service.INFO) -> None:
        if self._terminal:
            clear_live_line()
        print_line(text, flush=True, priority=priority, log=True)
        if self._terminal and self._status:
            live_line(self._status)

    def started(self, bridge: Bridge, config: Config, notes: list[str], metrics: MetricsServer | None) -> None:
        print_line(f"igtl-gateway {__version__}")
        for (host, port), asked in zip(bridge.addresses, bridge.options.listen, strict=True):
            tls = ", TLS" if asked in bridge.options.tls_listen else ""
            websocket = ", WebSocket" if uses_websocket(asked) else ""
            print_line(f"OpenIGTLink  server on {address_text((host, port))}{websocket}{tls}")
        how = "one connection per client (--relay)" if config.relay else "reconnects until stopped"
        for host, port in bridge.options.connect:
            tls = ", TLS" if (host, port) in bridge.options.tls_connect else ""
            print_line(f"OpenIGTLink  client of {address_text((host, port))}{tls}, {how}")
        off = "--relay" if config.relay else "--no-ros"
        print_line(f"ROS 2        node {bridge.ros.full_name}" if bridge.ros else f"ROS 2        off ({off})")
        for note in notes:
            print_line(f"             {note.partition(' (')[0]}")
        until = f", to ROS from {DISCOVERY_NS // NS_PER_S} s after the start on" if bridge.ros else ""
        print_line(
            f"conversion   {f'slower, in Python ({bridge.native_off})' if bridge.native_off else f'fast, in C{until}'}"
        )
        print_line(f"recording    {bridge.options.record or 'off (--record FILE)'}")
        if rules := bridge.options.recording.triggers:
            print_line(f"black box    by {', '.join(map(str, rules))}")
        if metrics:
            print_line(f"metrics      {metrics.url}")
        if config.faults:
            print_line(f"faults       {config.faults}, seed {config.fault_seed} (fault injection)")
        for line in (*denied_lines(config), *limit_lines(bridge.options.limits.bodies), *profiles(config)):
            print_line(line)
        if bridge.ros:
            for line in mapping(config):
                print_line(line)
        print_line("Press Ctrl-C to stop.", flush=True)

    def page(self, link: str, spectators: str) -> None:
        """Print where the page is."""
        self._print(f"page         {link}")
        self._print(f"  read-only  {spectators}")

    def waiting(self, node_name: str) -> None:
        """Print that no session runs: the managed node is unconfigured."""
        self._status = ""
        self._print(f"ROS 2        node {node_name} is unconfigured: another node configures and activates it")

    def problem(self, text: str) -> None:
        """Print why a transition of the managed node failed."""
        self._print(f"! {text}", service.ERROR)

    def events(self, events: list[Event]) -> None:
        for event in events:
            note, links = event.note, event.links
            cause = (note.code, note.subject)
            if cause not in self._repeats and len(self._repeats) >= _MAX_CAUSES:
                cause = (note.code, "(other streams)")
            is_first = cause not in self._repeats
            self._repeats[cause] += 1 + event.more
            if is_first:
                self._firsts[cause] = note
            # the recording has all notes; the terminal has the first of each cause
            is_shown = (note.level is Level.INFO and note.code != FAULT) or is_first or note.code in _EACH
            # that a stream is as fast as any is news only when it was not
            is_shown &= not (is_first and note.code == NATIVE_PASSAGE and bool(note.data.get("native")))
            if is_shown and self._logs(note.level):
                more = f" ({event.more:,} more like it)" if event.more else ""
                self._print(f"{self._MARKS[note.level]} {note_text(note, links)}{more}", _PRIORITIES[note.level])

    def status(self, bridge: Bridge, watch: EntryWatch, seconds: float) -> None:
        if not self._terminal:
            return
        self._status = f"{seconds_text(seconds)} | {self._status_line(bridge, watch, seconds)}"
        live_line(self._status)

    def stopped(self, bridge: Bridge, watch: EntryWatch) -> None:
        if self._terminal:
            clear_live_line()
        counts = watch.counts
        print_line(
            f"stopped; OpenIGTLink: {counts[Kind.IGTL_IN]:,} in, {counts[Kind.IGTL_OUT]:,} out; "
            f"ROS: {counts[Kind.ROS_IN]:,} in, {counts[Kind.ROS_OUT]:,} out; rejected: {watch.refused:,}"
        )
        for reason, number in bridge.tcp.refused().items():
            print_line(f"  connections rejected, {reason}: {number:,}")
        for cause, number in sorted(self._repeats.items(), key=lambda item: natural(self._firsts[item[0]].text)):
            first = self._firsts[cause]
            # notes without trouble were printed each time
            if number > 1 and (first.level is not Level.INFO or first.code == FAULT) and first.code not in _EACH:
                print_line(f"  {count_text(number, 'time')}: {note_text(first, ())}")
        if bridge.summary:
            summary = bridge.summary
            lost, left_out = sum(summary.dropped.values()), sum(summary.left_out.values())
            print_line(
                f"recorded {count_text(summary.entries, 'entry', 'entries')} to {_where(bridge, summary)} "
                f"({size_text(summary.size)})"
                + (f", {left_out:,} not selected" if left_out else "")
                + (f", LOST {lost:,}" if lost else "")
                + (f": {summary.failure}" if summary.failure else "")
            )
        if bridge.uploads:
            print_line(bridge.uploads.left_text())
        lines = losses(bridge.losses)
        for line in lines[:_MAX_LOSSES]:
            print_line(f"  {line}")
        if len(lines) > _MAX_LOSSES:
            print_line(f"  … and {len(lines) - _MAX_LOSSES:,} more lines; `info` of the recording has all")


class JsonOutput:
    """The same facts as JSON lines, each with its UTC time."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def _print(self, event: str, stamp_ns: int = 0, priority: int = service.INFO, **facts: Any) -> None:
        print_json({"time": utc_text(stamp_ns or self._clock.utc_ns()), "event": event} | facts, priority)

    def started(self, bridge: Bridge, config: Config, notes: list[str], metrics: MetricsServer | None) -> None:
        self._print(
            "started",
            version=__version__,
            listen=[{"host": host, "port": port} for host, port in bridge.addresses],
            connect=[{"host": host, "port": port} for host, port in bridge.options.connect],
            ros=bridge.ros is not None,
            record=bridge.options.record,
            metrics=metrics.url if metrics else None,
            config=config.to_dict(),
            environment=notes,
            native=not bridge.native_off,
            native_off=bridge.native_off,
        )

    def page(self, link: str, spectators: str) -> None:
        """Print where the page is."""
        self._print("page", link=link, spectators=spectators)

    def waiting(self, node_name: str) -> None:
        """Print that no session runs: the managed node is unconfigured."""
        self._print("unconfigured", node=node_name)

    def problem(self, text: str) -> None:
        """Print why a transition of the managed node failed."""
        self._print("transition_failed", priority=service.ERROR, text=text)

    def events(self, events: list[Event]) -> None:
        for event in events:
            note = event.note
            self._print(
                event.kind.value,
                event.stamp_ns,
                _PRIORITIES[note.level],
                level=note.level.name,
                code=note.code,
                text=note.text,
                stream=note.stream,
                links=event.links,
                data=note.data,
                **({"more": event.more} if event.more else {}),
            )

    def status(self, bridge: Bridge, watch: EntryWatch, seconds: float) -> None:
        """Print nothing: programs count entries themselves, or use ``--metrics``."""

    def stopped(self, bridge: Bridge, watch: EntryWatch) -> None:
        facts: dict[str, Any] = {"counts": {kind.value: watch.counts[kind] for kind in Kind}}
        if bridge.summary:
            facts["recording"] = {
                "path": bridge.summary.path,
                "entries": bridge.summary.entries,
                "files": bridge.summary.files,
                "dropped": sum(bridge.summary.dropped.values()),
                "left_out": sum(bridge.summary.left_out.values()),
                "bytes": bridge.summary.size,
                "failure": bridge.summary.failure,
            }
        if bridge.uploads:
            facts["upload"] = bridge.uploads.counters()
        if times := bridge.native_times():
            facts["native_times"] = times
        self._print("stopped", **facts, ledger=bridge.losses)


def denied_lines(config: Config) -> list[str]:
    """Return the denied messages as lines, with a mark at a name that matches no known type: it might be misspelt."""
    lines = []
    for globs, way in ((config.deny_in, "from"), (config.deny_out, "to")):
        if globs:
            known = [glob + ("" if any(map(Denials([glob]).type, BODIES)) else _unknown(glob)) for glob in globs]
            lines.append(f"denied       {way} peers: {', '.join(known)}")
    return lines


def limit_lines(bodies: Sequence[tuple[str, int]]) -> list[str]:
    """Return a line about the limits of types (globs) that match no known type."""
    unknown = [f"{glob}{_unknown(glob)}" for glob, _ in bodies if not any(matches(glob, name) for name in BODIES)]
    return [f"max body     {', '.join(unknown)}"] if unknown else []


def _unknown(glob: str) -> str:
    question = did_you_mean(near_names(glob.upper(), sorted(name for name in BODIES if ("_" in name) == ("_" in glob))))
    return f" (matches no known type{question and f'; {question}'})"
