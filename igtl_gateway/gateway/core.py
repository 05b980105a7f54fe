"""The core of the gateway: passes each input to the stage for its kind, and settles the outcome.

The stages are in the order of the traffic.  ``to_ros``: receive, route, convert.  ``to_igtl``: receive, compose,
latest, deliver.  ``dialogue``: queries, commands, links.  A stage returns an ``Outcome``, which the ``Bookkeeper``
settles.  A message that fails does not affect others: a note gives the reason, and the ledger counts it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.igtl_msgs import RawMessage
from igtl_gateway.gateway.activity import Activity
from igtl_gateway.gateway.command_guard import CommandGuard, Write
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.dialogue.clocks import ASK_CLOCK, ClockQuestions
from igtl_gateway.gateway.dialogue.commanding import Commands
from igtl_gateway.gateway.dialogue.links import LINKS_QOS, LINKS_TOPIC, Links
from igtl_gateway.gateway.dialogue.marking import Marking
from igtl_gateway.gateway.dialogue.querying import Queries
from igtl_gateway.gateway.fastpath import FastHandler, FastPath, PrepareMessage
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.kept import FORGOTTEN, forgotten_text
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.log.marks import MarkNote, OpenPhases
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.naming import SharedNames, ShownNames
from igtl_gateway.gateway.orders import UNWRITTEN
from igtl_gateway.gateway.outcome import Bookkeeper, Finding, Item, Outcome, Tally
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.gateway.streams import Streams
from igtl_gateway.gateway.to_igtl.beforehand import RosBeforehand
from igtl_gateway.gateway.to_igtl.composer import Composer
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.latest import Latest
from igtl_gateway.gateway.to_igtl.receive import RosReceiver
from igtl_gateway.gateway.to_igtl.tf_out import TF_QOS, TfOut
from igtl_gateway.gateway.to_igtl.tf_receive import TfReceiver
from igtl_gateway.gateway.to_igtl.tracking import Tracking
from igtl_gateway.gateway.to_ros.beforehand import Beforehand
from igtl_gateway.gateway.to_ros.convert import RAW_QOS, Converter
from igtl_gateway.gateway.to_ros.receive import IgtlReceiver
from igtl_gateway.gateway.to_ros.route import Router
from igtl_gateway.gateway.to_ros.subscribers import HasSubscriber, Subscribers
from igtl_gateway.gateway.to_ros.volumes import Volumes
from igtl_gateway.wire.query import split_query

#: Code of the edge notes that inform the gateway that ``due_ns`` has come.
TICK = "tick"

#: Code of the edge notes for the first subscriber of ``stream``; used only while ``has_subscriber`` is set.
LISTENED = "listened"

#: Types of which every message matters: poses and images are superseded by the next one, and these are not.  Later
#: frames of a video depend on earlier ones.
_KEPT_TYPES = frozenset({"STRING", "STATUS", "COMMAND", "RTS_COMMAND", "VIDEO"})


class Gateway:
    """The core of a session with ROS; see the package.

    Args:
        config: configuration of the session.
        fast_path: compile streams for the fast path; without it every message takes the full path.

    Attributes:
        phases: those that marks have begun.
        on_mark: takes each mark of a peer; None in a session that is computed again, whose inputs have it.
        fast, prepare: entry points of the fast path; see ``FastPath``.
        questions: those to peers for their clock.
        deadline_set: called after each input that may have set ``due_ns`` to an earlier time; see ``app.timer``.
    """

    def __init__(self, config: Config, *, fast_path: bool = True) -> None:
        self.config = config
        self.deadline_set: Callable[[], None] | None = None
        self._peers = peers = Peers(config)
        self._accounts = Bookkeeper(peers)
        self.phases = OpenPhases()
        self.on_mark: Callable[[MarkNote], None] | None = None
        self._streams = streams = Streams(config)
        self._guard = guard = Guard(watch=config.watch is True)
        self._denied_in, self._denied_out = denied_in, denied_out = Denials(config.deny_in), Denials(config.deny_out)
        activity = Activity()
        self._tf = tf = TfOut(config, tuple(streams.device(row.request().device) for row in config.tf_out))
        room, latched_room = (None if one is None else one << 20 for one in (config.keep_mib, config.latched_mib))
        self._subscribers = subscribers = Subscribers(needs_tf=bool(tf), room=latched_room)
        self._forget_at_ns: int | None = None
        self._volumes = volumes = Volumes(room)
        beforehand = Beforehand(config, streams, subscribers, volumes)

        composer = Composer(config, streams)
        self._latest = latest = Latest(
            streams,
            guard,
            tf,
            composer,
            moments=bool(config.naming),
            forms=config.knows_peers,
            room=room,
            latched_room=latched_room,
        )
        names = ShownNames(streams.is_sent)
        delivery = Delivery(denied_out, tf.tree, names, by_stamp=bool(config.naming))
        tracking = Tracking(peers, latest)
        self._frames = frames = TfReceiver(tf, guard, peers, delivery, tracking)
        shared = SharedNames(peers) if config.naming else None
        self._converter = Converter(streams, subscribers, frames, beforehand, shared)
        self._robots = robots = CommandGuard(config, latest.get)
        self._unwritten: Note | None = None
        router = Router(config, streams, guard, volumes, self._converter, robots, peers)

        self._commands = commands = Commands(config, peers, streams, composer, delivery)
        self.questions = questions = ClockQuestions(peers, delivery)
        guard.clock_text = questions.clocks.text
        queries = Queries(
            peers, denied_out, latest, delivery, lambda frame: composer.knows(frame) or tf.tree.knows(frame)
        )
        self._links = links = Links(
            config,
            peers,
            guard,
            denied_out,
            latest=latest,
            composer=composer,
            delivery=delivery,
            frames=frames,
            commands=commands,
            activity=activity,
            questions=questions,
            shared=shared,
        )
        igtl_receiver = IgtlReceiver(
            config,
            peers,
            denied_in,
            router,
            beforehand,
            links=links,
            queries=queries,
            commands=commands,
            activity=activity,
            marking=Marking(config, self.phases, guard, self._mark),
            questions=questions,
        )
        ros_beforehand = RosBeforehand(config, streams, peers)
        ros_receiver = RosReceiver(
            config,
            peers,
            streams,
            guard,
            denied_out,
            ros_beforehand,
            latest=latest,
            composer=composer,
            delivery=delivery,
            tracking=tracking,
            frames=frames,
            commands=commands,
            activity=activity,
        )
        self._stages: dict[Kind, Callable[[Entry], Outcome]] = {
            Kind.IGTL_IN: igtl_receiver.take,
            Kind.ROS_IN: ros_receiver.take,
            Kind.LINK: links.take,
            Kind.EDGE_NOTE: self._on_edge_note,
        }
        self.fast_path = FastPath(
            config,
            self.ledger,
            peers,
            streams,
            subscribers,
            volumes,
            latest.entries,
            beforehand,
            ros_beforehand,
            enabled=fast_path,
        )
        self.fast: FastHandler = self.fast_path.take
        self.prepare: PrepareMessage = self.fast_path.prepare
        streams.advertise(LINKS_TOPIC, LINKS_QOS)

    def handle(self, entry: Entry) -> list[Entry]:
        """Return the entries that ``entry`` causes, with the numbers and nanoseconds directly after it.

        Outputs (``*_OUT``, ``NOTE``) are accepted and cause nothing.
        """
        stage, streams = self._stages.get(entry.kind), self._streams
        if stage is None:
            return []
        if entry.kind is Kind.IGTL_IN:
            self._robots.begin_message(entry)
        elif entry.kind is Kind.ROS_IN:
            self._robots.see(entry)
        try:
            outcome = stage(entry)
            if streams.has_news:
                outcome.items += streams.news()
            if outcome.origin:
                self.fast_path.learn(entry, outcome)
            outputs = self._accounts.settle(entry, outcome)  # last: a failure above has counted nothing
        except Exception as error:  # an internal error must cost one message, not the session
            streams.news()
            outputs = self._accounts.fail(entry, error)
        if entry.kind is Kind.IGTL_IN:
            self._unwritten = self._robots.end_message(entry)
        if self.deadline_set:
            self.deadline_set()
        self.fast_path.end_full_path()
        return [output.entry(entry, step) for step, output in enumerate(outputs, start=1)]

    @property
    def write(self) -> Write | None:
        """Writes a command to a robot at once, or returns why it did not; None: a session that is computed again."""
        return self._robots.write

    @write.setter
    def write(self, write: Write | None) -> None:
        self._robots.write = write

    def take_unwritten(self) -> Note | None:
        """Return the note about the commands of the last input that were not written: an input before it."""
        note, self._unwritten = self._unwritten, None
        return note

    # -- queries by the edges: none of them changes what influences outputs ------------------------------------

    @property
    def ledger(self) -> Ledger:
        """The loss ledger: the fate of every message."""
        return self._accounts.ledger

    @property
    def guard(self) -> Guard:
        """The guarded streams."""
        return self._guard

    def profile_of(self, link: int) -> str:
        """Return the name of the profile of the peer of a link; "" if the link is not open."""
        peer = self._peers.get(link)
        return peer.profile.name if peer else ""

    def reads_milliseconds(self, link: int) -> bool:
        """Return whether the stamps of the peer of a link have milliseconds in place of the fraction of a second."""
        peer = self._peers.get(link)
        return peer is not None and peer.profile.milliseconds

    @property
    def has_subscriber(self) -> HasSubscriber | None:
        """Function that returns whether a topic has a subscriber; None, as in recorded sessions: build all outputs."""
        return self._subscribers.ask

    @has_subscriber.setter
    def has_subscriber(self, ask: HasSubscriber | None) -> None:
        self._subscribers.ask = ask

    def subscription(self, topic: str, ros_type: str) -> Qos | None:
        """Return the QoS of the subscription to a topic; None if the topic is not bridged."""
        if self._frames and topic in TF_QOS and ros_type == TFMessage.TYPE:
            return TF_QOS[topic]
        row, conversion = self._streams.rows(topic, ros_type)
        if row and ros_type == RawMessage.TYPE:
            return row.qos or RAW_QOS
        return row.qos or conversion.qos if row and conversion else None

    def lacks_conversion(self, topic: str, ros_type: str) -> bool:
        """Return whether the configuration bridges a topic for whose type there is no conversion."""
        row, conversion = self._streams.rows(topic, ros_type)
        return row is not None and conversion is None and ros_type != RawMessage.TYPE

    def qos(self, topic: str) -> Qos | None:
        """Return the QoS of a topic that the gateway publishes."""
        return self._streams.qos(topic)

    def until_ns(self, entry: Entry) -> int:
        """Return until when an output to ROS may be sent by its ``max_age_s``, UTC ns of its sender; 0: no limit."""
        age_s = self._streams.max_age_s(entry.channel)
        return entry.source_ns + round(age_s * NS_PER_S) if age_s and entry.source_ns else 0

    def must_keep(self, entry: Entry) -> bool:
        """Return whether a full send queue must not drop this OpenIGTLink message."""
        return is_kept(entry.type)

    def collect(self) -> None:
        """Take over what the native passage has counted, and plan a tick if more is kept than permitted."""
        self.fast_path.collect()
        exceeding = self._volumes.exceed() or self._latest.exceed() or self._subscribers.exceed()
        self._forget_at_ns = 0 if exceeding else None

    def frames(self) -> set[str]:
        """Return the frames of the tf tree, which the gateway keeps if it sends frames."""
        return self._tf.tree.names()

    def frames_apart(self) -> dict[str, str]:
        """Return the frames that are sent and in the tf tree → their base, in the tree, too, but not connected."""
        tree, requests = self._tf.tree, [row.request() for row in self.config.tf_out]
        known = tree.names() if requests else set()
        return {
            frame: request.base
            for request in requests
            for frame in request.frames
            if {frame, request.base} <= known and tree.root_of(frame) != tree.root_of(request.base)
        }

    def receivers(self) -> dict[str, int]:
        """Return stream to peers → peers that get each of its messages, as far as this is known."""
        return self.fast_path.receivers()

    @property
    def due_ns(self) -> int | None:
        """Gateway time (UTC ns) at which the core needs a tick (see ``TICK``); None if it needs none."""
        times = (self._commands.due_ns, self._links.due_ns, self._forget_at_ns)
        return min((time for time in times if time is not None), default=None)

    # -- notes of the edges, and new streams -------------------------------------------------------------------

    def _on_edge_note(self, entry: Entry) -> Outcome:
        event = Note.of(entry.data())
        if event.code == TICK:
            outcome = self._forget()
            outcome.items += [*self._commands.overdue(entry), *self._links.ping(entry), *self._links.release(entry)]
            return outcome
        if event.code == ASK_CLOCK:
            return Outcome(self.questions.ask(entry, event.data))
        if event.code == UNWRITTEN:
            self._robots.recall(entry.links, event)
            return Outcome()
        if event.code == LISTENED:
            return Outcome(self._converter.build_waiting(event.stream))
        if settings := LiveSettings.from_note(event):
            return Outcome(self._change(entry, settings), tallies=[Tally("edges", event.stream, event.code)])
        self.phases.follow(event)
        if step := ClockStep.of(entry):
            self._guard.clock_stepped(step.ahead_ns)
            self.questions.clocks.stepped(entry.stamp_ns)
        return Outcome(tallies=[Tally("edges", event.stream, event.code)])

    def _forget(self) -> Outcome:
        """Keep no more than permitted: what is forgotten depends on the inputs up to this tick only.

        Returns:
            Findings and counts of the latched messages, which late joiners miss.
        """
        self._volumes.forget()
        forgotten = {"ros_in": self._latest.forget(), "ros_out": self._subscribers.forget()}
        self._forget_at_ns = None
        outcome = Outcome()
        for section, sizes in forgotten.items():
            for topic, size in sizes.items():
                text = forgotten_text(topic, size, (self.config.latched_mib or 0) << 20)
                outcome.items.append(Finding(Level.WARN, FORGOTTEN, text, topic, subject=topic))
                outcome.tallies.append(Tally(section, topic, FORGOTTEN))
        return outcome

    def _mark(self, mark: MarkNote) -> None:
        if self.on_mark:
            self.on_mark(mark)

    def _change(self, entry: Entry, settings: LiveSettings) -> list[Item]:
        """Use other settings from now on; ``entry`` is the note about them."""
        self.config = config = settings.applied(self.config)
        self._denied_in.change(config.deny_in)
        self._denied_out.change(config.deny_out)
        self._streams.change(config)
        self._tf.max_age_of = config.max_age_of
        self.fast_path.drop_compiled()  # compiled for the settings before
        return self._links.activate(entry, active=settings.active)


@lru_cache(maxsize=1_024)  # called for every message
def is_kept(igtl_type: str) -> bool:
    """Return whether a full send queue must not drop messages of this type."""
    return igtl_type in _KEPT_TYPES or split_query(igtl_type) is not None
