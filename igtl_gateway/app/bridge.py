"""The running bridge: both edges, the gateway and the recorder.

After `Bridge.stop`, ``Bridge.losses`` is the loss ledger of the session with its gaps.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from igtl_gateway.app.commands import SERVICE, SERVICE_TYPE, CommandService
from igtl_gateway.app.hub import LARGE_BYTES, DeferredSend, Hub, Sink
from igtl_gateway.app.passage import BridgePassage, make_passage
from igtl_gateway.app.recording import serve_recording
from igtl_gateway.app.ros_log import NOTED, RosLog
from igtl_gateway.app.timer import Timer
from igtl_gateway.app.video import VideoCodecs
from igtl_gateway.base.addons import part_of
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import RosError, Unavailable
from igtl_gateway.base.globs import matches
from igtl_gateway.base.once import Once
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.realtime import RealtimeOptions
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.base.systems.memory import IdleMemory
from igtl_gateway.base.version import __version__
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.notations import UploadPlace
from igtl_gateway.convert.common_msgs import CompressedImage, DiagnosticArray, TFMessage
from igtl_gateway.convert.igtl_msgs import Command, CommandReply, LinkStatusList, MetadataItem
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.edges.reserved import ReservedPorts
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.tcp import PeerLimits, TcpEdge, TlsFiles
from igtl_gateway.edges.video import VideoOptions
from igtl_gateway.gateway import CUT, LINKS_TOPIC, LISTENED, Session, make_core
from igtl_gateway.gateway.diagnostics import DIAGNOSTICS_TOPIC, Diagnostics, PeerFacts
from igtl_gateway.gateway.fastpath.passage_streams import OnPassed
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import gaps
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.to_igtl.tf_out import TF_QOS
from igtl_gateway.native.passage import Passage
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.selection import StateInputRule

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder
    from igtl_gateway.record.worker import RecordingSummary

#: Longest delay of a ping or a timeout: time from a tick to the next one if its deadline has come and stays.
_TICK_NS = 50 * NS_PER_MS

#: The same of a relay with fault injection, which delays messages.
_FAULTY_TICK_NS = NS_PER_MS

#: QoS of topics that are recorded only: the depth covers a burst; the reliability is that of the publishers.
_RECORDED = Qos(depth=100)

#: QoS of /diagnostics: that of the diagnostic updater.
_DIAGNOSTICS = Qos(depth=10)

#: Topics that `--record-all` leaves out, as `ros2 bag record --all` does: hidden topics and those of ROS itself.
_NEVER_RECORDED = ("/parameter_events", "/rosout", "**/_*")

#: Types of messages to ROS that the bridge itself reads: replies for the service, video frames for the decoder.
_OWN_USE = frozenset({CommandReply.TYPE, CompressedImage.TYPE})

Address = tuple[str, int]


class Uploads(Protocol):
    """The upload beside a bridge, of the add-on ``upload``."""

    def counters(self) -> dict[str, Any]:
        """Return what waits, was sent and was confirmed, so far."""
        ...

    def left_text(self) -> str:
        """Return what was uploaded, and what is left and how it is finished."""
        ...

    def stop(self) -> None:
        """Upload what is left, for a limited time."""
        ...


OnEntry = Callable[[Entry], None]


@dataclass(frozen=True, slots=True)
class SiteOptions:
    """This site, and what its gateway sends over Zenoh.

    Attributes:
        name: of the site; "": none.
        bytes_per_s: budget; 0: no limit.
        classes: ``GLOB=CLASS`` for topics.
    """

    name: str = ""
    bytes_per_s: int = 0
    classes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BridgeOptions:
    """Options of the command line that do not influence the content of messages.

    Attributes:
        listen, connect: addresses of the OpenIGTLink side; a relay connects to one server.
        ros: join the ROS 2 graph.
        zenoh: join it over Zenoh, by the router at this endpoint ("": that of Zenoh's configuration); None: over DDS.
        site: name of this site, and what it may send.
        record: file of the recording; None: record nothing.
        record_topics: globs of ROS topics that are recorded in addition to the bridged ones.
        allow: networks (CIDR) whose peers may connect in addition to those of this host.
        limits: limits for each peer.
        tls: files for TLS.
        tls_listen, tls_connect: the addresses of ``listen`` and ``connect`` that use TLS.
        node_name: name of the ROS node.
        recording: options of the recorder.
        upload: where closed recordings are copied to; None: nowhere.
        upload_rate: bytes per second of it; 0: no limit.
        video: options of the codec from ROS images to VIDEO and back; None: neither encode nor decode.
        diagnostics: publish the state of the bridge on /diagnostics once a second.
        realtime: scheduling of the threads that pass messages.
        native: let messages of compiled streams pass natively, where that is possible.
    """

    listen: tuple[Address, ...] = ()
    connect: tuple[Address, ...] = ()
    ros: bool = True
    zenoh: str | None = None
    site: SiteOptions = SiteOptions()
    record: Path | None = None
    record_topics: tuple[str, ...] = ()
    allow: tuple[str, ...] = ()
    limits: PeerLimits = field(default_factory=PeerLimits)
    tls: TlsFiles = field(default_factory=TlsFiles)
    tls_listen: frozenset[Address] = frozenset()
    tls_connect: frozenset[Address] = frozenset()
    node_name: str = "igtl_gateway"
    recording: RecordOptions = field(default_factory=RecordOptions)
    upload: UploadPlace | None = None
    upload_rate: float = 0.0
    video: VideoOptions | None = None
    diagnostics: bool = False
    reserved: ReservedPorts | None = None
    realtime: RealtimeOptions = field(default_factory=RealtimeOptions)
    native: bool = True


class Bridge:
    """A bridge between an OpenIGTLink network and a ROS graph.

    Args:
        config: the options that influence the content of messages; stored in the recording.
        options: the options that do not.
        clock: source of gateway time and monotonic time.
        on_entry: called with every entry, except those that ``on_passed`` counts.
        viewer: called with every entry; the gateway then also builds outputs without a subscriber.
        on_passed: called with kind and number of the entries that passed natively.  Without it (and with a viewer) none
            do, if ``on_entry`` is given.
        host: where the ROS node is; default: a node of this bridge only, which leaves the graph with it.
    """

    def __init__(
        self,
        config: Config,
        options: BridgeOptions,
        clock: Clock,
        on_entry: OnEntry | None = None,
        viewer: OnEntry | None = None,
        on_passed: OnPassed | None = None,
        host: NodeHost | None = None,
    ) -> None:
        self.options = options
        self.gateway = make_core(config)
        self.addresses: list[Address] = []
        self.recorder: Recorder | None = None
        self.summary: RecordingSummary | None = None
        self.uploads: Uploads | None = None
        self._clock = clock
        self._settings = LiveSettings.of(config)
        self._change_lock = threading.Lock()
        self._noted = Once()  # topic and type of the reported topics without a conversion
        self.commands: CommandService | None = None
        self.video: VideoCodecs | None = None
        self.losses: dict[str, Any] = {}
        self.realtime = ""  # one line of text on the scheduling, after the start
        self._has_diagnostics = False
        self._diagnostics: Diagnostics | None = None  # once the node has its name
        sinks: list[Sink] = [self._dispatch]
        if options.record:
            sinks.append(self._record)
        sinks += [watcher for watcher in (on_entry, viewer) if watcher]
        sees_all = viewer is not None or (on_entry is not None and on_passed is None)
        native = options.native and options.zenoh is None and not (sees_all or config.relay)
        passage = make_passage(clock) if native else None
        self.hub = Hub(Session(self.gateway, passage), clock, sinks, passage)
        self._memory = IdleMemory()
        self._timer = Timer(
            self.hub.tick,
            lambda: self.gateway.due_ns,
            self.hub.now_ns,
            self._report,
            _FAULTY_TICK_NS if config.faults else _TICK_NS,
            clock,
        )
        self.gateway.deadline_set = self._timer.deadline_set
        self.tcp = TcpEdge(
            on_frame=self.hub.igtl,
            on_link=lambda link, _up, note: self.hub.link(link, note),
            on_note=lambda link, note: self.hub.note(note, link),
            clock=clock,
            limits=options.limits,
            allow=options.allow,
            tls=options.tls,
            passage=passage,
            reserved=options.reserved,
        )
        self.ros: RosSide | None = None
        self._log: RosLog | None = None
        self._all_built = viewer is not None or options.record is not None  # also outputs without a subscriber
        if options.ros:
            self.ros = self._make_ros(options, host, passage)
            self._log = RosLog(self.ros.log)
            if not self._all_built:
                self.gateway.has_subscriber = self._has_subscriber
            if options.diagnostics:
                self._has_diagnostics = True
            if options.video:
                self.video = VideoCodecs(options.video, config, self.hub, self.ros)
        self._passage: BridgePassage | None = None
        if passage:
            self._passage = BridgePassage(passage, self.gateway, self.tcp, self.ros, on_passed or _ignore)

    def _make_ros(self, options: BridgeOptions, host: NodeHost | None, passage: Passage | None) -> RosSide:
        """Return the ROS side over the middleware of the options."""
        name, message, wants = options.node_name, self._from_ros, self.subscription_for
        note, listener = self._on_edge_note, self._on_first_subscriber
        if options.zenoh is None:
            return RosEdge(
                node_name=name,
                on_message=message,
                wants=wants,
                on_note=note,
                on_listener=listener,
                host=host,
                passage=passage,
            )
        traffic = part_of("zenoh", "traffic:Traffic")
        side: RosSide = part_of("zenoh", "edge:ZenohEdge")(
            node_name=name,
            on_message=message,
            wants=wants,
            on_note=note,
            on_listener=listener,
            endpoint=options.zenoh,
            site=options.site.name,
            traffic=traffic(options.site.classes, options.site.bytes_per_s) if options.site.name else None,
        )
        return side

    def start(self, *, active: bool = True) -> None:
        """Open both sides and the recording.

        Args:
            active: whether messages pass from the start; see ``change``.

        Raises ConfigError, RecordingError, RosError, or Unavailable for a port in use or a missing permission.  After
        an error everything is closed, and no file is left.
        """
        self.options.realtime.check()
        try:
            if self.gateway.config.relay:
                (server,) = self.options.connect
                to = server in self.options.tls_connect
                self.addresses = [
                    self.tcp.relay(*address, server, tls=address in self.options.tls_listen, tls_to=to)
                    for address in self.options.listen
                ]
            else:
                self.addresses = [
                    self.tcp.listen(*address, tls=address in self.options.tls_listen) for address in self.options.listen
                ]
                for address in self.options.connect:
                    self.tcp.connect(*address, tls=address in self.options.tls_connect)
            if self.options.record:  # after the ports: a port in use must not overwrite an existing recording
                from igtl_gateway.record.recorder import Recorder  # here: 4 MB that only a recording needs

                self.recorder = Recorder(
                    self.options.record,
                    session_facts(self.gateway.config, over_zenoh=self.options.zenoh is not None),
                    qos_of=lambda topic, ros_type: self.gateway.qos(topic) or self._subscription(topic, ros_type),
                    on_note=self._on_edge_note,
                    clock=self._clock,
                    options=self.options.recording,
                    rule=state_rule(self.gateway.config),
                    lock=self._passage.recorder_lock if self._passage else None,
                )
                if self.options.upload:
                    self.uploads = part_of("upload", "live:BridgeUploads")(
                        self.options.record, self.options.upload, self.options.upload_rate, self._on_edge_note
                    )
            if self._passage:
                self._passage.start(self.recorder, builds_all=self.gateway.has_subscriber is None)
            if not active:  # the first entry of the session
                self.change({"active": False})
            if self.ros:
                self.ros.start()
                self.ros.follow(self._change)
                self._publish_initial_state(self.ros)
        except Exception:
            self.stop()
            # an empty file would make the next start fail
            if self.summary:
                self.summary.discard()
            raise
        self._timer.start()
        self.tcp.start()
        try:
            self.realtime = self.options.realtime.apply()
        except Unavailable:
            self.stop()
            raise

    def _publish_initial_state(self, ros: RosSide) -> None:
        """Advertise the topics and services that exist from the start: links, /tf, diagnostics, commands."""
        ros.advertise(LINKS_TOPIC, LinkStatusList.TYPE, self.gateway.qos(LINKS_TOPIC) or _RECORDED)
        if self.gateway.config.publish_tf:
            ros.advertise("/tf", TFMessage.TYPE, TF_QOS["/tf"])
        if self._has_diagnostics:
            ros.advertise(DIAGNOSTICS_TOPIC, DiagnosticArray.TYPE, _DIAGNOSTICS)
        if self.recorder:
            serve_recording(ros, self.recorder)
        try:
            item = ros.message_class(MetadataItem.TYPE)
        except RosError as error:
            self.hub.note(Note(Level.WARN, "no_interfaces", f"no command service and no igtl_msgs: {error}"))
            return
        timeout_s = self.gateway.config.command_timeout_s
        self.commands = CommandService(
            lambda topic, ros_type, cdr: self.hub.ros(topic, ros_type, cdr, 0), timeout_s, item
        )
        ros.serve(SERVICE, SERVICE_TYPE, self.commands.call)

    def stop(self) -> None:
        """Close both sides, then the recording with its ledger.  A second call has no effect."""
        if self.commands:
            self.commands.stop()
        self._timer.stop()
        if self.video:
            self.video.stop()
        self.tcp.stop()
        if self._passage:
            self._passage.stop()
        if self.ros:
            self.ros.follow(None)
            if self._log:
                self._log.flush()
            self.ros.stop()
        if not self.losses:
            ledger = self.ledger()
            self.losses = ledger | {"gaps": gaps(ledger)}
        if self.recorder and not self.summary:
            self.summary = self.recorder.close(self.losses)
        if self.uploads:
            self.uploads.stop()

    def change(self, changes: Mapping[str, object]) -> None:
        """Change settings while the bridge runs: ``deny_in``, ``deny_out``, ``max_age_s``, ``kinds``, ``active``.

        The change is an input of the session: it applies to the messages after its entry, and the recording has it.
        Parameters of the node change with it.  Values that are as before change nothing.  Any thread may call it,
        except in a sink.

        Args:
            changes: name → new value.

        Raises:
            ConfigError: another name, or a wrong value; nothing has changed.
        """
        with self.ros.changing if self.ros else nullcontext():
            self._change(changes)
            if self.ros:
                self.ros.show({name: getattr(self._settings, name) for name in changes})

    def _change(self, changes: Mapping[str, object]) -> None:
        """Change settings; the parameters of the node have changed already, or change afterwards."""
        with self._change_lock:
            settings = self._settings.changed(changes)
            if settings != self._settings:
                self.hub.note(settings.note(self._settings))
                self._settings = settings

    @property
    def settings(self) -> LiveSettings:
        """The settings that can change, as they are now."""
        return self._settings

    def collect(self) -> None:
        """Take over what was counted natively."""
        if self._passage:
            self._passage.collect()

    def native_times(self) -> dict[str, Any]:
        """Return where the time of messages went in the native passage; empty without one."""
        return self._passage.times() if self._passage else {}

    def ledger(self) -> dict[str, Any]:
        """Return the loss ledger: the counts of the gateway by stream, and those of the edges, as JSON values."""
        self.collect()
        sent = {
            str(link): {
                "sent_messages": counts.sent_messages,
                "sent_bytes": counts.sent_bytes,
                "received_messages": counts.received_messages,
                "received_bytes": counts.received_bytes,
                "queued_messages": counts.queued_messages,
                "dropped": dict(sorted(counts.dropped.items())),
                "ignored": dict(sorted(counts.ignored.items())),
            }
            for link, counts in self.tcp.counters().items()
        }
        refused, faults = self.tcp.refused(), self.tcp.link_faults()
        return (
            {
                "streams": self.gateway.ledger.to_dict(),
                "links": sent,
                "ros_topics": self.ros.counters() if self.ros else {},
            }
            | ({"refused": refused} if refused else {})
            | ({"link_faults": faults} if faults else {})
            | ({"video": self.video.counters()} if self.video else {})
        )

    def _from_ros(self, topic: str, ros_type: str, cdr: bytes, source_ns: int) -> None:
        """Pass a message of the ROS edge to the encoder if its topic is sent as VIDEO, otherwise to the hub."""
        if not (self.video and self.video.encode(topic, ros_type, cdr, source_ns)):
            self.hub.ros(topic, ros_type, cdr, source_ns)

    def _has_subscriber(self, topic: str, ros_type: str) -> bool:
        """Return whether a topic has a subscriber in ROS, or the bridge itself reads the type."""
        return ros_type in _OWN_USE or self.ros is None or self.ros.has_subscriber(topic)

    def _on_first_subscriber(self, topic: str) -> None:
        """Report the first subscriber of a topic: the gateway then builds the latched message of the topic."""
        if self.gateway.has_subscriber:
            self.hub.note(Note(Level.INFO, LISTENED, f"{topic} has a subscriber", topic))

    def _report(self) -> None:
        """Publish log and diagnostics, and return idle memory.  Runs once a second in the timer's thread."""
        self._memory.look()
        if self._log:
            self._log.flush(self.hub.now_ns())
        self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        """Publish the diagnostics, which are not part of the log, if they have a subscriber.

        Runs in the timer's thread, without a lock that delays messages.
        """
        if not self._has_diagnostics or not self.ros or not self.ros.has_subscriber(DIAGNOSTICS_TOPIC):
            return
        if self._diagnostics is None:
            self._diagnostics = Diagnostics(platform.node(), self.ros.full_name.removeprefix("/"))
        diagnostics = self._diagnostics
        self.collect()
        counters = self.tcp.counters()
        peers = [
            PeerFacts(
                link.number,
                link.peer,
                link.role,
                counts.sent_messages,
                counts.received_messages,
                counts.queued_messages,
                sum(counts.dropped.values()),
            )
            for link in self.tcp.links()
            if link.connected and (counts := counters.get(link.number))
        ]
        recorder = self.recorder.counters() if self.recorder else None
        over_budget = None
        if self.options.site.name:
            over_budget = sum(counts["over_budget"] for counts in self.ros.counters().values())
        try:
            streams, watched = self.gateway.ledger.to_dict(), self.gateway.guard.items()
            statuses = diagnostics.array(
                self._clock.utc_ns(),
                self._clock.monotonic_ns(),
                streams,
                watched,
                peers,
                recorder,
                self.uploads.counters() if self.uploads else None,
                over_budget,
            )
            self.ros.publish(DIAGNOSTICS_TOPIC, DiagnosticArray.TYPE, statuses.pack(), _DIAGNOSTICS)
        except Exception as error:  # a defect here must not stop the ticks of this thread
            self._has_diagnostics = False
            text = f"{DIAGNOSTICS_TOPIC} stops: {type(error).__name__}: {error}"
            self.hub.note(Note(Level.ERROR, "internal_error", text))

    def _record(self, entry: Entry) -> DeferredSend | None:
        return self.recorder.reserve(entry) if self.recorder else None

    def _dispatch(self, entry: Entry) -> DeferredSend | None:
        """Pass an output to its edge.  The hub calls this in the order of the log, with its lock held.

        Large outputs are passed without the lock, by the function that is returned.
        """
        is_output = entry.kind is Kind.IGTL_OUT or entry.kind is Kind.ROS_OUT
        if is_output and entry.size >= LARGE_BYTES:
            return partial(self._pass_on, entry)
        self._pass_on(entry)
        return None

    def _pass_on(self, entry: Entry) -> None:
        if entry.kind is Kind.IGTL_OUT:
            self.tcp.send(entry.links, entry.payload, entry.channel, self.gateway.keep(entry))
        elif entry.kind is Kind.ROS_OUT and self.ros:
            if not (self._all_built and self.ros.count_if_unsubscribed(entry.channel)):
                qos = self.gateway.qos(entry.channel) or _RECORDED
                self.ros.publish(entry.channel, entry.type, entry.data(), qos)
            if self.commands:
                self.commands.on_entry(entry)
            if self.video:
                self.video.decode(entry)
        elif entry.kind is Kind.NOTE and self.gateway.config.faults:
            note = Note.unpack(entry.data())
            if note.code == CUT:
                self.tcp.disconnect(entry.links, note.text)
        elif self._log and entry.kind in NOTED:
            self._log.add(entry)

    def subscription_for(self, topic: str, ros_type: str) -> Qos | None:
        """Return the QoS for a discovered topic, or None if it is not subscribed to.

        Reports a topic once if the configuration names it, but no conversion for its type exists.
        """
        encoded = self.video is not None and self.video.subscription(topic, ros_type) is not None
        lacks = self.gateway.lacks_conversion(topic, ros_type) and not encoded
        if lacks and self._noted.first(topic, ros_type):
            text = f"{topic} is not sent to OpenIGTLink: no conversion for {ros_type}"
            self.hub.note(Note(Level.WARN, "no_conversion", text, topic))
        return self._subscription(topic, ros_type)

    def _subscription(self, topic: str, ros_type: str) -> Qos | None:
        """Return the QoS for a topic that is bridged or recorded, else None."""
        bridged = self.gateway.subscription(topic, ros_type)
        if self.video and not bridged:
            bridged = self.video.subscription(topic, ros_type)
        if bridged or not self.recorder or any(matches(glob, topic) for glob in _NEVER_RECORDED):
            return bridged
        return _RECORDED if any(matches(glob, topic) for glob in self.options.record_topics) else None

    def _on_edge_note(self, note: Note) -> None:
        self.hub.note(note)

    @property
    def has_failed(self) -> bool:
        """Whether the recording has failed and the options require the bridge to stop."""
        failed = self.recorder is not None and bool(self.recorder.failure)
        return failed and self.options.recording.stop_on_failure


def _ignore(_kind: Kind, _number: int) -> None:
    """The entries are not counted."""


def state_rule(config: Config) -> StateInputRule:
    """Return which inputs a recording needs of streams that are left out; see ``record.selection``."""
    commands = frozenset({"COMMAND", "RTS_COMMAND", Command.TYPE, CommandReply.TYPE})
    mixed = frozenset(TF_QOS) if config.tf_out else frozenset()
    robots: list[str] = []
    to_robots: tuple[str, ...] = ()
    if config.all_arms and config.allow_in:
        states = ("measured_cp", "measured_js")
        robots += (f"{row.arms}{below}/{name}" for row in config.all_arms for below in ("", "/**") for name in states)
        robots += (f"/{glob}" for glob in config.allow_in)
        to_robots = tuple(f"*/{glob}" for glob in config.allow_in)
    return StateInputRule(frozenset({LINKS_TOPIC}), commands, mixed, tuple(robots), to_robots)


def session_facts(config: Config, *, over_zenoh: bool = False) -> dict[str, str]:
    """Return the metadata of a recording: configuration, versions, host."""
    rmw = "rmw_zenoh_cpp" if over_zenoh else os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    packages = ("mcap", "numpy", "rosbags", "fastcrc", "eclipse-zenoh" if over_zenoh else "ros-jazzy-rclpy")
    return {
        "igtl_gateway_version": __version__,
        "config": json.dumps(config.to_dict(), sort_keys=True),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "host": platform.node(),
        "packages": json.dumps(_versions(packages), sort_keys=True),
        "ros_domain_id": os.environ.get("ROS_DOMAIN_ID", "0"),
        "rmw_implementation": rmw,
        "command": " ".join(sys.argv),
    }


def _versions(packages: Sequence[str]) -> dict[str, str]:
    from importlib import metadata  # here: a bridge that records nothing does not need it

    found = {}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
