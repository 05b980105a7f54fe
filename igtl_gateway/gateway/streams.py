"""The streams of a session: everything that the conversion of a message needs, resolved once for each stream.

Names are assigned in the order of appearance.  A second device with the same topic, or a second topic with the same
device, gets a hash added to its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import IN_TOPIC, Config, ToIgtlRow, ToRosRow, device_of_topic
from igtl_gateway.convert.arms import arms_row
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.names import frames_of_name, name_hash, short_device_name, topic_token
from igtl_gateway.convert.table import ConversionToIgtl, ConversionToRos, Role, row_to_igtl, rows_to_ros
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.naming import NAME_SHARED, FrameNames
from igtl_gateway.gateway.outcome import Finding

#: Kinds of topics: of messages without a conversion, and of metadata beside a standard message.
RAW, METADATA = "raw", "metadata"

_TF = "tf"

#: Maximum number of assigned device names: commands and queries from ROS may contain any name.
MAX_NAMES = 10_000


@dataclass(frozen=True, slots=True)
class ToIgtlStream:
    """A bridged ROS topic.

    Attributes:
        row, conversion: its row of the configuration and of the conversion table.
        max_age_s: maximum age of its messages, s; 0: no limit.
        device, full_name: device name on the wire, and before it was shortened.
        lengths: units.
        latched: whether late joiners get the latest message.
        row_metadata: metadata of the row of the configuration.
        of_robot: a CRTK topic: a stamp of 0 means that the data are not valid.
    """

    row: ToIgtlRow
    conversion: ConversionToIgtl
    max_age_s: float
    device: str
    full_name: str
    lengths: LengthUnits
    latched: bool
    row_metadata: tuple[MetadataItem, ...]
    of_robot: bool = False


@dataclass(frozen=True, slots=True)
class ToRosStream:
    """A bridged OpenIGTLink stream.

    Attributes:
        row: its row of the configuration.
        max_age_s: maximum age of its messages, s; 0: no limit.
        kinds: the selected ROS messages; empty: the default ones.
        outputs: rows of the conversion table, with their topics.
        raw_topic, metadata_topic: topics for messages without a conversion and for metadata.
        frame_id, child_frame_id: default frames, unless the metadata name others.
        lengths: units.
    """

    row: ToRosRow
    max_age_s: float
    kinds: tuple[str, ...]
    outputs: tuple[tuple[ConversionToRos, str], ...]
    raw_topic: str
    metadata_topic: str
    frame_id: str
    child_frame_id: str
    lengths: LengthUnits


def is_of_arm(config: Config, row: ToRosRow, device: str) -> bool:
    """Return whether a device is one of a CRTK arm, with the unit of its arm and not that of a row of the user."""
    return bool(config.all_arms) and row not in config.to_ros and arms_row(config.all_arms, device) is not None


class Streams:
    """All streams of a session, in both directions."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._to_igtl: dict[tuple[str, str], ToIgtlStream | None] = {}
        self._to_ros: dict[tuple[str, str], ToRosStream] = {}
        self._tokens: dict[str, str] = {}  # topic token → its device
        self._topics: dict[str, str] = {}  # topic → the device whose messages it has
        self._sources: dict[str, str] = {}  # stream to peers → its topic
        self._frames = FrameNames(config.naming) if config.naming else None
        self._news: list[Finding] = []
        self._devices: dict[str, str] = {}  # short device name → its full name
        self._qos: dict[str, Qos] = {}
        self._ages_s: dict[str, float] = {}  # topic of one device → maximum age of its messages
        self.opened: list[tuple[str, str]] = []  # (stream, destination) of new streams that are not reported yet
        if config.naming:
            for frames in config.tf_out:
                request = frames.request()
                self._sources.setdefault(f"{request.type}/{self.device(request.device)}", f"--tf-out {request.text()}")

    def news(self) -> list[Finding]:
        """Return the findings about new streams and their names since the last call."""
        opened, self.opened = self.opened, []
        findings = [Finding(Level.INFO, "stream", f"{stream} goes {text}", stream) for stream, text in opened]
        for names in (self._news, self._frames.news if self._frames else self._news):
            findings += names
            names.clear()
        return findings

    @property
    def has_news(self) -> bool:
        """Whether there are any; asked for each message."""
        return bool(self.opened or self._news or (self._frames and self._frames.news))

    def qos(self, topic: str) -> Qos | None:
        """Return the QoS of a topic that the gateway publishes."""
        return self._qos.get(topic)

    def max_age_s(self, topic: str) -> float:
        """Return the maximum age of the messages on a topic that the gateway publishes, s; 0: no limit."""
        return self._ages_s.get(topic, 0.0)

    def advertise(self, topic: str, qos: Qos) -> None:
        """Set the QoS of a published topic that belongs to no stream."""
        self._qos[topic] = qos

    def change(self, config: Config) -> None:
        """Use other settings of those that can change; streams with other outputs are opened again."""
        self._config = config
        for topic, sent in self._to_igtl.items():
            if sent:
                self._to_igtl[topic] = replace(sent, max_age_s=config.max_age_of(sent.row))
        for (igtl_type, device), shown in self._to_ros.items():
            if config.kinds_of(shown.row) == shown.kinds:
                self._to_ros[igtl_type, device] = replace(shown, max_age_s=config.max_age_of(shown.row))
                self._ages_s.update(
                    dict.fromkeys(
                        self._ages_s.keys() & {topic for _, topic in shown.outputs}, config.max_age_of(shown.row)
                    )
                )
            else:
                self._to_ros[igtl_type, device] = self._resolve_device(igtl_type, device)

    # -- OpenIGTLink → ROS --------------------------------------------------------------------------------------

    def to_ros(self, igtl_type: str, device: str) -> ToRosStream | None:
        """Return the stream of a device, resolved at its first message; None above the limit of streams."""
        key = (igtl_type, device)
        stream = self._to_ros.get(key)
        if stream is None and len(self._to_ros) < self._config.max_streams:
            stream = self._to_ros[key] = self._resolve_device(igtl_type, device)
        return stream

    def foreseen(self, igtl_type: str, device: str) -> ToRosStream:
        """Return the stream that ``to_ros`` would, and change nothing; from any thread.

        It may be another one by then: who uses what was made with it compares first.
        """
        return self._to_ros.get((igtl_type, device)) or self._resolve_device(igtl_type, device, keep=False)

    def _resolve_device(self, igtl_type: str, device: str, *, keep: bool = True) -> ToRosStream:
        config = self._config
        row = config.row_to_ros(igtl_type, device)
        token = self._token(device, keep=keep)

        def topic_of(kind: str) -> str:
            template = row.topic if "{kind}" in row.topic or kind not in (RAW, METADATA) else IN_TOPIC
            return template.format(device=token, kind=kind, type=topic_token(igtl_type.lower()))

        parent, child = self.frames(device, config.base_frame, keep=keep)
        outputs = []
        for conversion in self._chosen(row, rows_to_ros(igtl_type)):
            topic = conversion.topic or topic_of(conversion.kind)
            outputs.append((conversion, topic))
            if keep:
                self._qos.setdefault(topic, row.qos or conversion.qos)
            if not conversion.topic:  # /tf has frames of many devices
                self._ages_s[topic] = config.max_age_of(row)
            if keep and not conversion.topic:
                self._share_topic(topic, igtl_type, device)
        poses = any(conversion.kind == "transform" for conversion in rows_to_ros(igtl_type))
        topics = ", ".join(dict.fromkeys(topic for _, topic in outputs)) or topic_of(RAW)
        if keep:
            self.opened.append((f"{igtl_type}/{device}", f"to {topics}"))
        return ToRosStream(
            row,
            config.max_age_of(row),
            config.kinds_of(row),
            tuple(outputs),
            topic_of(RAW),
            topic_of(METADATA),
            row.frame_id or (parent if poses else config.base_frame),
            row.child_frame_id or child,
            config.lengths(row),
        )

    def frames(self, name: str, base_frame: str, *, keep: bool = True) -> tuple[str, str]:
        """Return (parent, child) frame of a device, or of a tool in tracking data; ``keep``: it has it from now on."""
        if self._frames:
            return self._frames.of(name, base_frame, keep=keep)
        return frames_of_name(name, base_frame, self._config.naming)

    def _share_topic(self, topic: str, igtl_type: str, device: str) -> None:
        """Note that a topic without ``{device}`` has the messages of several devices."""
        owner = self._topics.setdefault(topic, device)
        if owner != device and self._config.naming:
            text = f"{topic} has the messages of {owner!r} and {device!r}: the topic of their row has no {{device}}"
            self._news.append(Finding(Level.WARN, NAME_SHARED, text, f"{igtl_type}/{device}"))

    def _chosen(self, row: ToRosRow, conversions: Sequence[ConversionToRos]) -> Sequence[ConversionToRos]:
        """Return the rows of the conversion table for a stream with this row of the configuration."""
        kinds = self._config.kinds_of(row)
        added = {kind.removeprefix("+") for kind in kinds if kind.startswith("+")}
        if kinds and len(added) < len(kinds):
            return [one for one in conversions if one.kind in added.union(kinds)]
        wanted = [one for one in conversions if one.role is not Role.ON_REQUEST or one.kind in added]
        if not self._config.publish_tf:
            wanted = [one for one in wanted if one.kind != _TF]
        if "{kind}" in row.topic:
            return wanted
        # a topic has one type: the standard one if there is one
        return [one for one in wanted if one.role is Role.STANDARD] or wanted[:1]

    def _token(self, device: str, *, keep: bool = True) -> str:
        """Return the topic token of a device, with a hash added if another device has that token."""
        token = topic_token(device)
        while self._tokens.get(token, device) != device:
            token = f"{token}_{name_hash(device)}"
        if keep:
            self._tokens[token] = device
        return token

    # -- ROS → OpenIGTLink --------------------------------------------------------------------------------------

    def rows(self, topic: str, ros_type: str) -> tuple[ToIgtlRow | None, ConversionToIgtl | None]:
        """Return the rows of the configuration and of the conversion table for a topic."""
        row = self._config.row_to_igtl(topic)
        return row, row_to_igtl(ros_type, row.type) if row else None

    def to_igtl(self, topic: str, ros_type: str) -> ToIgtlStream | None:
        """Return the stream of a topic, resolved at its first message; None if the topic is not bridged.

        Also None above the limit of streams: ``is_over_limit`` distinguishes the two.
        """
        key = (topic, ros_type)
        if key in self._to_igtl:
            return self._to_igtl[key]
        if len(self._to_igtl) >= self._config.max_streams:
            return None
        stream = self._to_igtl[key] = self._resolve_topic(topic, ros_type)
        return stream

    def raw_max_age_s(self, topic: str) -> float | None:
        """Return the maximum age of the RawMessages of a topic, s; 0: no limit; None: the topic is not bridged."""
        row = self._config.row_to_igtl(topic)
        return self._config.max_age_of(row) if row else None

    def is_over_limit(self, topic: str, ros_type: str) -> bool:
        """Return whether only the limit of streams keeps a topic from being bridged."""
        return (topic, ros_type) not in self._to_igtl and self.rows(topic, ros_type)[1] is not None

    def _resolve_topic(self, topic: str, ros_type: str) -> ToIgtlStream | None:
        row, conversion = self.rows(topic, ros_type)
        if not row or not conversion:
            return None
        kinds = {other.kind for other in rows_to_ros(conversion.igtl_type)}
        last = topic.rpartition("/")[2]
        full_name = row.device or device_of_topic(topic, last if last in kinds else "")
        device = self.device(full_name)
        if self._config.naming:
            full_name, device = self._own_name(topic, row, conversion.igtl_type, full_name, device)
        name = f"{conversion.igtl_type}/{device}"
        self.opened.append((topic, f"to {name}" + (f" (for {full_name})" if device != full_name else "")))
        latched = (row.qos or conversion.qos).latched
        metadata = tuple(MetadataItem(key, 0, value) for key, value in row.metadata)
        max_age_s, lengths = self._config.max_age_of(row), self._config.lengths(row)
        of_robot = row.topic == topic and row not in self._config.to_igtl  # a row that the CRTK profile has made
        return ToIgtlStream(row, conversion, max_age_s, device, full_name, lengths, latched, metadata, of_robot)

    def _own_name(self, topic: str, row: ToIgtlRow, igtl_type: str, full_name: str, device: str) -> tuple[str, str]:
        """Return full name and device of a topic; if another topic is sent as this device, one with a hash.

        A name that the configuration gives to several topics is kept, and noted.
        """
        while (owner := self._sources.setdefault(f"{igtl_type}/{device}", topic)) != topic:
            if row.device:
                text = f"{owner} and {topic} are both sent as {igtl_type}/{device}: receivers take them as one stream"
                self._news.append(Finding(Level.WARN, NAME_SHARED, text, topic))
                break
            full_name = f"{full_name}_{name_hash(topic)}"
            device = self.device(full_name)
        return full_name, device

    def is_sent(self, stream: str) -> bool:
        """Return whether a stream to peers, TYPE/device, is that of a topic or of frames of the tf tree."""
        return stream in self._sources

    def device(self, full_name: str) -> str:
        """Return the device name of at most 20 bytes for a full name."""
        device = short_device_name(full_name)
        while self._devices.get(device, full_name) != full_name:
            device = short_device_name(f"{full_name[:8]}_{name_hash(device + full_name)}_{full_name}")
        if len(self._devices) < MAX_NAMES:
            self._devices[device] = full_name
        return device
