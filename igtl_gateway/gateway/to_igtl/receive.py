"""Processes a ROS message for OpenIGTLink: route by topic, convert, guard, compose, deliver."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.base.quantities import counted
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.gateway.activity import INACTIVE, Activity
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.dialogue.commanding import Commands
from igtl_gateway.gateway.guard import STALE, Guard, check_stamp, translation_of
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import CONVERTED, RECORDED_ONLY
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding, Item, Outcome, conversion_failure, warning_findings
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.streams import Streams, ToIgtlStream
from igtl_gateway.gateway.to_igtl.beforehand import RosBeforehand
from igtl_gateway.gateway.to_igtl.composer import Composer
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.latest import Latest
from igtl_gateway.gateway.to_igtl.origin import IgtlOrigin
from igtl_gateway.gateway.to_igtl.raw import RawMessages
from igtl_gateway.gateway.to_igtl.tf_receive import TfReceiver
from igtl_gateway.gateway.to_igtl.tracking import Tracking

#: Code and fate of data that a robot marks as not valid.
NOT_VALID = "not_valid"


class RosReceiver:
    """Receives the messages of ROS."""

    def __init__(
        self,
        config: Config,
        peers: Peers,
        streams: Streams,
        guard: Guard,
        denied: Denials,
        beforehand: RosBeforehand,
        *,
        latest: Latest,
        composer: Composer,
        delivery: Delivery,
        tracking: Tracking,
        frames: TfReceiver,
        commands: Commands,
        activity: Activity,
    ) -> None:
        self._config = config
        self._peers = peers
        self._streams = streams
        self._guard = guard
        self._denied = denied
        self._beforehand = beforehand
        self._latest = latest
        self._composer = composer
        self._delivery = delivery
        self._tracking = tracking
        self._frames = frames
        self._commands = commands
        self._activity = activity
        self._raw = RawMessages(streams, peers, guard, denied, delivery)

    def take(self, entry: Entry) -> Outcome:
        """Process a message of any ROS topic."""
        active = self._activity.active
        if self._frames.takes(entry):
            return self._frames.take(entry) if active else self._refused(entry, self._frames.take(entry, sends=False))
        if self._raw.takes(entry):
            return self._raw.take(entry) if active else self._refused(entry, Outcome())
        topic = entry.channel
        stream = self._streams.to_igtl(topic, entry.type)
        if stream is None:
            return self._unrouted(entry)
        is_command = stream.conversion.igtl_type == "COMMAND"
        unsent = not is_command and not (active and self._peers)
        if not stream.max_age_s and not stream.of_robot:  # a message that is too old must not become the latest
            self._latest.entries[topic] = entry
            if unsent:
                return self._unsent(entry, [])
        to = ToIgtlContext(stream.lengths)
        found: list[Item] = []
        try:
            message, outgoing = self._beforehand.converted(entry, stream, to)
            if refusal := self._refusal(entry, stream, message, outgoing):
                return refusal
            watched = self._guard.of(0, topic, stream.max_age_s)
            if watched:
                own_ns = outgoing.stamp_ns or entry.source_ns
                shown_ns = self._config.pick_stamp(stream.row, own_ns, entry.stamp_ns)
                withheld, found = check_stamp(entry, watched, own_ns, shown_ns, translation_of(message))
                if withheld:
                    return Outcome(found, STALE)
            self._latest.entries[topic] = entry
            if unsent:
                return self._unsent(entry, found)
            if special := self._commands.sender_for(stream.conversion.igtl_type):
                items, origin = special(entry, stream, outgoing), None
            else:
                out = self._composer.compose(entry, stream, stream.conversion, outgoing, message)
                sends = chain([(self._addressed(outgoing), out)], self._tracking.due_after(entry, out))
                items = self._delivery.deliver_streams(entry, sends, stream.lengths)
                # the validity of a robot's data is checked on the full path only
                origin = None if stream.of_robot else IgtlOrigin(stream, out, watched)
        except (ConversionError, WireError) as error:
            fate = error.code if isinstance(error, ConversionError) else ConversionError.code
            return Outcome([conversion_failure(error, "not sent", entry), *found], fate)
        sent = any(isinstance(item, Output) and item.kind is Kind.IGTL_OUT for item in items)
        items += [*warning_findings(to.warnings, entry), *found]
        return Outcome(items, CONVERTED if sent else "not_wanted", origin=origin)

    def _refusal(
        self, entry: Entry, stream: ToIgtlStream, message: RosMessage, outgoing: ConvertedMessage
    ) -> Outcome | None:
        """Return the outcome of a message that must not be sent, whatever its age: denied, not active, not valid."""
        igtl_type = outgoing.igtl_type or stream.conversion.igtl_type
        if self._denied and self._denied.content(igtl_type, outgoing.content):
            return self._deny(entry, stream, outgoing, igtl_type)
        if stream.conversion.igtl_type == "COMMAND" and not self._activity.active:
            reply = self._commands.refuse_ros(entry, stream, outgoing, "the gateway is not active")
            return Outcome([*reply, self._activity.refuse(entry)], INACTIVE)
        if stream.of_robot and not outgoing.stamp_ns and hasattr(message, "header"):
            text = f"{entry.channel}: data without a stamp are not valid (CRTK) and are not sent"
            finding = Finding(Level.INFO, NOT_VALID, text, entry.channel, entry.links, subject=entry.channel)
            return Outcome([finding], NOT_VALID)
        return None

    def _unsent(self, entry: Entry, found: list[Item]) -> Outcome:
        """Handle a message that is kept as the latest one of its stream, but not sent."""
        return Outcome(found, "no_peer") if self._activity.active else self._refused(entry, Outcome(found))

    def _refused(self, entry: Entry, outcome: Outcome) -> Outcome:
        """Return an outcome as that of a message which the gateway refuses because it is not active."""
        return Outcome([*outcome.items, self._activity.refuse(entry)], INACTIVE)

    def _unrouted(self, entry: Entry) -> Outcome:
        """Handle a message of a topic that is not bridged, or above the limit of streams."""
        if not self._streams.is_over_limit(entry.channel, entry.type):
            return Outcome(fate=RECORDED_ONLY)
        text = f"more than {counted(self._config.max_streams, 'stream')}: {entry.channel} is recorded, not sent"
        finding = Finding(Level.WARN, "too_many_streams", text, entry.channel, entry.links, subject="ros")
        return Outcome([finding], "too_many_streams")

    def _deny(self, entry: Entry, stream: ToIgtlStream, outgoing: ConvertedMessage, igtl_type: str) -> Outcome:
        """Reject a message that ``deny_out`` denies; a denied command gets a reply."""
        text = f"{entry.channel} is not sent: {igtl_type} is denied (deny_out)"
        subject = f"{entry.channel} {igtl_type}"
        finding = Finding(Level.WARN, "denied", text, entry.channel, entry.links, subject)
        return Outcome([finding, *self._commands.deny_ros(entry, stream, outgoing, igtl_type)], "denied")

    def _addressed(self, outgoing: ConvertedMessage) -> Iterable[Peer]:
        """Return the addressees of a message."""
        if not outgoing.link:
            return self._peers.all()
        peer = self._peers.get(outgoing.link)
        if peer is None:
            raise ConversionError(
                f"found link {outgoing.link}, expected 0 (all peers) or the number of a connected peer"
            )
        return (peer,)
