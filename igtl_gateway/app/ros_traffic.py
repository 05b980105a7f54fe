"""The ROS side of a bridge: what comes from the graph and goes to it, over DDS or Zenoh."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.commands import CommandService
from igtl_gateway.app.hub import Hub
from igtl_gateway.app.mark_service import WHO
from igtl_gateway.app.recording import BridgeRecording, serve_recording
from igtl_gateway.app.ros_log import NOTED, RosLog
from igtl_gateway.app.subscriptions import RECORDED, Subscriptions
from igtl_gateway.app.video import VideoCodecs
from igtl_gateway.base.addons import part_of
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import COMMAND_QOS, SET_POINT_QOS
from igtl_gateway.config.settings import DEFAULT_LATCHED_MIB
from igtl_gateway.convert.arms import arms_row
from igtl_gateway.convert.common_msgs import CompressedImage, TFMessage
from igtl_gateway.convert.crtk import NAMES, namespaces, row_of
from igtl_gateway.convert.igtl_msgs import CommandReply, LinkStatusList
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.gateway import LINKS_TOPIC, LISTENED, Core
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.orders import Order, Unwritten
from igtl_gateway.gateway.to_igtl.tf_out import TF_QOS
from igtl_gateway.native.passage import Passage

#: Topic of the node for marks: a line of text each.
MARKS = "mark"
#: Types of messages to ROS that the bridge itself reads: replies for the service, video frames for the decoder.
_OWN_USE = frozenset({CommandReply.TYPE, CompressedImage.TYPE})
#: Commands to robots in one message, and arms, at most.
_WRITTEN, _NAMESPACES = 4_096, 1_000


class RosTraffic:
    """A part: the node with its topics, log, parameters and services, and the parts that stand on it.

    Args:
        options: of the bridge.
        gateway, hub: what is published comes from the one, what is received goes to the other.
        subscriptions: which topics are received.
        host: where the node is; None: a node of this bridge only.
        passage: the native passage, whose streams the topics may have; None: there is none.
        builds_all: whether outputs without a subscriber are built, too.

    Attributes:
        side: the edge.
        video: the codecs; None: images are neither encoded nor decoded.
        commands: the service for commands.
        recording: whose services the node offers; None: there is none.
        mark: makes a mark, see ``Bridge.mark``; None: there is no topic for marks.
    """

    def __init__(
        self,
        options: BridgeOptions,
        gateway: Core,
        hub: Hub,
        subscriptions: Subscriptions,
        host: NodeHost | None,
        passage: Passage | None,
        *,
        builds_all: bool,
    ) -> None:
        self._options = options
        self._gateway = gateway
        self._hub = hub
        self._subscriptions = subscriptions
        self._builds_all = builds_all
        self.side = self._make_side(host, passage)
        self.commands = CommandService(self.side, self._send_command, gateway.config.command_timeout_s, hub.note)
        self.recording: BridgeRecording | None = None
        self.mark: Callable[[MarkNote], None] | None = None
        self._log = RosLog(self.side.log)
        self._written: deque[bytes] = deque(maxlen=_WRITTEN)  # commands to robots, whose outputs have not come yet
        self._namespaces: set[str] = set()  # of the arms whose commands are expected
        gateway.write = self._write if gateway.config.all_arms else None
        self.video: VideoCodecs | None = None
        if options.video:
            self.video = VideoCodecs(options.video, gateway.config, hub, self.side)
            subscriptions.encoded = self.video.subscription
        if not builds_all:
            gateway.has_subscriber = self._has_subscriber

    def _make_side(self, host: NodeHost | None, passage: Passage | None) -> RosSide:
        """Return the edge over the middleware of the options."""
        options, note, wanted = self._options, self._hub.note, self._wanted
        latched_mib = self._gateway.config.latched_mib or DEFAULT_LATCHED_MIB
        if options.zenoh is None:
            return RosEdge(
                node_name=options.node_name,
                on_message=self._received,
                wants=wanted,
                on_note=note,
                on_listener=self._on_first_subscriber,
                host=host,
                passage=passage,
                latched_mib=latched_mib,
            )
        traffic = part_of("zenoh", "traffic:Traffic")
        side: RosSide = part_of("zenoh", "edge:ZenohEdge")(
            node_name=options.node_name,
            on_message=self._received,
            wants=wanted,
            on_note=note,
            on_listener=self._on_first_subscriber,
            endpoint=options.zenoh,
            site=options.site.name,
            traffic=traffic(options.site.classes, options.site.bytes_per_s) if options.site.name else None,
            latched_mib=latched_mib,
        )
        return side

    def start(self) -> None:
        """Join the graph; advertise the topics and services that exist from the start.

        Raises RosError and ConfigError; see ``RosEdge.start``.
        """
        self.side.start()
        self.side.advertise(LINKS_TOPIC, LinkStatusList.TYPE, self._gateway.qos(LINKS_TOPIC) or RECORDED)
        if self._gateway.config.publish_tf:
            self.side.advertise("/tf", TFMessage.TYPE, TF_QOS["/tf"])
        if self.recording and self.recording.recorder:
            serve_recording(self.side, self.recording.recorder)
        if self.mark:
            self.side.subscribe(self._marks_topic, String.TYPE, RECORDED)
        for device in self._gateway.config.allow_in:
            self._expect(device)  # a glob is the name of no device

    def _wanted(self, topic: str, ros_type: str) -> Qos | None:
        """Return the QoS of a subscription to a topic; for one of a robot, prepare to write commands to it."""
        device = topic.removeprefix("/")
        if self._gateway.write and row_of(device) and (base := namespaces(device)[0]) not in self._namespaces:
            if len(self._namespaces) < _NAMESPACES:
                self._namespaces.add(base)
                for name in NAMES:
                    self._expect(f"{base[1:]}/{name.name}")
        return self._subscriptions.wanted(topic, ros_type)

    def _expect(self, device: str) -> None:
        """Make the publisher of a command that peers may send, before the first one, which does not wait for it."""
        config, name = self._gateway.config, row_of(device)
        arms = arms_row(config.all_arms, device)
        if arms and name and name.motion and config.allows_in(device):
            qos = SET_POINT_QOS if name.streamed else COMMAND_QOS
            self.side.expect_orders(f"/{device}", name.ros_type, qos, round(arms.max_age_s * NS_PER_S))

    def _write(self, order: Order) -> Unwritten | None:
        """Write a command to a robot at once, or never."""
        refused = self.side.write(order)
        if refused is None:
            self._written.append(order.cdr)
        return refused

    def stop(self) -> None:
        """Publish what the log has left, and leave the graph."""
        self._log.flush()
        self.side.stop()

    def publish(self, entry: Entry) -> None:
        """Publish an output, unless it is a command that was written, and pass it to the parts that read it."""
        if self._written and entry.payload[0] is self._written[0]:
            self._written.popleft()
        elif not (self._builds_all and self.side.count_if_unsubscribed(entry.channel)):
            qos = self._gateway.qos(entry.channel) or RECORDED
            self.side.publish(entry.channel, entry.type, entry.data(), qos, self._gateway.until_ns(entry))
        self.commands.on_entry(entry)
        if self.video:
            self.video.decode(entry)

    def log(self, entry: Entry) -> None:
        """Keep an entry for the log of the node, if it is a note."""
        if entry.kind in NOTED:
            self._log.add(entry)

    def each_second(self) -> None:
        """Publish what the log has."""
        self._log.flush(self._hub.now_ns())

    def _received(self, topic: str, ros_type: str, cdr: bytes, source_ns: int) -> None:
        """Pass a message of the graph to the encoder if its topic is sent as VIDEO, otherwise to the hub.

        Each string on the topic of marks is a mark.
        """
        if self.mark and topic == self._marks_topic and ros_type == String.TYPE:
            self._take_mark(cdr, self.mark)
            return
        if not (self.video and self.video.encode(topic, ros_type, cdr, source_ns)):
            self._hub.ros(topic, ros_type, cdr, source_ns)

    @property
    def _marks_topic(self) -> str:
        return f"{self.side.full_name}/{MARKS}"

    def _take_mark(self, cdr: bytes, mark: Callable[[MarkNote], None]) -> None:
        try:
            mark(MarkNote.parse(String.unpack(cdr).data, WHO))
        except GatewayError as error:
            self._hub.note(Note(Level.WARN, "mark_refused", str(error), self._marks_topic))

    def _send_command(self, topic: str, ros_type: str, cdr: bytes) -> None:
        self._hub.ros(topic, ros_type, cdr, 0)

    def _has_subscriber(self, topic: str, ros_type: str) -> bool:
        """Return whether a topic has a subscriber in ROS, or the bridge itself reads the type."""
        return ros_type in _OWN_USE or self._is_command(topic) or self.side.has_subscriber(topic)

    def _is_command(self, topic: str) -> bool:
        """Return whether a topic has commands to a robot: what is not written is refused, with a note."""
        name = row_of(topic.removeprefix("/")) if self._gateway.write else None
        return name is not None and name.motion is not None

    def _on_first_subscriber(self, topic: str) -> None:
        """Report the first subscriber of a topic: the gateway then builds the latched message of the topic."""
        if not self._builds_all:
            self._hub.note(Note(Level.INFO, LISTENED, f"{topic} has a subscriber", topic))
