"""Routes a decoded message to its stream: topics, frames, stamp and units; each child of a BIND to its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from igtl_gateway.base.errors import ConversionError, MalformedBody, WireError
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import ticks_to_ns
from igtl_gateway.config.configuration import COMMAND_QOS, Config
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.robots import JOINT_NAMES, joint_names
from igtl_gateway.convert.tracking import MAX_TOOLS
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.command_guard import Checked, CommandGuard, Refused
from igtl_gateway.gateway.guard import STALE, Guard, GuardedStream, check_stamp, translation_of
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.fates import CONVERTED, REFUSED_DEVICE, UNSUBSCRIBED
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.metadata import RestoredMetadata
from igtl_gateway.gateway.naming import cut_name
from igtl_gateway.gateway.orders import UNHEARD
from igtl_gateway.gateway.outcome import Finding, Item, Outcome, conversion_failure
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.gateway.streams import Streams, ToRosStream, is_of_arm
from igtl_gateway.gateway.to_igtl.sender import unit_finding
from igtl_gateway.gateway.to_ros.convert import Converter
from igtl_gateway.gateway.to_ros.routed import child_message, context_of
from igtl_gateway.gateway.to_ros.volumes import Volumes
from igtl_gateway.wire import Message
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.query import is_dialogue
from igtl_gateway.wire.registry import read_child
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video


class RosOrigin(NamedTuple):
    """What the fast path needs to compile the stream of a device: a message, its stream and its context."""

    message: Message
    stream: ToRosStream
    to: ToRosContext
    watched: GuardedStream | None


class Router:
    """Routes decoded messages to their streams."""

    def __init__(
        self,
        config: Config,
        streams: Streams,
        guard: Guard,
        volumes: Volumes,
        converter: Converter,
        robots: CommandGuard,
        peers: Peers,
    ) -> None:
        self._config = config
        self._streams = streams
        self._guard = guard
        self._volumes = volumes
        self._converter = converter
        self._robots = robots
        self._peers = peers

    def route(self, entry: Entry, message: Message, restored: RestoredMetadata) -> Outcome:
        """Return the outcome of a decoded message for ROS; ``restored`` has the contents of its metadata."""
        device = restored.device_name
        if not self._robots.is_command(device):
            return self._routed(entry, message, restored)
        stamp_ns = restored.stamp_ns or ticks_to_ns(message.ticks)
        try:
            unit = self._arm_unit(entry.links[0])
            checked = self._robots.check(
                entry,
                message.content,
                device,
                stamp_ns,
                restored.frame_id,
                self._guard,
                unit,
                joint_names(restored.items),
            )
        except Refused as error:
            return self._refused(entry, device, error)
        if checked.joints:
            message, restored = _in_order(checked, message, restored)
        outcome = self._routed(entry, message, restored, checked.frame_id)
        if outcome.fate == CONVERTED:
            outputs = [item for item in outcome.items if isinstance(item, Output)]
            try:
                self._robots.order(checked, outputs, self._streams.qos(f"/{device}") or COMMAND_QOS)
            except Refused as error:
                found = [item for item in outcome.items if isinstance(item, Finding)]
                return self._refused(entry, device, error, found)
            self._robots.published(checked)
        elif outcome.fate == UNSUBSCRIBED:
            self._robots.refused(device, UNHEARD)
        outcome.origin = None  # each command passes the guard: no compiled stream has one
        return outcome

    def _refused(self, entry: Entry, device: str, error: Refused, found: Sequence[Item] = ()) -> Outcome:
        """Return the outcome of a command that is refused; ``found``: further findings about it."""
        self._robots.refused(device, error.code)
        facts = {REFUSED_DEVICE: device}
        finding = Finding(Level.WARN, error.code, str(error), entry.channel, entry.links, data=facts)
        return Outcome([*found, finding], error.code)

    def _routed(
        self, entry: Entry, message: Message, restored: RestoredMetadata, frame_id: str | None = None
    ) -> Outcome:
        """Return the outcome of a message that may be routed; ``frame_id``: of a command to a robot."""
        igtl_type, link = visible(message.type), entry.links[0]
        stream = self._streams.to_ros(igtl_type, restored.device_name)
        if stream is None:
            text = (
                f"more than {counted(self._config.max_streams, 'stream')}: {entry.channel} is recorded, not published"
            )
            finding = Finding(Level.WARN, "too_many_streams", text, entry.channel, entry.links, subject="", by=link)
            return Outcome([finding], "too_many_streams")
        source_ns = restored.stamp_ns or ticks_to_ns(message.ticks)
        if frame_id is None:
            frame_id = stream.row.frame_id or restored.frame_id or self._frame_of(message, link) or stream.frame_id
        stamp_ns = self._config.pick_stamp(stream.row, source_ns, entry.stamp_ns)
        to = context_of(self._config, self._streams, stream, message, restored, frame_id, link, stamp_ns)
        found: list[Item] = []
        unit = self._arm_unit(link)
        if unit and unit != to.lengths.igtl and self._is_pose_of_arm(message, stream, restored.device_name):
            to = replace(to, lengths=LengthUnits(to.lengths.ros, unit))
            if peer := self._peers.get(link):
                found.append(unit_finding(peer))
        name = (
            entry.channel if entry.payload else f"{igtl_type}/{restored.device_name}"
        )  # for a child of a BIND: its own stream
        if watched := self._guard.of(link, name, stream.max_age_s):
            withheld, late = check_stamp(entry, watched, source_ns, to.stamp_ns, translation_of(message.content))
            found += late
            if withheld:
                return Outcome(found, STALE)
        try:
            outcome = self._converted(entry, message, restored, stream, to)
            outcome.items += self._names(entry, message, restored, name, stream)
        except (ConversionError, WireError) as error:
            fate = error.code if isinstance(error, ConversionError) else ConversionError.code
            outcome = Outcome([conversion_failure(error, "not published", entry)], fate)
        outcome.items += found
        outcome.origin = RosOrigin(message, stream, to, watched)
        return outcome

    def _arm_unit(self, link: int) -> str:
        """Return the unit in which a peer sends arms; "": that of their row."""
        peer = self._peers.get(link)
        return peer.profile.arm_unit if peer else ""

    def _is_pose_of_arm(self, message: Message, stream: ToRosStream, device: str) -> bool:
        return isinstance(message.content, Transform | Position) and is_of_arm(self._config, stream.row, device)

    def _frame_of(self, message: Message, link: int) -> str:
        """Return the frame that the program of a peer has in the device names of its pictures; "" if there is none."""
        if not self._config.naming or not isinstance(message.content, Image | Video):
            return ""
        peer = self._peers.get(link)
        if peer is None:
            return ""
        keys = (item.key for item in message.metadata)
        return peer.profile.frame_of_picture(visible(message.device_name), keys, self._config.naming)

    def _names(
        self, entry: Entry, message: Message, restored: RestoredMetadata, name: str, stream: ToRosStream
    ) -> list[Finding]:
        """Return the findings about the name of a stream: another peer sends it, or it may be cut."""
        shared = self._converter.shared
        if shared is None or is_dialogue(visible(message.type)):
            return []
        known = restored.states_name or restored.device_name != visible(message.device_name)
        cut = cut_name(name, message.device_name, known=known) if entry.payload else []
        if shared.knows(name, entry.links[0]):
            return cut
        topics = tuple(dict.fromkeys(topic for row, topic in stream.outputs if not row.topic))
        return [*cut, *shared.stream(name, entry.links[0], topics)]

    def _converted(
        self, entry: Entry, message: Message, restored: RestoredMetadata, stream: ToRosStream, to: ToRosContext
    ) -> Outcome:
        """Convert a message that is not too old.  Raises ConversionError and WireError."""
        content = message.content
        if isinstance(content, Bind):
            return Outcome(self._split_bind(entry, message, content, restored, stream, to), CONVERTED)
        if isinstance(content, Image):
            foreseen = self._converter.foreseen(content)
            whole = self._volumes.assembled(restored.device_name, content, entry.seq, foreseen)
            if whole is None:
                return Outcome(fate="part_of_volume")
            content = whole
        return self._converter.convert(entry, message, content, stream, to)

    def _split_bind(
        self,
        entry: Entry,
        message: Message,
        bind: Bind,
        restored: RestoredMetadata,
        stream: ToRosStream,
        to: ToRosContext,
    ) -> list[Item]:
        """Route a BIND as a whole, then each child as a separate message."""
        items = self._converter.publish(entry, bind, to, stream, stream.outputs) if stream.outputs else []
        alone, tools = replace(entry, payload=()), 0
        for child, known in zip(bind.children, self._converter.children(bind), strict=True):
            try:
                if isinstance(known, WireError):
                    raise known
                inner, its = child_message(child, known or read_child(child), message, restored)
                if isinstance(inner.content, TrackingData | QuaternionTrackingData):
                    tools += len(inner.content.elements)
                if tools > MAX_TOOLS:  # each has a frame, with the sequence lock
                    raise MalformedBody("BIND content", counted(tools, "tool"), f"at most {MAX_TOOLS} in all children")
            except WireError as error:
                items.append(
                    conversion_failure(
                        error, f"child {visible(child.name)!r} of {entry.channel} rejected", entry, error.code
                    )
                )
                continue
            items += self.route(alone, inner, its).items
        return items


def _in_order(checked: Checked, message: Message, restored: RestoredMetadata) -> tuple[Message, RestoredMetadata]:
    """Return a command that names its joints with these, and their values, in the order of the arm."""
    assert isinstance(message.content, Sensor)  # the guard has refused all else
    content = replace(message.content, values=np.asarray(checked.point.values, ">f8"))
    named = MetadataItem(JOINT_NAMES, 0, ",".join(checked.joints))
    items = tuple(named if item.key == JOINT_NAMES else item for item in restored.items)
    return replace(message, content=content), replace(restored, items=items)
