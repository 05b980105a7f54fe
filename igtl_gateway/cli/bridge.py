"""``igtl-gateway bridge``: the gateway, live, until Ctrl-C."""

from __future__ import annotations

import argparse
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from igtl_gateway import __version__
from igtl_gateway.app.bridge import Address, Bridge, BridgeOptions
from igtl_gateway.app.interpreter import tune_interpreter
from igtl_gateway.app.status import BridgeStatus
from igtl_gateway.cli import admission, recording
from igtl_gateway.cli.common import (
    DEFAULT_HOST,
    DEFAULT_PORT,
    add_addresses,
    add_faults,
    add_routes,
    address,
    addresses,
    count_text,
    load_config,
    size_text,
    stop_event,
    with_routes,
)
from igtl_gateway.cli.edge_file import completed
from igtl_gateway.cli.losses import losses
from igtl_gateway.cli.terminal import clear_live_line, is_terminal, live_line, print_json, print_line
from igtl_gateway.clock import Clock, SystemClock
from igtl_gateway.config import AUTO, Config
from igtl_gateway.convert.igtl_msgs import Query
from igtl_gateway.convert.table import TO_IGTL, TO_ROS, ConversionToRos, Role
from igtl_gateway.edges.ros.env import prepare_environment, tune_malloc
from igtl_gateway.edges.video import CODECS, VideoOptions
from igtl_gateway.errors import ConfigError, ViewerError
from igtl_gateway.extras import missing
from igtl_gateway.faults import RelayFaults
from igtl_gateway.gateway import FAULT
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note
from igtl_gateway.stamp import NS_PER_S, utc_text

if TYPE_CHECKING:
    from igtl_gateway.app.metrics import MetricsServer
    from igtl_gateway.view.live import LiveWindow

EXAMPLES = """\
  igtl-gateway bridge                                    server on 127.0.0.1:18944, ROS 2 node /igtl_gateway
  igtl-gateway bridge --record out.mcap                  … and everything that is said goes into out.mcap
  igtl-gateway bridge --connect 127.0.0.1:18945          client of a PLUS server
  igtl-gateway bridge --listen 0.0.0.0:18944 --allow 192.168.7.0/24
  igtl-gateway bridge --listen 0.0.0.0:18944 --allow any --tls-cert or1.pem --tls-ca clinic.pem
                                                         … and only to who has a certificate of the clinic
  igtl-gateway bridge --deny-in '*'                      viewers see all and command nothing
  igtl-gateway bridge --send /camera/image_raw=Camera    a ROS topic goes out as device Camera
  igtl-gateway bridge --tf-out tool0:base_link           the tool of a robot goes out as tool0Tobase_link
  igtl-gateway bridge --video-codec h264                 images go out as encoded VIDEO
  igtl-gateway bridge --view                             … and is seen in rerun's window, live
  igtl-gateway bridge --no-ros --record slicer.mcap      flight recorder without ROS
  igtl-gateway bridge --record long.mcap --split-size 1024   a new file after each GiB, in the folder long
  igtl-gateway bridge --record last.mcap --snapshot 30   the last 30 s, whenever key s is pressed
  igtl-gateway bridge --relay --listen :18944 --connect 127.0.0.1:18945 --record talk.mcap
                                                         record what two OpenIGTLink programs say to each other
  igtl-gateway bridge --relay --listen :18944 --connect 127.0.0.1:18945 --fault delay=50ms,loss=1% --seed 7
                                                         … over a bad line, to see what they make of it
  igtl-gateway bridge --metrics 9464                     counts for Prometheus at http://127.0.0.1:9464/metrics

What a device sends appears on /igtl/in/<device>/<kind>; what is published on /igtl/out/<device> goes out."""

_STATUS_EVERY_S = 0.5
_MAX_EVENTS = 1000  # notes waiting to be printed; a flood of them must not cost memory
_MAX_LOSSES = 20  # lines at the end; all are in the recording
_MAX_CAUSES = 1000  # causes of notes told one by one: a peer that invents device names must not flood the terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_addresses(parser, admission.peer_address, "[tls://]HOST:PORT")
    admission.add_tls(parser)
    admission.add_limits(parser)
    parser.add_argument("--record", type=Path, metavar="FILE", help="record everything into this MCAP file")
    parser.add_argument("--config", type=Path, metavar="TOML", help="configuration file")
    add_routes(parser)
    parser.add_argument(
        "--video-codec",
        choices=CODECS,
        help="encode the ROS images that go out as VIDEO, and decode VIDEO into ROS images (needs PyAV)",
    )
    parser.add_argument(
        "--video-bit-rate", type=int, default=4_000, metavar="KBIT", help="with --video-codec (%(default)s kbit/s)"
    )
    parser.add_argument(
        "--video-key-interval", type=int, default=30, metavar="N", help="frames between key frames (%(default)s)"
    )
    parser.add_argument("--no-ros", action="store_true", help="OpenIGTLink only")
    parser.add_argument("--no-diagnostics", action="store_true", help="nothing on /diagnostics")
    parser.add_argument("--no-watch", action="store_true", help="no notes on odd streams: units that jump, odd stamps")
    parser.add_argument(
        "--relay",
        action="store_true",
        help="man in the middle: each client of --listen talks to the server of --connect, bytes unchanged; no ROS",
    )
    add_faults(parser, ".  in:NAME=VALUE: of what clients say to the server only; out:NAME=VALUE: of what it says")
    parser.add_argument("--view", action="store_true", help="show everything in rerun's window, live")
    parser.add_argument("--node-name", default="igtl_gateway", metavar="NAME", help="of the ROS node (%(default)s)")
    recording.add_arguments(parser)
    parser.add_argument("--duration", type=float, metavar="S", help="stop after so many seconds")
    parser.add_argument("--types", action="store_true", help="list every type and what it becomes, then end")
    parser.add_argument(
        "--metrics",
        type=address,
        metavar="[HOST:]PORT",
        help="counts, rates and queues over HTTP, read-only: /metrics for Prometheus, /status as JSON",
    )
    parser.add_argument(
        "--log-format", choices=("text", "json"), default="text", help="json: one object a line, with its time (text)"
    )
    parser.add_argument("--json", dest="log_format", action="store_const", const="json", help="as --log-format json")


def run(options: argparse.Namespace) -> int:
    if options.types:
        print_line(*types())
        return 0
    how = recording.record_options(options)
    if options.duration is not None and not 0 < options.duration < float("inf"):
        raise ConfigError(f"--duration: found {options.duration:g}, expected a number of seconds above 0")
    options = completed(options, options.config)
    listen, connect = addresses(options)
    config = with_routes(load_config(options.config), options)
    config = replace(config, watch=False) if options.no_watch else config.watched()
    if options.relay or config.relay:
        config, listen = _relayed(config, options, listen, connect)
        options.no_ros = True
    elif options.fault:
        raise ConfigError("--fault: found no --relay, expected it: faults are of a line between two programs")
    tls_listen, tls_connect = admission.secured(options, listen, connect)
    watch = _EntryWatch()
    clock = SystemClock()
    with stop_event() as stop:
        notes = [tune_malloc()] if options.no_ros else prepare_environment()
        window = _window(config) if options.view else None
        bridge = Bridge(
            config,
            BridgeOptions(
                listen,
                connect,
                ros=not options.no_ros,
                record=options.record,
                record_topics=("**",) if options.record_all else tuple(options.record_topics),
                allow=tuple(options.allow),
                limits=admission.limits(options),
                tls=admission.tls(options),
                tls_listen=tls_listen,
                tls_connect=tls_connect,
                node_name=options.node_name,
                recording=how,
                video=_video(options),
                diagnostics=not (options.no_ros or options.no_diagnostics),
            ),
            clock,
            watch,
            window,
        )
        status = BridgeStatus(bridge, watch, clock)
        metrics: MetricsServer | None = None
        try:
            if options.metrics:  # before the recording: a port that is taken must not cost that of yesterday
                metrics = _metrics(options, status)
            bridge.start()
            if metrics:
                status.sample()
        except Exception:
            if metrics:
                metrics.close()
            if window:
                window.close()
            raise
        out: _BridgeOutput = _JsonOutput(clock) if options.log_format == "json" else _TextOutput(is_terminal())
        started_ns = clock.monotonic_ns()
        try:
            with recording.recording_controls(bridge.recorder) as keys:
                out.started(bridge, config, [*notes, keys] if keys else notes, metrics)
                tune_interpreter()
                while not stop.wait(_STATUS_EVERY_S):
                    out.events(watch.take())
                    seconds = (clock.monotonic_ns() - started_ns) / NS_PER_S
                    out.status(bridge, watch, seconds)
                    if metrics:
                        status.sample()
                    if bridge.has_failed or (options.duration and seconds >= options.duration):
                        break
        finally:
            if metrics:
                metrics.close()
            bridge.stop()
            unseen = window.close() if window else ""
        out.events(watch.take())
        out.stopped(bridge, watch)
        if unseen:
            print_line(f"igtl-gateway bridge: --view: {unseen}", error=True)
    return 1 if bridge.summary and bridge.summary.failure else 0


def _relayed(
    config: Config, options: argparse.Namespace, listen: tuple[Address, ...], connect: tuple[Address, ...]
) -> tuple[Config, tuple[Address, ...]]:
    """Configuration and addresses to listen at of a relay."""
    if len(connect) != 1:
        raise ConfigError(f"--relay: found {len(connect)} servers, expected one: --connect HOST:PORT")
    if RelayFaults.parse(options.fault):
        config = replace(config, relay=True, faults=options.fault, fault_seed=options.seed)
    return replace(config, relay=True), listen or ((DEFAULT_HOST, DEFAULT_PORT),)


def _video(options: argparse.Namespace) -> VideoOptions | None:
    if not options.video_codec:
        return None
    if options.no_ros:
        raise ConfigError("--video-codec encodes images of ROS: it cannot be used with --no-ros")
    return VideoOptions(options.video_codec, options.video_bit_rate * 1000, options.video_key_interval)


def _metrics(options: argparse.Namespace, status: BridgeStatus) -> MetricsServer:
    from igtl_gateway.app.metrics import MetricsServer

    host, port = options.metrics
    status.sample()
    return MetricsServer(host, port, status, tuple(options.allow))


def _window(config: Config) -> LiveWindow:
    if find_spec("rerun") is None:
        raise ViewerError(missing("rerun"))
    from igtl_gateway.view.live import LiveWindow

    return LiveWindow(config)


@dataclass(frozen=True, slots=True)
class _Event:
    """A note in the log."""

    stamp_ns: int
    kind: Kind
    note: Note
    links: tuple[int, ...]


class _EntryWatch:
    """Counts entries and keeps the notes among them until they are printed; called under the hub's lock."""

    def __init__(self) -> None:
        self.counts: Counter[Kind] = Counter()
        self.refused = 0
        self._events: deque[_Event] = deque(maxlen=_MAX_EVENTS)

    def __call__(self, entry: Entry) -> None:
        self.counts[entry.kind] += 1
        if entry.kind in _NOTES:
            note = Note.unpack(entry.data())
            self.refused += note.level >= Level.ERROR
            self._events.append(_Event(entry.stamp_ns, entry.kind, note, entry.links))

    def take(self) -> list[_Event]:
        """The notes since the last call."""
        taken = []
        while self._events:
            taken.append(self._events.popleft())
        return taken


_NOTES = frozenset({Kind.LINK, Kind.EDGE_NOTE, Kind.NOTE})


class _BridgeOutput(Protocol):
    """How a bridge tells what it does."""

    def started(self, bridge: Bridge, config: Config, notes: list[str], metrics: MetricsServer | None) -> None: ...
    def events(self, events: list[_Event]) -> None: ...
    def status(self, bridge: Bridge, watch: _EntryWatch, seconds: float) -> None: ...
    def stopped(self, bridge: Bridge, watch: _EntryWatch) -> None: ...


class _TextOutput:
    """Lines for people; on a terminal the last one is a live status.

    Marks: ``=`` state, ``!`` fault, ``?`` warning.
    """

    _MARKS = {Level.INFO: "=", Level.WARN: "?", Level.ERROR: "!"}  # noqa: RUF012

    def __init__(self, terminal: bool) -> None:
        self._terminal = terminal
        self._status = ""
        self._last: tuple[float, Counter[Kind]] = (0.0, Counter())
        self._repeats: Counter[tuple[str, str]] = Counter()

    def _print(self, text: str) -> None:
        if self._terminal:
            clear_live_line()
        print_line(text, flush=True)
        if self._terminal and self._status:
            live_line(self._status)

    def started(self, bridge: Bridge, config: Config, notes: list[str], metrics: MetricsServer | None) -> None:
        print_line(f"igtl-gateway {__version__}")
        for (host, port), asked in zip(bridge.addresses, bridge.options.listen, strict=True):
            print_line(f"OpenIGTLink  server on {host}:{port}{', TLS' if asked in bridge.options.tls_listen else ''}")
        how = "a connection for each client (--relay)" if config.relay else "reconnecting"
        for host, port in bridge.options.connect:
            tls = ", TLS" if (host, port) in bridge.options.tls_connect else ""
            print_line(f"OpenIGTLink  client of {host}:{port}{tls}, {how}")
        off = "--relay" if config.relay else "--no-ros"
        print_line(f"ROS 2        node /{bridge.options.node_name}" if bridge.ros else f"ROS 2        off ({off})")
        for note in notes:
            print_line(f"             {note.partition(' (')[0]}")
        print_line(f"recording    {bridge.options.record or 'off (--record FILE)'}")
        if metrics:
            print_line(f"metrics      {metrics.url}")
        if config.faults:
            print_line(f"faults       {config.faults}, seed {config.fault_seed}: messages are spoilt on purpose")
        for line in (*admission.denials(config), *profiles(config)):
            print_line(line)
        if bridge.ros:
            for line in mapping(config):
                print_line(line)
        print_line("Ctrl-C stops.", flush=True)

    def events(self, events: list[_Event]) -> None:
        for event in events:
            note, links = event.note, event.links
            cause = (note.code, note.stream)
            if cause not in self._repeats and len(self._repeats) >= _MAX_CAUSES:
                cause = (note.code, "(other streams)")
            self._repeats[cause] += 1
            # everything is in the recording; here each cause of trouble is told once
            if (note.level is Level.INFO and note.code != FAULT) or self._repeats[cause] == 1:
                link = f" [link {', '.join(map(str, links))}]" if links else ""
                self._print(f"{self._MARKS[note.level]} {note.text}{link}")

    def status(self, bridge: Bridge, watch: _EntryWatch, seconds: float) -> None:
        if not self._terminal:
            return
        before_s, before = self._last
        self._last = (seconds, Counter(watch.counts))
        rates = {kind: (watch.counts[kind] - before[kind]) / max(seconds - before_s, 1e-3) for kind in Kind}
        peers = sum(link.connected for link in bridge.tcp.links())
        dropped = sum(sum(counts.dropped.values()) for counts in bridge.tcp.counters().values())
        recorded = ""
        if bridge.recorder:
            told = bridge.recorder.counters()
            recorded = f" | rec {'paused ' if bridge.recorder.paused else ''}{told['written_entries']:,}" + (
                f" LOST {told['dropped_entries']:,}" if told["dropped_entries"] else ""
            )
        self._status = (
            f"{seconds:6.0f} s | {count_text(peers, 'peer')} | OpenIGTLink < {rates[Kind.IGTL_IN]:.0f}/s "
            f"> {rates[Kind.IGTL_OUT]:.0f}/s | ROS < {rates[Kind.ROS_IN]:.0f}/s > {rates[Kind.ROS_OUT]:.0f}/s | "
            f"dropped {dropped:,} refused {watch.refused:,}{recorded}"
        )
        live_line(self._status)

    def stopped(self, bridge: Bridge, watch: _EntryWatch) -> None:
        if self._terminal:
            clear_live_line()
        counts = watch.counts
        print_line(
            f"stopped.  OpenIGTLink: {counts[Kind.IGTL_IN]:,} in, {counts[Kind.IGTL_OUT]:,} out.  "
            f"ROS: {counts[Kind.ROS_IN]:,} in, {counts[Kind.ROS_OUT]:,} out.  refused: {watch.refused:,}"
        )
        for reason, number in bridge.tcp.refused().items():
            print_line(f"  connections refused, {reason}: {number:,}")
        for cause, number in sorted(self._repeats.items()):
            if number > 1 and cause[0] not in ("stream",):
                print_line(f"  {' '.join(filter(None, cause))}: {number:,} times")
        if bridge.summary:
            summary = bridge.summary
            lost, left_out = sum(summary.dropped.values()), sum(summary.left_out.values())
            files = f"{count_text(len(summary.files), 'snapshot')} of " if bridge.options.recording.snapshot_s else ""
            print_line(
                f"recorded {count_text(summary.entries, 'entry', 'entries')} into {files}{summary.path} "
                f"({size_text(summary.size)})"
                + (f", left out {left_out:,}" if left_out else "")
                + (f", LOST {lost:,}" if lost else "")
                + (f": {summary.failure}" if summary.failure else "")
            )
        lines = losses(bridge.losses)
        for line in lines[:_MAX_LOSSES]:
            print_line(f"  {line}")
        if len(lines) > _MAX_LOSSES:
            print_line(f"  … and {len(lines) - _MAX_LOSSES:,} more kinds of losses")


class _JsonOutput:
    """The same facts as JSON lines, each with its UTC time."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def _print(self, event: str, stamp_ns: int = 0, **facts: Any) -> None:
        print_json({"time": utc_text(stamp_ns or self._clock.utc_ns()), "event": event} | facts)

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
        )

    def events(self, events: list[_Event]) -> None:
        for event in events:
            note = event.note
            self._print(
                event.kind.value,
                event.stamp_ns,
                level=note.level.name,
                code=note.code,
                text=note.text,
                stream=note.stream,
                links=event.links,
                data=note.data,
            )

    def status(self, bridge: Bridge, watch: _EntryWatch, seconds: float) -> None:
        """Programs count for themselves, or ask ``--metrics``."""

    def stopped(self, bridge: Bridge, watch: _EntryWatch) -> None:
        told: dict[str, Any] = {"counts": {kind.value: watch.counts[kind] for kind in Kind}}
        if bridge.summary:
            told["recording"] = {
                "path": bridge.summary.path,
                "entries": bridge.summary.entries,
                "files": bridge.summary.files,
                "dropped": sum(bridge.summary.dropped.values()),
                "left_out": sum(bridge.summary.left_out.values()),
                "bytes": bridge.summary.size,
                "failure": bridge.summary.failure,
            }
        self._print("stopped", **told, ledger=bridge.losses)


def mapping(config: Config) -> list[str]:
    """What goes where, in a few lines: the rules, and the rows of the configuration."""
    tf = ", poses on /tf too" if config.publish_tf else ""
    lines = [
        f"mapping      devices appear on /igtl/in/<device>/<kind>{tf} ({config.igtl_unit} -> {config.ros_unit})",
        f"             what is published on /igtl/out/<device> goes out ({config.ros_unit} -> {config.igtl_unit})",
        "             igtl-gateway bridge --types lists every type",
    ]
    for rule in config.to_ros:
        kinds = f", {', '.join(rule.kinds)}" if rule.kinds else ""
        lines.append(f"  device {rule.device} -> {rule.topic}{kinds}")
    for sent in config.to_igtl:
        lines.append(f"  {sent.topic} -> {sent.type or 'type by table'}, device {sent.device or 'by topic'}")
    for request in (row.request() for row in config.tf_out):
        frames = ", ".join(request.frames)
        lines.append(f"  frame {frames} in {request.base} -> {request.type}, device {request.device}")
    return lines


def profiles(config: Config) -> list[str]:
    """What the peers are taken for, where somebody has said so."""
    told = [(peer.at, peer.profile) for peer in config.peers]
    if config.profile != AUTO:
        told.append(("all others" if told else "all", config.profile))
    return [f"peers        {at}: {profile}" for at, profile in told]


def types() -> list[str]:
    """Every type that is converted, as lines of two tables."""
    lines = ["OpenIGTLink -> ROS: topic /igtl/in/<device>/<kind>", ""]
    rows = [(_names(row.igtl_types), row.topic or row.kind, row.message.TYPE, _role(row)) for row in TO_ROS]
    lines += _table(("type", "kind", "ROS message", ""), rows)
    lines += ["", "ROS -> OpenIGTLink: topic /igtl/out/<device>, or --send TOPIC=DEVICE[:TYPE]", ""]
    by_type: dict[str, list[str]] = {}
    for out in TO_IGTL:
        by_type.setdefault(out.message.TYPE, []).append(out.igtl_type)
    by_type[Query.TYPE] = ["GET_, STT_, STP_, RTS_"]
    return lines + _table(
        ("ROS message", "type", "on request"),
        [(ros_type, default, ", ".join(others)) for ros_type, (default, *others) in by_type.items()],
    )


def _names(igtl_types: tuple[str, ...]) -> str:
    return "/".join(igtl_types) if len(igtl_types) < _MANY else "GET_, STT_, STP_, RTS_"


def _role(row: ConversionToRos) -> str:
    return "on request (--kinds)" if row.role is Role.ON_REQUEST else ""


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[column]) for row in (head, *rows)) for column in range(len(head))]
    cells = (zip(row, widths, strict=True) for row in (head, *rows))
    return ["  " + "  ".join(text.ljust(width) for text, width in row).rstrip() for row in cells]


#: So many types of one row are the queries.
_MANY = 8
