"""The running bridge: both edges, the gateway and the recorder, as parts with an order of start and stop.

After `Bridge.stop`, ``Bridge.losses`` is the loss ledger of the session with its gaps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from igtl_gateway.app.awaited_sources import AwaitedSources
from igtl_gateway.app.bridge_options import Address, BridgeOptions
from igtl_gateway.app.clock_asker import ClockAsker
from igtl_gateway.app.diagnostics import DiagnosticsTopic
from igtl_gateway.app.hub import DeferredSend, Hub, Sink
from igtl_gateway.app.live_changes import LiveChanges
from igtl_gateway.app.mark_service import MarkService
from igtl_gateway.app.note_rate import Event
from igtl_gateway.app.part import Parts, Step
from igtl_gateway.app.passage import BridgePassage, why_not_native
from igtl_gateway.app.recording import BridgeRecording, Uploads
from igtl_gateway.app.ros_traffic import RosTraffic
from igtl_gateway.app.subscriptions import EVERYTHING, Subscriptions
from igtl_gateway.app.timer import Timer
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import duration_text
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.base.systems.memory import IdleMemory
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.notations import uses_websocket
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.edges.tcp.sockets import address_text
from igtl_gateway.gateway import CUT, Session, make_core
from igtl_gateway.gateway.expected import PresentSources, expected_sources
from igtl_gateway.gateway.fastpath import LARGE_BYTES
from igtl_gateway.gateway.fastpath.passage_streams import OnPassed
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import gaps
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.silences import Silences
from igtl_gateway.native.passage import Passage
from igtl_gateway.record.admission import Admission
from igtl_gateway.record.selection import Selection

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder
    from igtl_gateway.record.reports import RecordingSummary

#: Longest delay of a ping or a timeout: time from a tick to the next one if its deadline has come and stays.
_TICK_NS = 50 * NS_PER_MS

#: Code of the note about messages whose receipt is late because nothing was read.
HALTED = "halted"

#: The same of a relay with fault injection, which delays messages.
_FAULTY_TICK_NS = NS_PER_MS

OnEntry = Callable[[Entry], Callable[[], None] | None]


class Bridge:
    """A bridge between an OpenIGTLink network and a ROS graph.

    Args:
        config: the options that influence the content of messages; stored in the recording.
        options: the options that do not.
        clock: source of gateway time and monotonic time.
        on_entry: called with every entry, except those that ``on_passed`` counts; may return what is left to be done
            without the lock of the session.
        viewer: called with every entry; the gateway then also builds outputs without a subscriber.
        on_passed: called with kind and number of the entries that passed natively.  Without it (and with a viewer) none
            do, if ``on_entry`` is given.
        host: where the ROS node is; default: a node of this bridge only, which leaves the graph with it.

    Attributes:
        native_off: why Python passes all messages; "": there is a native passage.
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
        options = self.options = options.at(clock.utc_ns())
        self.gateway = make_core(config)
        self.addresses: list[Address] = []
        self.losses: dict[str, Any] = {}
        self.realtime = ""  # one line of text on the scheduling, after the start
        self.native_off = why_not_native(
            clock,
            {
                "it is turned off": not options.native,
                "--relay": config.relay,
                "ROS over Zenoh": options.zenoh is not None,
                "--view": viewer is not None,
                "the caller sees all entries": on_entry is not None and on_passed is None,
            },
        )
        passage = None if self.native_off else Passage()
        self._reports: deque[Event] = deque()
        records: list[Sink] = [self._record] if options.record else []
        watchers = [watcher for watcher in (on_entry, viewer) if watcher]
        self.hub = Hub(Session(self.gateway, passage), clock, [self._dispatch, *records, *watchers], passage)
        admission = Admission(clock, self.hub.note) if options.record else None
        self.tcp = TcpEdge(
            on_frame=self.hub.igtl,
            on_link=lambda link, _up, note: self.hub.link(link, note),
            on_note=lambda link, note: self.hub.note(note, link),
            clock=clock,
            limits=options.limits,
            allow=options.allow,
            tls=options.tls,
            origins=options.origins,
            passage=passage,
            reserved=options.reserved,
            admission=admission,
        )
        recorded = options.record_topics if options.record else ()
        self.subscriptions = Subscriptions(self.gateway, recorded, self.hub.note)
        self._traffic: RosTraffic | None = None
        if options.ros:
            builds_all = viewer is not None or options.record is not None
            self._traffic = RosTraffic(
                options, self.gateway, self.hub, self.subscriptions, host, passage, builds_all=builds_all
            )
        self.ros: RosSide | None = self._traffic.side if self._traffic else None
        self._passage: BridgePassage | None = None
        if passage:
            self._passage = BridgePassage(passage, self.gateway, self.tcp, self.ros, on_passed or _ignore)
        self.gateway.on_mark = self._take_mark
        self._changes = LiveChanges(config, self.hub, self.ros)
        self._recording: BridgeRecording | None = None
        if options.record:
            self._recording = BridgeRecording(
                options.record,
                options,
                config,
                clock,
                qos_of=self._recorded_qos,
                on_note=self.hub.note,
                losses=lambda: self.losses,
                passage=self._passage,
                admission=admission,
            )
        self._diagnostics: DiagnosticsTopic | None = None
        if self._traffic:
            self._traffic.recording = self._recording
            self._traffic.mark = self.mark
            if options.diagnostics:
                self._diagnostics = DiagnosticsTopic(
                    self._traffic.side,
                    self.gateway,
                    self.tcp,
                    self._recording,
                    clock,
                    self.hub.note,
                    has_budget=bool(options.site.name),
                )
        self._memory = IdleMemory()
        chosen = options.recording.selection if options.record else Selection()
        expected = expected_sources(
            config,
            [glob for glob in options.record_topics if glob not in EVERYTHING] if options.record else (),
            chosen.include,
            chosen.exclude,
            options.recording.triggers if options.record else (),
            [text.rpartition("=")[0] for text in options.site.classes],
            [address_text(each) for each in options.connect],
            options.clock_from,
        )
        #: The configured sources that are not there.
        self.awaited = AwaitedSources(expected, self._present_sources, self.hub.note)
        self._silences = Silences()
        self._clocks = ClockAsker(options.clock_from, self.gateway.questions, self.hub.note)
        tick_ns = _FAULTY_TICK_NS if config.faults else _TICK_NS
        timer = Timer(
            self.hub.tick,
            lambda: self.gateway.due_ns,
            self.hub.now_ns,
            self._each_second,
            tick_ns,
            clock,
            self._note_halt,
        )
        self.gateway.deadline_set = timer.deadline_set
        self._starts_active = True
        self._runs, self._begun_ns, self._clock = False, 0, clock
        traffic = self._traffic
        self._parts = Parts(
            Step(self._open_ports, self.tcp.stop),  # first: a port in use must not cost an existing recording
            self._recording,  # before the first entry
            Step(stop=self._settle),  # when nothing passes any more
            Step(self._begin),
            traffic,
            self._changes,
            self._diagnostics,
            Step(stop=self._passage.stop) if self._passage else None,  # streams enter it as Python compiles them
            self.tcp,
            traffic and traffic.video,
            timer,
            MarkService(traffic.side, self.mark, clock) if traffic else None,
            traffic and traffic.commands,  # last, so that its stop ends the calls that wait before all else
        )

    def start(self, *, active: bool = True) -> None:
        """Open both sides and the recording.

        Args:
            active: whether messages pass from the start; see ``change``.

        Raises ConfigError, RecordingError, RosError, or Unavailable for a port in use or a missing permission.  After
        an error everything is closed, and no file is left.
        """
        self.options.realtime.check()
        self._starts_active = active
        try:
            self._parts.start()
            self.realtime = self.options.realtime.apply()
        except Exception:
            self.stop()
            if self._recording:
                self._recording.discard()
            raise

    def stop(self) -> None:
        """Close both sides, then the recording with its ledger.  A second call has no effect."""
        self._parts.stop()

    def _open_ports(self) -> None:
        """Take the ports, which open when they are read, and the servers."""
        options = self.options
        if self.gateway.config.relay:
            (server,) = options.connect
            to = server in options.tls_connect
            for address in options.listen:
                tls, websocket = address in options.tls_listen, uses_websocket(address)
                self.addresses.append(self.tcp.relay(*address, server, tls=tls, tls_to=to, websocket=websocket))
            return
        for address in options.listen:
            tls, websocket = address in options.tls_listen, uses_websocket(address)
            self.addresses.append(self.tcp.listen(*address, tls=tls, websocket=websocket))
        for address in options.connect:
            self.tcp.connect(*address, tls=address in options.tls_connect)

    def _begin(self) -> None:
        """Make the first entry the note that no messages pass, if so."""
        self._runs, self._begun_ns = True, self._clock.monotonic_ns()
        if not self._starts_active:
            self.change({"active": False})

    def _settle(self) -> None:
        """Count the losses."""
        self._runs = False
        ledger = self.ledger()
        self.losses = ledger | {"gaps": gaps(ledger)}

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
        self._changes.change(changes)

    def mark(self, mark: MarkNote) -> None:
        """Make a mark: an input of the session, which a recording has also while it is paused.  Any thread may call it.

        Raises:
            ConfigError: the begin of a phase that is open, or the end of one that is not; a time before the session.
            Unavailable: the bridge does not run.
        """
        if not self._runs:
            raise Unavailable("mark: found a bridge that does not run, expected one that was started")
        self._check_time(mark)
        self.gateway.phases.check(mark)
        self.hub.note(mark.note())

    def _check_time(self, mark: MarkNote) -> None:
        if mark.ago_ns > (lasts_ns := self._clock.monotonic_ns() - self._begun_ns):
            ago, most = duration_text(mark.ago_ns), duration_text(lasts_ns)
            raise ConfigError(f"mark: found {ago} ago, expected at most the {most} of the session")

    def _take_mark(self, mark: MarkNote) -> None:
        """Take a mark of a peer, which cannot be refused any more; one of a time before the session is of now."""
        try:
            self._check_time(mark)
        except ConfigError as error:
            self.hub.note(Note(Level.WARN, "mark_time", f"{error}; mark {mark.label} is of its arrival"))
            mark = replace(mark, ago_ns=0)
        self.hub.note(mark.note())

    @property
    def settings(self) -> LiveSettings:
        """The settings that can change, as they are now."""
        return self._changes.settings

    @property
    def recorder(self) -> Recorder | None:
        """The recorder, once it is started."""
        return self._recording.recorder if self._recording else None

    @property
    def uploads(self) -> Uploads | None:
        """The upload of the recording, once it is started."""
        return self._recording.uploads if self._recording else None

    @property
    def summary(self) -> RecordingSummary | None:
        """What was recorded, after the stop."""
        return self._recording.summary if self._recording else None

    @property
    def has_failed(self) -> bool:
        """Whether the recording has failed and the options require the bridge to stop."""
        return self._recording is not None and self._recording.has_failed

    def collect(self) -> None:
        """Take over what was counted natively."""
        if self._passage:
            self._passage.collect()

    def show(self, kind: Kind, channel: str) -> None:
        """Have ``on_entry`` called with the next message of a stream, although its messages pass natively.

        Args:
            kind, channel: of its entries; what is made of a message comes with it.
        """
        if self._passage:
            self._passage.show(kind, channel)

    def native_times(self) -> dict[str, Any]:
        """Return where the time of messages went in the native passage; empty without one."""
        return self._passage.times() if self._passage else {}

    def take_reports(self) -> list[Event]:
        """Return the notes on streams of the native passage since the last call; the recording does not have them."""
        return [self._reports.popleft() for _ in range(len(self._reports))]

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
            | ({"video": self._traffic.video.counters()} if self._traffic and self._traffic.video else {})
        )

    def _each_second(self) -> None:
        """Publish log and diagnostics, note silent streams, and return idle memory.  Runs in the timer's thread."""
        self._memory.look()
        now_ns = self._clock.monotonic_ns()
        self._clocks.look({link.number: link.peer for link in self.tcp.links() if link.connected}, now_ns)
        self.awaited.look(now_ns)
        if self._passage:
            now_ns = self.hub.now_ns()
            self._reports.extend(Event(now_ns, Kind.EDGE_NOTE, note, ()) for note in self._passage.look())
        if self._traffic:
            self._traffic.each_second()
        diagnostics = self._diagnostics if self._diagnostics and self._diagnostics.is_due else None
        if diagnostics or self.gateway.guard.watch:
            self.collect()
        if diagnostics:
            diagnostics.publish()
        if self.gateway.guard.watch:
            totals = self.gateway.ledger.totals()
            for note in self._silences.look(self.hub.now_ns(), self.gateway.guard.items(), totals):
                self.hub.note(note)

    def _note_halt(self, halt_ns: int, most_ns: int) -> None:
        """Note that the bridge did not run for a while."""
        late = f"what came meanwhile was received up to {duration_text(most_ns)} late"
        text = f"the bridge did not run for {duration_text(halt_ns)}: {late}"
        self.hub.note(Note(Level.WARN, HALTED, text, data={"late_ns": most_ns}))

    def _present_sources(self) -> PresentSources:
        """Return the sources that are there; of ROS only if there is a graph."""
        self.collect()
        totals = self.gateway.ledger.totals()
        topics: dict[str, set[str]] | None = None
        frames, clashes = None, {}
        if self.ros:
            topics = {}
            for each in self.ros.publications():
                topics.setdefault(each.topic, set()).add(each.type)
            frames, clashes = self.gateway.frames(), dict(self.ros.failing())
        devices: dict[str, set[str]] = {}
        for name in totals.get("igtl_in", {}):
            type_name, _, device = name.partition("/")
            devices.setdefault(device, set()).add(type_name)
        streams = {name for kind in totals.values() for name in kind}
        streams |= {name.partition("/")[2] for name in streams if name[:1] != "/"} | set(topics or ())
        links = self.tcp.links()
        servers = {address_text(each) for each in self.options.connect}
        peers = {each.peer for each in links} | {address_text(each) for each in self.addresses} | servers
        answering = None if self.gateway.config.relay else servers - {each.peer for each in links if not each.number}
        connected = sum(each.connected for each in links)
        apart = self.gateway.frames_apart()
        return PresentSources(topics, frames, devices, streams, answering, peers, connected, clashes, apart)

    def _recorded_qos(self, topic: str, ros_type: str) -> Qos | None:
        return self.gateway.qos(topic) or self.subscriptions.qos(topic, ros_type)

    def _record(self, entry: Entry) -> DeferredSend | None:
        return self._recording.reserve(entry) if self._recording else None

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
            self.tcp.send(entry.links, entry.payload, entry.channel, self.gateway.must_keep(entry))
        elif entry.kind is Kind.ROS_OUT and self._traffic:
            self._traffic.publish(entry)
        elif entry.kind is Kind.NOTE and self.gateway.config.faults:
            note = Note.unpack(entry.data())
            if note.code == CUT:
                self.tcp.disconnect(entry.links, note.text)
        elif self._traffic:
            self._traffic.log(entry)


def _ignore(_kind: Kind, _number: int) -> None:
    """The entries are not counted."""
