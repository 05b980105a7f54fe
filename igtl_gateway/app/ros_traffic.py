"""The ROS side of a bridge: what comes from the graph and goes to it, over DDS or Zenoh."""

from __future__ import annotations

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
from igtl_gateway.config.settings import DEFAULT_LATCHED_MIB
from igtl_gateway.convert.common_msgs import CompressedImage, TFMessage
from igtl_gateway.convert.igtl_msgs import CommandReply, LinkStatusList
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.gateway import LINKS_TOPIC, LISTENED, Core
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.to_igtl.tf_out import TF_QOS
from igtl_gateway.native.passage import Passage

#: Topic of the node for marks: a line of text each.
MARKS = "mark"
#: Types of messages to ROS that the bridge itself reads: replies for the service, video frames for the decoder.
_OWN_USE = frozenset({CommandReply.TYPE, CompressedImage.TYPE})


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
        self.video: VideoCodecs | None = None
        if options.video:
            self.video = VideoCodecs(options.video, gateway.config, hub, self.side)
            subscriptions.encoded = self.video.subscription
        if not builds_all:
            gateway.has_subscriber = self._has_subscriber

    def _make_side(self, host: NodeHost | None, passage: Passage | None) -> RosSide:
        """Return the edge over the middleware of the options."""
        options, note, wanted = self._options, self._hub.note, self._subscriptions.wanted
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

    def stop(self) -> None:
        """Publish what the log has left, and leave the graph."""
        self._log.flush()
        self.side.stop()

    def publish(self, entry: Entry) -> None:
        """Publish an output, and pass it to the parts that read it."""
        if not (self._builds_all and self.side.count_if_unsubscribed(entry.channel)):
            qos = self._gateway.qos(entry.channel) or RECORDED
            self.side.publish(entry.channel, entry.type, entry.data(), qos)
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
        return ros_type in _OWN_USE or self.side.has_subscriber(topic)

    def _on_first_subscriber(self, topic: str) -> None:
        """Report the first subscriber of a topic: the gateway then builds the latched message of the topic."""
        if not self._builds_all:
            self._hub.note(Note(Level.INFO, LISTENED, f"{topic} has a subscriber", topic))
