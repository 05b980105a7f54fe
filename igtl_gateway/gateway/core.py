"""What happens to a message on its way.

* OpenIGTLink → ROS: CRC and structure are checked, the content is decoded, every row of the conversion table
  that applies gives a ROS message; a type without rows is published as it is.  The children of a BIND go their
  own ways.  Queries are answered.
* ROS → OpenIGTLink: the row of its type (or the configured one) gives a content, which is encoded once for
  each form that the present peers take, and addressed to all of them at once.
* The last message of a latched stream (plans, surfaces) is sent again to every link that comes up.
* A message that fails on its way costs only itself: a note says why, the ledger counts it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

from igtl_gateway.buffers import Buffer, join
from igtl_gateway.config import MAX_TIMEOUT_S, Config, TfOutRow
from igtl_gateway.convert import commands as command_conversions
from igtl_gateway.convert.assembly import VolumeAssembler
from igtl_gateway.convert.common_msgs import PoseStamped, TFMessage
from igtl_gateway.convert.context import Outgoing, ToIgtl, ToRos
from igtl_gateway.convert.frames import MAX_FRAMES
from igtl_gateway.convert.igtl_msgs import Command as RosCommand
from igtl_gateway.convert.igtl_msgs import CommandReply, LinkStatusList, Metadata, RawMessage, Size
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.convert.raw import message_of, raw_message
from igtl_gateway.convert.rosmsg import Header as RosHeader
from igtl_gateway.convert.rosmsg import RosMessage, TransformStamped
from igtl_gateway.convert.table import IgtlRow, Role, RosRow, row_to_igtl
from igtl_gateway.convert.units import Lengths
from igtl_gateway.errors import ConversionError, WireError
from igtl_gateway.gateway import queries
from igtl_gateway.gateway.commands import CommandBook, Pending
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.guard import STALE, Finding, Guard, Place, Watched
from igtl_gateway.gateway.metadata import Restored, restore
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.planning import PLANNED, PLANNED_TOPICS, Planner
from igtl_gateway.gateway.plans import NAMES, Plans
from igtl_gateway.gateway.reply import Reply, note
from igtl_gateway.gateway.sender import Outbound, Sent, send
from igtl_gateway.gateway.streams import Streams, ToIgtlStream, ToRosStream
from igtl_gateway.gateway.tf_out import TF_QOS, TF_TOPICS, TfOut
from igtl_gateway.qos import Qos
from igtl_gateway.session.clocksteps import ClockStep
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.ledger import PEERS, Ledger
from igtl_gateway.session.note import Level, Note
from igtl_gateway.stamp import NS_PER_S, ticks_to_ns
from igtl_gateway.wire import Header, Message, Raw, decode, encode
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.query import Nothing, split_query
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video

LINK_UP, LINK_DOWN = "link_up", "link_down"
#: Code of the edge notes that tell the gateway that ``due_ns`` has come.
TICK = "tick"

#: Code of the edge notes that tell, where ``Gateway.heard`` is asked, that somebody began to listen to ``stream``.
LISTENED = "listened"

#: Who is connected, for ROS.
LINKS_TOPIC = "/igtl/links"
_LINKS_QOS = Qos(depth=10, latched=True)
_RAW_QOS = Qos(depth=100)
_METADATA_QOS = Qos(depth=100)

#: Devices whose images may come in parts: each keeps its last image.
MAX_VOLUMES = 64
#: What all of them may keep, in bytes: several times the largest volumes of the field (250 MiB).
MAX_VOLUMES_BYTES = 2 << 30

#: Things that are said once, of each link: a peer that invents names must fill neither the memory nor the log, and
#: what others do is told all the same.
MAX_SAID = 2_000

#: What the ledger says of messages whose way was a good one.
_CONVERTED, _UNHEARD = "converted", "unheard"
_GOOD_FATES = frozenset({_CONVERTED, _UNHEARD})

_IN, _OUT = "igtl_in", "igtl_out"
_ROS_IN, _ROS_OUT = "ros_in", "ros_out"

#: Types whose messages each count; states and pictures are replaced by the next one anyway.
#: A frame of a video is the base of those that follow.
_KEPT_TYPES = frozenset({"STRING", "STATUS", "COMMAND", "RTS_COMMAND", "VIDEO"})


class Gateway:
    """See the package.

    ``heard``, where it is set, says of a topic and its ROS type whether anybody listens: what nobody would hear is not
    made then, and of latched topics only the last message, for the first listener (``LISTENED``).  It is no input, so
    sessions that are recorded leave it unset: they make, and hold, everything.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.heard: Callable[[str, str], bool] | None = None
        self.ledger = Ledger()
        self._peers = Peers(config)
        self._streams = Streams(config)
        self.plans = Plans()
        # latched topic → what its last message is to be made of, once somebody listens; as many as there are topics
        self._unmade: dict[str, tuple[Entry, RosRow, object, ToRos]] = {}
        self._latest: dict[str, Entry] = {}  # topic → its last message; as many as there are bridged topics
        self._planner = Planner(config, self.ledger, self._latest, self._unmade, self._streams.qos)
        self._volumes: dict[str, VolumeAssembler] = {}  # device → the volume that its updates are part of
        self._frames: set[str] = set()  # frame ids of what went out
        self._video_sizes: dict[str, Size] = {}  # topic → size of its last key frame
        self._tf = TfOut(config, tuple(self._streams.device(row.request().device) for row in config.tf_out))
        self._from_peers, self._to_peers = CommandBook(), CommandBook()
        self._denied_in, self._denied_out = Denials(config.deny_in), Denials(config.deny_out)
        self._guard = Guard(watch=config.watch is True)
        self._said: dict[int, set[tuple[str, str]]] = {}  # link → code and what it is about
        self._streams.advertise(LINKS_TOPIC, _LINKS_QOS)
        self._handlers: dict[Kind, Callable[[Entry], list[Reply]]] = {
            Kind.IGTL_IN: self._from_igtl,
            Kind.ROS_IN: self._from_ros,
            Kind.LINK: self._on_link,
            Kind.EDGE_NOTE: self._on_edge_note,
        }

    def handle(self, entry: Entry) -> list[Entry]:
        """The entries that ``entry`` causes, numbered and stamped directly behind it.

        Outputs (``*_OUT``, ``NOTE``) are accepted and cause nothing.
        """
        handler = self._handlers.get(entry.kind)
        if handler is None:
            return []
        try:
            replies = handler(entry) + self._news()
        except Exception as error:  # a defect of ours must cost one message, not the session
            self._streams.news.clear()
            self.ledger.drop(entry.kind.value, entry.channel, "internal_error")
            text = f"message lost to a defect of the gateway: {type(error).__name__}: {error}"
            replies = [note(Level.ERROR, "internal_error", text, entry.channel, entry.links)]
        return [reply.entry(entry, step) for step, reply in enumerate(replies, start=1)]

    # -- questions of the edges, answered without changing anything that influences outputs -------------------

    def subscription(self, topic: str, ros_type: str) -> Qos | None:
        """The QoS with which to subscribe to a topic that is to be bridged, None if it is not."""
        if self._tf and topic in TF_QOS and ros_type == TFMessage.TYPE:
            return TF_QOS[topic]
        row, conversion = self._streams.rows(topic, ros_type)
        if row and ros_type == RawMessage.TYPE:
            return row.qos or _RAW_QOS
        return row.qos or conversion.qos if row and conversion else None

    def lacks_conversion(self, topic: str, ros_type: str) -> bool:
        """Whether a topic is to be bridged, but no row of the conversion table can do it."""
        row, conversion = self._streams.rows(topic, ros_type)
        return row is not None and conversion is None and ros_type != RawMessage.TYPE

    def qos(self, topic: str) -> Qos | None:
        """The QoS of a topic that the gateway publishes."""
        return self._streams.qos(topic)

    def keep(self, entry: Entry) -> bool:
        """Whether an outgoing OpenIGTLink message must not be dropped at a full send queue."""
        return _is_kept(entry.type)

    @property
    def guard(self) -> Guard:
        """What is known of the streams' stamps."""
        return self._guard

    @property
    def due_ns(self) -> int | None:
        """The gateway time (UTC ns) at which it wants a tick, None if none; see ``TICK``."""
        pings = (peer.said_ns + peer.profile.ping_ns for peer in self._pinged())
        times = (self._from_peers.due_ns, self._to_peers.due_ns, min(pings, default=None))
        return min((time for time in times if time is not None), default=None)

    def _pinged(self) -> Iterable[Peer]:
        """The peers that want to hear something from time to time."""
        if self._denied_out.type("GET_STATUS"):
            return ()
        return (peer for peer in self._peers.all() if peer.profile.ping_ns)

    # -- OpenIGTLink → ROS --------------------------------------------------------------------------------------

    def _from_igtl(self, entry: Entry) -> list[Reply]:
        self.ledger.count(_IN, entry.channel, "received")
        link = entry.links[0]
        try:
            message = decode(entry.payload[0], check_crc=self.config.check_crc)
        except WireError as error:
            self.ledger.drop(_IN, entry.channel, error.code)
            return [note(Level.ERROR, error.code, f"message refused: {error}", entry.channel, (link,))]
        self.ledger.count(_IN, entry.channel, "decoded")
        peer = self._peers.get(link)
        news = self._learn(entry, peer, message) if peer else []
        if denied := self._denied_in.message(message):
            self.ledger.drop(_IN, entry.channel, "denied")
            return news + self._deny(entry, peer, message, denied)
        if peer and (refused := self._refused(entry, peer, message)):
            self.ledger.drop(_IN, entry.channel, "command_refused")
            return news + refused
        replies, fate = self._deliver(entry, message, restore(message))
        if fate in _GOOD_FATES:
            self.ledger.count(_IN, entry.channel, fate)
        else:
            self.ledger.drop(_IN, entry.channel, fate)
        if peer and not news and fate in _GOOD_FATES and entry.type in PLANNED and not self._tf:
            self._plan_to_ros(entry, message)
        return news + replies + (self._respond(entry, peer, message) if peer else [])

    def _deny(self, entry: Entry, peer: Peer | None, message: Message, denied: str) -> list[Reply]:
        """What is said of a message that may not come in; whoever asks or commands is told so."""
        igtl_type = visible(message.type)
        inside = f" with {denied} inside" if denied != igtl_type else ""
        text = f"{igtl_type}{inside} from {peer.address or 'the peer' if peer else 'a peer'} is denied (deny_in)"
        said = self._once(entry, Level.WARN, "denied", text, igtl_type, entry.links[0])
        if peer is None:
            return said
        if isinstance(message.content, Command) and igtl_type == "COMMAND":
            name, device = visible(message.content.name), visible(message.device_name)
            pending = Pending(peer.link, message.content.command_id, device, name, entry.stamp_ns)
            return said + self._reply(entry, pending, CommandReply.FAIL, "COMMAND is denied")
        query = split_query(message.type)
        return said + self._deny_query(entry, peer, message, *query) if query else said

    def _deny_query(self, entry: Entry, peer: Peer, message: Message, prefix: str, igtl_type: str) -> list[Reply]:
        """A query refused: by its RTS_ where it has one, else by a STATUS."""
        if prefix == "RTS":
            return []
        device = short_device_name(visible(message.device_name))
        outs = queries.denial(prefix, igtl_type, device, entry.stamp_ns)
        return self._each(entry, outs, lambda out: self._to(entry, [peer], [out]))

    def _plan_to_ros(self, entry: Entry, message: Message) -> None:
        """Keep what is the same for the next message of this device."""
        key = (entry.links[0], bytes(entry.payload[0][NAMES]))
        stream = self._streams.to_ros(visible(message.type), visible(message.device_name))
        if stream and self.plans.wants(key):
            to = self._circumstances(entry, message, restore(message), stream)
            watched = self._guard.of(to.link, entry.channel, stream.row.max_age_s)
            try:
                plan = self._planner.to_ros(entry, message, stream, to, watched, self._volumes.get(to.device_name))
            except ConversionError:  # of a message that nobody hears: it was not converted
                return
            self.plans.keep_to_ros(key, plan)

    def _learn(self, entry: Entry, peer: Peer, message: Message) -> list[Reply]:
        """What a message shows of its sender."""
        before = peer.profile
        if not peer.hear(message):
            return []
        self.plans.peers_changed()
        replies = [self._links(entry.stamp_ns)]
        if peer.profile is not before:
            text = f"{peer.address or 'the peer'} is taken for {peer.profile.name}, by what it sent"
            replies.append(note(Level.INFO, "peer_profile", text, entry.channel, (peer.link,)))
        return replies

    def _deliver(self, entry: Entry, message: Message, told: Restored) -> tuple[list[Reply], str]:
        """A decoded message to ROS: what goes out, and what the ledger is to say of it."""
        igtl_type, link = visible(message.type), entry.links[0]
        stream = self._streams.to_ros(igtl_type, told.device_name)
        if stream is None:
            text = f"more than {self.config.max_streams} streams: {entry.channel} is recorded, not published"
            return self._once(entry, Level.WARN, "too_many_streams", text, "", link), "too_many_streams"
        to = self._circumstances(entry, message, told, stream)
        found: list[Reply] = []
        name = entry.channel if entry.payload else f"{igtl_type}/{told.device_name}"  # of a child of a BIND: its own
        if watched := self._guard.of(link, name, stream.row.max_age_s):
            own_ns, place = told.stamp_ns or ticks_to_ns(message.ticks), _place_of(message.content)
            withheld, found = self._looked_at(entry, watched, own_ns, to.stamp_ns, place)
            if withheld:
                return found, STALE
        replies, fate = self._converted_to_ros(entry, message, told, stream, to)
        return replies + found, fate

    def _looked_at(
        self, entry: Entry, watched: Watched, own_ns: int, told_ns: int, place: Place | None
    ) -> tuple[bool, list[Reply]]:
        """Whether a message is too old to be forwarded, and what the guard says of it."""
        withheld, findings = watched.judge(entry.stamp_ns, own_ns)
        findings += watched.see(entry.stamp_ns, told_ns, place)
        return withheld, [_found(entry, finding) for finding in findings]

    def _converted_to_ros(
        self, entry: Entry, message: Message, told: Restored, stream: ToRosStream, to: ToRos
    ) -> tuple[list[Reply], str]:
        """The conversion of a message that is fresh enough, and its fate."""
        content = message.content
        try:
            if isinstance(content, Bind):
                return self._unbound(entry, message, content, told, stream, to), _CONVERTED
            if isinstance(content, Image):
                whole = self._assembled(told.device_name, content)
                if whole is None:
                    return [], "part_of_volume"
                content = whole
            outputs = [pair for pair in stream.outputs if isinstance(content, pair[0].content)]
            if not outputs:
                return self._unconverted(entry, message, stream, to)
            if not any(row.applies(content) for row, _ in outputs):
                return [], "not_chosen"
            replies = self._publish(entry, content, to, stream, outputs)
            return replies, _CONVERTED if replies or self.heard is None else _UNHEARD
        except (ConversionError, WireError) as error:
            said = note(Level.ERROR, "conversion", f"not published: {error}", entry.channel, entry.links)
            return [said], _reason(error)

    def _circumstances(self, entry: Entry, message: Message, told: Restored, stream: ToRosStream) -> ToRos:
        source_ns = told.stamp_ns or ticks_to_ns(message.ticks)
        return ToRos(
            told.device_name,
            self.config.pick_stamp(stream.row, source_ns, entry.stamp_ns),
            stream.row.frame_id or told.frame_id or stream.frame_id,
            stream.row.child_frame_id or told.child_frame_id or stream.child_frame_id,
            stream.lengths,
            visible(message.type),
            told.items,
            message.message_id,
            entry.links[0],
        )

    def _publish(
        self, entry: Entry, content: object, to: ToRos, stream: ToRosStream, outputs: list[tuple[RosRow, str]]
    ) -> list[Reply]:
        """By every row that applies.  What one refuses costs the others nothing; raises where all do."""
        replies: list[Reply] = []
        frames: list[Reply] = []
        refused: list[tuple[RosRow, ConversionError]] = []
        full = False
        for row, topic in outputs:
            if not row.applies(content):
                continue
            if not self._is_heard(topic, row.message.TYPE):
                full = full or row.role is Role.FULL
                qos = self._streams.qos(topic)
                if qos and qos.latched:
                    self._unmade[topic] = entry, row, content, to
                continue
            try:
                messages = _made(row, content, to)
            except ConversionError as error:
                refused.append((row, error))
                continue
            full = full or row.role is Role.FULL
            self._unmade.pop(topic, None)
            for message in messages:
                replies.append(self._published(topic, message, to.stamp_ns))
                if self._tf and isinstance(message, TFMessage):
                    frames += self._send_frames(entry, message, static=False)
        if refused and not replies:
            raise refused[0][1]
        replies += [
            note(Level.ERROR, "conversion", f"not published as {row.message.TYPE}: {error}", entry.channel, entry.links)
            for row, error in refused
        ]
        if to.metadata and not full and self._is_heard(stream.metadata_topic, Metadata.TYPE):
            message = Metadata(
                RosHeader(to.stamp_ns, to.frame_id), to.igtl_type, to.device_name, to.message_id, to.metadata
            )
            self._streams.advertise(stream.metadata_topic, _METADATA_QOS)
            replies.append(self._published(stream.metadata_topic, message, to.stamp_ns))
        return replies + self._warnings(to.warnings, entry) + frames

    def _is_heard(self, topic: str, ros_type: str) -> bool:
        """Whether a message of a topic has to be made: for ROS, or for the frames that go out."""
        return self.heard is None or self.heard(topic, ros_type) or (bool(self._tf) and ros_type == TFMessage.TYPE)

    def _published(self, topic: str, message: RosMessage, stamp_ns: int) -> Reply:
        self.ledger.count(_ROS_OUT, topic, "published")
        return Reply(Kind.ROS_OUT, topic, message.TYPE, (message.pack(),), (), stamp_ns)

    def _unconverted(self, entry: Entry, message: Message, stream: ToRosStream, to: ToRos) -> tuple[list[Reply], str]:
        """A message without a conversion: as it is; an empty one of a type that has conversions: not at all."""
        if stream.outputs and isinstance(message.content, Raw):
            text = f"{to.igtl_type} has an empty body: nothing to publish"
            return self._once(entry, Level.INFO, "empty", text, message.type, to.link), "empty"
        if any(not kind.startswith("+") for kind in stream.row.kinds):
            return [], "not_chosen"
        self._streams.advertise(stream.raw_topic, _RAW_QOS)
        # a child of a BIND has no message of its own, and the whole BIND for each of thousands would fill the memory
        data = entry.payload[0] if entry.payload else join(encode(message))
        raw = raw_message(data, entry.stamp_ns, to.link)
        text = f"{to.igtl_type} has no conversion to ROS and is published as it is"
        published = self._published(stream.raw_topic, raw, to.stamp_ns)
        return [published, *self._once(entry, Level.INFO, "no_conversion", text, message.type, to.link)], _CONVERTED

    def _unbound(
        self, entry: Entry, message: Message, bind: Bind, told: Restored, stream: ToRosStream, to: ToRos
    ) -> list[Reply]:
        """A BIND as a whole, then each of its children as if it had come alone."""
        replies = self._publish(entry, bind, to, stream, list(stream.outputs)) if stream.outputs else []
        alone = replace(entry, payload=())
        for child in bind.children:
            try:
                content = child.body()
            except WireError as error:
                text = f"child {visible(child.name)!r} of {entry.channel} refused: {error}"
                replies.append(note(Level.ERROR, error.code, text, entry.channel, entry.links))
                continue
            name = visible(child.name) or told.device_name
            inner = Message(child.type, short_device_name(name), content, message.ticks)
            replies += self._deliver(alone, inner, replace(told, device_name=name, items=()))[0]
        return replies

    def _assembled(self, device: str, image: Image) -> Image | None:
        """The whole image that an update is part of; None as long as parts of it have never been sent."""
        assembler = self._volumes.get(device)
        if assembler is None:
            if len(self._volumes) >= MAX_VOLUMES:
                if image.sub_size == image.dimensions:
                    return image
                raise ConversionError(
                    f"IMAGE {device!r}: found a part of an image, expected whole ones beyond {MAX_VOLUMES} devices"
                )
            assembler = self._volumes[device] = VolumeAssembler()
        others = sum(one.held for one in self._volumes.values()) - assembler.held
        return assembler.update(image, MAX_VOLUMES_BYTES - others)

    # -- queries and commands -----------------------------------------------------------------------------------

    def _respond(self, entry: Entry, peer: Peer, message: Message) -> list[Reply]:
        """What a peer is told in answer to a message."""
        if isinstance(message.content, Command):
            if visible(message.type) != "COMMAND":
                self._to_peers.take(message.content.command_id, peer.link)
            return []
        query = split_query(message.type)
        if query is None:
            return []
        self.plans.peers_changed()
        prefix, igtl_type = query
        # a name of odd bytes is longer as text: what answers it has to fit the wire
        device, now_ns = short_device_name(visible(message.device_name)), entry.stamp_ns
        if prefix in ("GET", "STT") and self._denied_out.type(igtl_type):
            text = f"{message.type} refused: {igtl_type} is sent to nobody (deny_out)"
            said = self._once(entry, Level.WARN, "denied", text, visible(message.type), peer.link)
            return said + self._deny_query(entry, peer, message, prefix, igtl_type)
        match prefix:
            case "GET":
                outs = queries.answer(igtl_type, device, now_ns, lambda *key: self._latest_of(entry, *key))
                replies = self._each(entry, outs, lambda out: self._to(entry, [peer], [out]))
                if outs and (_has_igtl(replies) or not peer.profile.may_send(igtl_type)):
                    return replies
                text = f"{message.type} of {device or 'any device'} cannot be answered: there is none yet"
                said = self._once(entry, Level.INFO, "query_unanswered", text, entry.channel, peer.link)
                return replies + self._to(entry, [peer], [queries.refusal(igtl_type, device, now_ns, peer)]) + said
            case "STT":
                status = queries.start(message, igtl_type, peer, self._knows_frame)
                replies = self._to(entry, [peer], queries.acknowledgement(igtl_type, device, now_ns, status))
                if status == queries.OK:
                    text = f"{message.type} of {device or 'any device'}: a stream begins"
                    return [*replies, note(Level.INFO, "stream_started", text, entry.channel, (peer.link,))]
                text = f"{message.type} of {device or 'any device'} refused: unknown frame, type or too many streams"
                return [*replies, note(Level.WARN, "stream_refused", text, entry.channel, (peer.link,))]
            case "STP":
                peer.stop(igtl_type, visible(message.device_name))
                return self._to(entry, [peer], queries.acknowledgement(igtl_type, device, now_ns, queries.OK))
            case _:
                return []

    def _knows_frame(self, frame: str) -> bool:
        """Whether poses can be told in a coordinate frame."""
        return frame in self._frames or self._tf.tree.knows(frame)

    def _latest_of(self, cause: Entry, igtl_type: str, device: str) -> list[Outbound]:
        """The latest messages of a type: of the streams that go out as such, else of those that could."""
        native: list[Outbound] = []
        other: list[Outbound] = []
        for entry in self._latest.values():
            stream = self._streams.to_igtl(entry.channel, entry.type)
            if stream is None or device not in ("", stream.device, stream.full_name):
                continue
            outs = self._outbounds(entry, igtl_type)
            if stream.row.max_age_s and not stream.latched:  # who asks later must not get as new what has become old
                least_ns = cause.stamp_ns - self._guard.ahead_ns - round(stream.row.max_age_s * NS_PER_S)
                outs = [out for out in outs if out.stamp_ns >= least_ns]
            (native if stream.conversion.igtl_type == igtl_type else other).extend(outs)
        native += [
            out
            for out in self._tf.latest(cause.stamp_ns - self._guard.ahead_ns)
            if out.igtl_type == igtl_type and device in ("", out.device, out.full_name)
        ]
        return native or other

    def _outbounds(self, entry: Entry, igtl_type: str) -> list[Outbound]:
        """A kept ROS message as ``igtl_type`` ("" = that of its stream); none where it cannot be."""
        stream = self._streams.to_igtl(entry.channel, entry.type)
        conversion = row_to_igtl(entry.type, igtl_type) if igtl_type and stream else None
        if stream is None or (igtl_type and conversion is None):
            return []
        try:
            return [self._outbound(entry, stream, conversion or stream.conversion, ToIgtl(stream.lengths))]
        except ConversionError:  # said when it came
            return []

    def _refused(self, entry: Entry, peer: Peer, message: Message) -> list[Reply]:
        """Remember a command until its reply; what the peer is told of one that cannot be taken.

        Whoever is told of a failure must be able to rely on it: a refused command does not reach ROS.
        """
        command = message.content
        if not isinstance(command, Command) or visible(message.type) != "COMMAND":
            return []
        deadline_ns = entry.stamp_ns + int(self.config.command_timeout_s * NS_PER_S)
        pending = Pending(
            peer.link, command.command_id, visible(message.device_name), visible(command.name), deadline_ns
        )
        if self._from_peers.add(pending):
            return []
        text = f"command {pending.command_id} ({pending.name!r}) refused: its id, or too many others, wait already"
        replies = self._reply(entry, pending, CommandReply.FAIL, text)
        return [*replies, note(Level.WARN, "command_refused", text, entry.channel, (peer.link,))]

    def _reply(self, entry: Entry, pending: Pending, status: int, text: str) -> list[Reply]:
        """An RTS_COMMAND of the gateway's own."""
        peer = self._peers.get(pending.link)
        if peer is None:
            return []
        header = RosHeader(entry.stamp_ns)
        message = CommandReply(header, pending.device, pending.command_id, pending.name, status, text)
        return self._to(entry, [peer], [self._replying(entry, pending, message)])

    @staticmethod
    def _replying(entry: Entry, pending: Pending, message: CommandReply) -> Outbound:
        """A reply as the command wants it: with its device and name."""
        device = short_device_name(pending.device)  # a name of odd bytes is longer as text
        named = replace(message, device_name=device, name=message.name or pending.name)
        outgoing = command_conversions.reply_to_igtl(named, ToIgtl())
        stamp_ns = message.header.stamp_ns or entry.stamp_ns
        return Outbound("RTS_COMMAND", device, outgoing.content, stamp_ns, metadata=outgoing.metadata)

    # -- ROS → OpenIGTLink --------------------------------------------------------------------------------------

    def _from_ros(self, entry: Entry) -> list[Reply]:
        topic = entry.channel
        self.ledger.count(_ROS_IN, topic, "received")
        if self._tf and topic in TF_TOPICS and entry.type == TFMessage.TYPE:
            return self._on_tf(entry)
        if entry.type == RawMessage.TYPE and self.config.row_to_igtl(topic):
            return self._on_raw(entry)
        stream = self._streams.to_igtl(topic, entry.type)
        if stream is None:
            if self._streams.beyond(topic, entry.type):
                self.ledger.drop(_ROS_IN, topic, "too_many_streams")
                text = f"more than {self.config.max_streams} streams: {topic} is recorded, not sent"
                return self._once(entry, Level.WARN, "too_many_streams", text, "ros")
            self.ledger.count(_ROS_IN, topic, "recorded_only")
            return []
        to = ToIgtl(stream.lengths)
        lonely = not self._peers and stream.conversion.igtl_type != "COMMAND"
        found: list[Reply] = []
        if not stream.row.max_age_s:  # what is too old must not become the latest
            self._latest[topic] = entry
            if lonely:
                self.ledger.drop(_ROS_IN, topic, "no_peer")
                return []
        try:
            message = stream.conversion.message.unpack(entry.payload[0])
            outgoing = stream.conversion.convert(message, to)
            igtl_type = outgoing.igtl_type or stream.conversion.igtl_type
            if self._denied_out and self._denied_out.content(igtl_type, outgoing.content):
                return self._deny_ros(entry, stream, outgoing, igtl_type)
            watched = self._guard.of(0, topic, stream.row.max_age_s)
            if watched:
                own_ns = outgoing.stamp_ns or entry.source_ns
                told_ns = self.config.pick_stamp(stream.row, own_ns, entry.stamp_ns)
                withheld, found = self._looked_at(entry, watched, own_ns, told_ns, _place_of(message))
                if withheld:
                    self.ledger.drop(_ROS_IN, topic, STALE)
                    return found
                self._latest[topic] = entry
            if lonely:
                self.ledger.drop(_ROS_IN, topic, "no_peer")
                return found
            special = _SPECIAL.get(stream.conversion.igtl_type)
            if special:
                replies = special(self, entry, stream, outgoing)
            else:
                out = self._as_outbound(entry, stream, stream.conversion, outgoing)
                replies = self._to_trackers(entry, self._addressed(outgoing), out, stream.lengths)
                replies += self._tracked(entry, out, stream.lengths)
                key = (topic, entry.type)
                if entry.type in PLANNED_TOPICS and self.plans.wants(key):
                    plan = self._planner.to_igtl(entry, stream, out, tuple(self._peers.all()), watched)
                    self.plans.keep_to_igtl(key, plan)
        except (ConversionError, WireError) as error:
            self.ledger.drop(_ROS_IN, topic, _reason(error))
            return [note(Level.ERROR, "conversion", f"not sent: {error}", topic), *found]
        if _has_igtl(replies):
            self.ledger.count(_ROS_IN, topic, "converted")
        else:
            self.ledger.drop(_ROS_IN, topic, "not_wanted")
        return replies + self._warnings(to.warnings, entry) + found

    def _deny_ros(self, entry: Entry, stream: ToIgtlStream, outgoing: Outgoing, igtl_type: str) -> list[Reply]:
        """What is said of a ROS message that peers may not be sent; who commands is told at once."""
        self.ledger.drop(_ROS_IN, entry.channel, "denied")
        text = f"{entry.channel} is not sent: {igtl_type} is denied (deny_out)"
        replies = self._once(entry, Level.WARN, "denied", text, f"{entry.channel} {igtl_type}")
        command = outgoing.content
        if isinstance(command, Command) and igtl_type == "COMMAND":
            device = outgoing.device_name or stream.full_name
            asked = Pending(outgoing.link, command.command_id, device, visible(command.name), entry.stamp_ns)
            replies += self._tell(entry, asked, CommandReply.FAIL, "COMMAND is denied")
        return replies

    def _addressed(self, outgoing: Outgoing) -> Iterable[Peer]:
        """The peers that a message is for."""
        if not outgoing.link:
            return self._peers.all()
        peer = self._peers.get(outgoing.link)
        if peer is None:
            raise ConversionError(f"found link {outgoing.link}, expected 0 (all) or the number of a peer that is there")
        return (peer,)

    def _outbound(self, entry: Entry, stream: ToIgtlStream, conversion: IgtlRow, to: ToIgtl) -> Outbound:
        outgoing = conversion.convert(conversion.message.unpack(entry.payload[0]), to)
        return self._as_outbound(entry, stream, conversion, outgoing)

    def _as_outbound(self, entry: Entry, stream: ToIgtlStream, conversion: IgtlRow, outgoing: Outgoing) -> Outbound:
        device, full_name, content = stream.device, stream.full_name, outgoing.content
        if len(self._frames) < MAX_FRAMES:
            self._frames.add(outgoing.frame_id)
        if isinstance(content, Video):
            content = self._sized(entry.channel, content)
        # a query without a device asks for any
        if outgoing.device_name or (outgoing.igtl_type and split_query(outgoing.igtl_type)):
            full_name = outgoing.device_name
            device = self._streams.device(full_name)
        return Outbound(
            outgoing.igtl_type or conversion.igtl_type,
            device,
            content,
            self.config.pick_stamp(stream.row, outgoing.stamp_ns or entry.source_ns, entry.stamp_ns),
            full_name,
            outgoing.stamp_ns,
            outgoing.frame_id,
            outgoing.child_frame_id,
            (*stream.row_metadata, *outgoing.metadata),
        )

    def _sized(self, topic: str, frame: Video) -> Video:
        """A frame with the size of its stream, which only key frames tell."""
        if frame.size[0]:
            self._video_sizes[topic] = frame.size
            return frame
        return replace(frame, size=self._video_sizes.get(topic, frame.size), subvol_size=None)

    def _to(self, entry: Entry, peers: Iterable[Peer], outs: list[Outbound], *, asked: bool = True) -> list[Reply]:
        """Messages to peers, with notes for those that must not have them."""
        replies: list[Reply] = []
        for out in outs:
            if self._denied_out.type(out.igtl_type):  # whatever its way was: nothing denied leaves
                self.ledger.drop(_OUT, out.channel, "denied")
                text = f"{out.channel} is not sent: {out.igtl_type} is denied (deny_out)"
                replies += self._once(entry, Level.WARN, "denied", text, out.igtl_type)
                continue
            sent = send(out, peers, entry.stamp_ns, asked=asked)
            for reply in sent.replies:
                self._count_sent(reply.channel, reply.links)
            replies += sent.replies + self._held_back(entry, sent)
        return replies

    def _count_sent(self, channel: str, links: Sequence[int]) -> None:
        self.ledger.count(_OUT, channel, "sent", len(links))
        for link in links:
            self._peers[link].sent += 1

    def _held_back(self, entry: Entry, sent: Sent) -> list[Reply]:
        replies = self._warnings(sent.warnings, entry) if sent.warnings else []
        for peer, igtl_type in sent.refused:
            self.ledger.drop(_OUT, igtl_type, f"not_for_{peer.profile.name}")
            text = (
                f"{igtl_type} is not sent to {peer.address or 'the peer'}: no type for the profile {peer.profile.name}"
            )
            replies += self._once(entry, Level.INFO, "not_for_peer", text, igtl_type, peer.link)
        return replies

    def _to_trackers(self, entry: Entry, peers: Iterable[Peer], out: Outbound, lengths: Lengths) -> list[Reply]:
        """A message to peers; tracking data in the frame that each asked for."""
        if out.igtl_type not in queries.TRACKING:
            return self._to(entry, peers, [out], asked=False)
        by_frame: dict[str, list[Peer]] = {}
        for peer in peers:
            wish = peer.wish(out.igtl_type, out.device)
            frame = wish.frame if wish else ""
            by_frame.setdefault("" if frame == out.frame_id else frame, []).append(peer)
        replies: list[Reply] = []
        for frame, members in by_frame.items():
            moved = out
            if frame:
                place = self._tf.tree.latest(out.frame_id, frame)
                if place is None:
                    text = (
                        f"{out.channel} is in frame {out.frame_id!r}, which nothing connects with {frame!r}: not sent"
                    )
                    replies += self._once(entry, Level.WARN, "unknown_frame", text, frame)
                    continue
                content = queries.in_frame(out.content, place[1], lengths)
                moved = replace(out, content=content, frame_id=frame)
            replies += self._to(entry, members, [moved], asked=False)
        return replies

    def _tracked(self, entry: Entry, out: Outbound, lengths: Lengths) -> list[Reply]:
        """Tracking data for those who asked for it, where only single poses go out."""
        replies: list[Reply] = []
        if out.igtl_type not in queries.TRACKING.values():
            return replies
        made: dict[str, Outbound | None] = {}  # the same for whatever name it was asked for by
        for (igtl_type, device), peers in queries.trackers(self._peers.all()).items():
            name = device or queries.TRACKING_DEVICE
            if not any(peer.is_due(igtl_type, name, entry.stamp_ns) for peer in peers):
                continue
            if igtl_type not in made:
                made[igtl_type] = (
                    None
                    if self._goes_out(igtl_type)
                    else queries.tracking(igtl_type, "", entry.stamp_ns, lambda *key: self._latest_of(entry, *key))
                )
            if found := made[igtl_type]:
                replies += self._to_trackers(entry, peers, replace(found, device=name), lengths)
        return replies

    def _goes_out(self, igtl_type: str) -> bool:
        """Whether a stream of its own goes out as a type."""
        streams = (self._streams.to_igtl(one.channel, one.type) for one in self._latest.values())
        own = any(stream.conversion.igtl_type == igtl_type for stream in streams if stream)
        return own or any(out.igtl_type == igtl_type for out in self._tf.latest())

    def _on_tf(self, entry: Entry) -> list[Reply]:
        try:
            message = TFMessage.unpack(entry.payload[0])
        except ConversionError as error:
            self.ledger.drop(_ROS_IN, entry.channel, "conversion")
            return [note(Level.ERROR, "conversion", f"not sent: {error}", entry.channel)]
        replies = self._send_frames(entry, message, static=TF_TOPICS[entry.channel])
        self.ledger.count(_ROS_IN, entry.channel, "converted")
        return replies

    def _send_frames(self, entry: Entry, message: TFMessage, *, static: bool) -> list[Reply]:
        """What a change of the tf tree sends out."""
        stale: list[Reply] = []

        def is_stale(row: TfOutRow, frame: str, stamp_ns: int) -> bool:
            watched = self._guard.of(0, f"frame {frame} in {row.base}", row.max_age_s)
            withheld, findings = watched.judge(entry.stamp_ns, stamp_ns) if watched else (False, [])
            stale.extend(_found(entry, finding) for finding in findings)
            return withheld

        changed, refused = self._tf.update(message, static, entry.stamp_ns, is_stale)
        replies = stale + [note(Level.ERROR, "conversion", f"not sent: {text}", entry.channel) for text in refused]
        lengths = {out.channel: lengths for out, lengths in changed}
        outs = [out for out, _ in changed]
        replies += self._each(
            entry, outs, lambda out: self._to_trackers(entry, self._peers.all(), out, lengths[out.channel])
        )
        # tracking data is put together of all poses: once for each type, however many of them have changed
        last = {out.igtl_type: out for out in outs}
        return replies + self._each(entry, last.values(), lambda out: self._tracked(entry, out, lengths[out.channel]))

    def _each(self, entry: Entry, outs: Iterable[Outbound], send: Callable[[Outbound], list[Reply]]) -> list[Reply]:
        """Messages sent one by one: one that cannot be sent costs only itself."""
        replies: list[Reply] = []
        for out in outs:
            try:
                replies += send(out)
            except (ConversionError, WireError) as error:
                self.ledger.drop(_OUT, out.channel, "conversion")
                text = f"{out.channel} is not sent: {error}"
                replies.append(note(Level.ERROR, "conversion", text, entry.channel, entry.links))
        return replies

    def _on_raw(self, entry: Entry) -> list[Reply]:
        """A whole OpenIGTLink message from ROS, sent as it is."""
        topic = entry.channel
        try:
            raw = RawMessage.unpack(entry.payload[0])
            data = message_of(raw)
        except ConversionError as error:
            self.ledger.drop(_ROS_IN, topic, "conversion")
            return [note(Level.ERROR, "conversion", f"not sent: {error}", topic)]
        header = Header.unpack(data)
        igtl_type = visible(header.type)
        if self._denied_out and self._denied_raw(igtl_type, data):
            self.ledger.drop(_ROS_IN, topic, "denied")
            text = f"{topic} is not sent: {igtl_type} is denied (deny_out)"
            return self._once(entry, Level.WARN, "denied", text, f"{topic} {igtl_type}")
        found: list[Reply] = []
        row = self.config.row_to_igtl(topic)
        if row and row.max_age_s and (watched := self._guard.of(0, topic, row.max_age_s)):
            own_ns = ticks_to_ns(header.ticks)
            withheld, found = self._looked_at(entry, watched, own_ns, own_ns or entry.stamp_ns, None)
            if withheld:
                self.ledger.drop(_ROS_IN, topic, STALE)
                return found
        wanted = {int(link) for link in raw.links}
        peers = [peer for peer in self._peers.all() if not wanted or peer.link in wanted]
        links = [peer.link for peer in peers if header.version <= peer.version and peer.profile.may_send(igtl_type)]
        if not links:
            self.ledger.drop(_ROS_IN, topic, "no_peer" if not peers else "not_for_peer")
            return found
        self.ledger.count(_ROS_IN, topic, "converted")
        channel = f"{igtl_type}/{visible(header.device_name)}"
        self._count_sent(channel, links)
        return [Reply(Kind.IGTL_OUT, channel, igtl_type, (data,), tuple(links), ticks_to_ns(header.ticks)), *found]

    def _denied_raw(self, igtl_type: str, data: Buffer) -> bool:
        """Whether a whole message may not go out; a BIND that cannot be looked into may not."""
        if igtl_type != "BIND":
            return self._denied_out.type(igtl_type)
        try:
            return bool(self._denied_out.message(decode(data, check_crc=False)))
        except WireError:
            return True

    def _send_command(self, entry: Entry, stream: ToIgtlStream, outgoing: Outgoing) -> list[Reply]:
        """A COMMAND: numbered if it has no number, remembered until its reply."""
        command = outgoing.content
        assert isinstance(command, Command)
        if not command.command_id:
            command = replace(command, command_id=self._to_peers.new_id())
        out = self._as_outbound(entry, stream, stream.conversion, replace(outgoing, content=command))
        timeout_s = RosCommand.unpack(entry.payload[0]).timeout
        if not 0 < timeout_s <= MAX_TIMEOUT_S:
            timeout_s = self.config.command_timeout_s
        deadline_ns = entry.stamp_ns + int(timeout_s * NS_PER_S)
        pending = Pending(0, command.command_id, out.full_name, visible(command.name), deadline_ns)
        readers = (peer for peer in self._peers.all() if peer.profile.may_send(out.igtl_type))
        peers = [peer for peer in readers if outgoing.link in (0, peer.link)]
        asked = [one for one in peers if self._to_peers.add(replace(pending, link=one.link))]
        if not asked:
            text = "the id, or too many others, wait already" if peers else "no peer is there to be asked"
            status = CommandReply.FAIL if peers else CommandReply.NO_PEER
            return self._tell(entry, replace(pending, link=outgoing.link), status, text)
        try:
            return self._to(entry, asked, [out])
        except WireError as error:
            for one in asked:
                self._to_peers.take(pending.command_id, one.link)
            text = f"not sent: {error}"
            said = note(Level.ERROR, "conversion", text, entry.channel)
            return [said, *self._tell(entry, replace(pending, link=outgoing.link), CommandReply.FAIL, text)]

    def _send_reply(self, entry: Entry, stream: ToIgtlStream, outgoing: Outgoing) -> list[Reply]:
        """An RTS_COMMAND: to the peer that waits for it."""
        message = CommandReply.unpack(entry.payload[0])
        pending = self._from_peers.take(message.id, message.link)
        if pending is None:
            raise ConversionError(f"CommandReply: found id {message.id}, expected one of a command that waits")
        try:
            return self._to(entry, [self._peers[pending.link]], [self._replying(entry, pending, message)])
        except (ConversionError, WireError) as error:
            text = f"the reply cannot be sent: {error}"
            said = note(Level.ERROR, "conversion", text, entry.channel)
            return [said, *self._reply(entry, pending, CommandReply.FAIL, text)]

    def _tell(self, entry: Entry, pending: Pending, status: int, text: str) -> list[Reply]:
        """A reply to ROS that no peer sent."""
        stream = self._streams.to_ros("RTS_COMMAND", pending.device)
        if stream is None:
            return []
        header = RosHeader(entry.stamp_ns, stream.frame_id)
        message = CommandReply(
            header, pending.device, pending.command_id, pending.name, status, text, link=pending.link
        )
        return [
            self._published(topic, message, entry.stamp_ns)
            for row, topic in stream.outputs
            if row.message is CommandReply
        ]

    # -- links, ticks and notes ---------------------------------------------------------------------------------

    def _on_link(self, entry: Entry) -> list[Reply]:
        told = Note.unpack(entry.data())
        self.plans.peers_changed()
        replies: list[Reply] = []
        for link in entry.links:
            if told.code == LINK_UP:
                replies += self._welcome(entry, self._peers.up(link, told.data, entry.stamp_ns))
            else:
                self._settle(link, told.data)
                self._peers.down(link)
                self._said.pop(link, None)
                self._from_peers.gone(link)
                self._guard.gone(link)
                for pending in self._to_peers.gone(link):
                    replies += self._tell(entry, pending, CommandReply.NO_PEER, "the peer has gone")
        return [*replies, self._links(entry.stamp_ns)]

    def _settle(self, link: int, counts: dict[str, Any]) -> None:
        """What became of all that was sent to a peer that has gone, as its link counted it."""
        peer = self._peers.get(link)
        if peer is None or not isinstance(delivered := counts.get("sent_messages"), int):
            return
        row = f"{link} {peer.address}"
        self.ledger.count(PEERS, row, "sent", peer.sent)
        self.ledger.count(PEERS, row, "delivered", delivered)
        dropped = sum(counts.get("dropped", {}).values())
        gone = peer.sent - delivered - dropped  # sent while the link was closing: it took them no more
        for reason, number in (("queue", dropped), ("link_closed", gone)):
            if number > 0:
                self.ledger.drop(PEERS, row, reason, number)

    def _welcome(self, entry: Entry, peer: Peer) -> list[Reply]:
        """Plans and surfaces are said once: whoever comes later gets the last of each, as a late subscriber of a
        transient-local topic does."""
        replies: list[Reply] = []
        for topic, last in self._latest.items():
            stream = self._streams.to_igtl(topic, last.type)
            if stream and stream.latched and stream.conversion.igtl_type not in _SPECIAL:
                try:
                    out = self._outbound(last, stream, stream.conversion, ToIgtl(stream.lengths))
                    replies += self._to(entry, [peer], [out])
                except (ConversionError, WireError) as error:
                    replies.append(note(Level.ERROR, "conversion", f"not sent: {error}", topic))
        return replies + self._each(entry, self._tf.static(), lambda out: self._to(entry, [peer], [out]))

    def _links(self, now_ns: int) -> Reply:
        """Who is connected, as ROS is told."""
        header = RosHeader(now_ns, self.config.base_frame)
        statuses = tuple(peer.status() for peer in self._peers.all())
        return self._published(LINKS_TOPIC, LinkStatusList(header, statuses), now_ns)

    def _on_edge_note(self, entry: Entry) -> list[Reply]:
        told = Note.unpack(entry.data())
        if told.code == TICK:
            return self._on_tick(entry)
        if told.code == LISTENED:
            return self._make(told.stream)
        if step := ClockStep.of(entry):
            self._guard.clock_stepped(step.ahead_ns)
        self.ledger.count("edges", told.stream, told.code)
        return []

    def _make(self, topic: str) -> list[Reply]:
        """The last message of a latched topic, for the first who listens to it."""
        entry, row, content, to = self._unmade.pop(topic, (None, None, None, None))
        if entry is None or row is None or to is None:
            return []
        try:
            messages = _made(row, content, to)
        except ConversionError as error:
            text = f"not published as {row.message.TYPE}: {error}"
            return [note(Level.ERROR, "conversion", text, entry.channel, entry.links)]
        return [self._published(topic, message, to.stamp_ns) for message in messages]

    def _on_tick(self, entry: Entry) -> list[Reply]:
        """Do what is due: give up commands that nobody answered, ping peers that want to be."""
        now_ns = entry.stamp_ns
        replies: list[Reply] = []
        text = "no reply in time"
        for pending in self._from_peers.overdue(now_ns):
            replies += self._reply(entry, pending, CommandReply.FAIL, f"{text} from ROS")
            said = f"command {pending.command_id} ({pending.name!r}) of a peer: {text} from ROS"
            replies.append(note(Level.WARN, "command_timeout", said, f"COMMAND/{pending.device}", (pending.link,)))
        for pending in self._to_peers.overdue(now_ns):
            replies += self._tell(entry, pending, CommandReply.TIMEOUT, text)
            said = f"command {pending.command_id} ({pending.name!r}): {text} from the peer"
            replies.append(note(Level.WARN, "command_timeout", said, f"COMMAND/{pending.device}", (pending.link,)))
        for peer in list(self._pinged()):
            if peer.said_ns + peer.profile.ping_ns <= now_ns:
                replies += self._to(entry, [peer], [Outbound("GET_STATUS", "", Nothing(), now_ns)])
        return replies

    def _news(self) -> list[Reply]:
        """Notes of the streams that this entry opened."""
        if not self._streams.news:
            return []
        news, self._streams.news = self._streams.news, []
        return [note(Level.INFO, "stream", f"{stream} goes {text}", stream) for stream, text in news]

    def _once(self, entry: Entry, level: Level, code: str, text: str, about: str, link: int = 0) -> list[Reply]:
        """A note, but only the first of its kind about this (from this link): the log is for what is new."""
        said = self._said.setdefault(link, set())
        if (code, about) in said or len(said) >= MAX_SAID:
            return []
        said.add((code, about))
        return [note(level, code, text, entry.channel, entry.links)]

    def _warnings(self, warnings: list[tuple[str, str]], entry: Entry) -> list[Reply]:
        """Notes for what a conversion had to bend, once for each stream and cause."""
        return [reply for code, text in warnings for reply in self._once(entry, Level.WARN, code, text, entry.channel)]


def _found(entry: Entry, finding: Finding) -> Reply:
    """The note of what the guard found."""
    level, code, text = finding
    return note(level, code, text, entry.channel, entry.links)


def _reason(error: ConversionError | WireError) -> str:
    """What the ledger calls a message that could not be converted."""
    return error.code if isinstance(error, ConversionError) else ConversionError.code


def _place_of(content: object) -> Place | None:
    """The translation of a single pose, in whatever unit."""
    match content:
        case Transform():
            x, y, z = content.wire_matrix[9:]
        case Position():
            x, y, z = content.position
        case TransformStamped():
            x, y, z = content.translation
        case PoseStamped():
            x, y, z = content.pose[:3]
        case _:
            return None
    return x, y, z


def _made(row: RosRow, content: object, to: ToRos) -> Sequence[RosMessage]:
    """What a row makes of a content; other rows may look at it.  Raises ConversionError."""
    converted = row.convert(content, to)
    messages = converted if isinstance(converted, list) else [converted]
    to.made.update((message.TYPE, message) for message in messages)
    return messages


@lru_cache(maxsize=1_024)  # asked for every message
def _is_kept(igtl_type: str) -> bool:
    return igtl_type in _KEPT_TYPES or split_query(igtl_type) is not None


def _has_igtl(replies: Iterable[Reply]) -> bool:
    return any(reply.kind is Kind.IGTL_OUT for reply in replies)


#: Types that are more than a content: who asked, and who has to answer.
_SPECIAL: dict[str, Callable[[Gateway, Entry, ToIgtlStream, Outgoing], list[Reply]]] = {
    "COMMAND": Gateway._send_command,
    "RTS_COMMAND": Gateway._send_reply,
}
