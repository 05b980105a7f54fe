"""Commands in both directions: each command waits for its reply, and its sender gets a reply in every case."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.settings import MAX_TIMEOUT_S
from igtl_gateway.convert import commands as conversions
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext
from igtl_gateway.convert.igtl_msgs import Command as RosCommand
from igtl_gateway.convert.igtl_msgs import CommandReply
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.convert.rosmsg import Header as RosHeader
from igtl_gateway.gateway.dialogue.commands import PendingCommand, PendingCommands
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding, Item, conversion_failure
from igtl_gateway.gateway.output import ros_output
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.streams import Streams, ToIgtlStream
from igtl_gateway.gateway.to_igtl.composer import Composer
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.wire import Message
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.fields import visible

#: Rules of ``Config.fitting`` from which on a peer without metadata finds a failure in the text of the reply.
_FAILURE_IN_TEXT = 2

MakeItems = Callable[[Entry, ToIgtlStream, ConvertedMessage], list[Item]]


class Commands:
    """Handles the commands of both directions."""

    def __init__(self, config: Config, peers: Peers, streams: Streams, composer: Composer, delivery: Delivery) -> None:
        self._config = config
        self._peers = peers
        self._streams = streams
        self._composer = composer
        self._delivery = delivery
        self._from_peers, self._to_peers = PendingCommands(), PendingCommands()
        self._makers: dict[str, MakeItems] = {"COMMAND": self._send_command, "RTS_COMMAND": self._send_reply}

    @property
    def due_ns(self) -> int | None:
        """The earliest deadline (gateway time, UTC ns); None if no command waits."""
        times = (self._from_peers.due_ns, self._to_peers.due_ns)
        return min((time for time in times if time is not None), default=None)

    def overdue(self, entry: Entry) -> list[Item]:
        """End the commands whose deadline has passed at ``entry``, a tick."""
        items: list[Item] = []
        text = "no reply in time"
        for pending in self._from_peers.overdue(entry.stamp_ns):
            items += self._reply(entry, pending, CommandReply.FAIL, f"{text} from ROS")
            items.append(
                _timeout(pending, f"command {pending.command_id} ({pending.name!r}) of a peer: {text} from ROS")
            )
        for pending in self._to_peers.overdue(entry.stamp_ns):
            items += self._reply_to_ros(entry, pending, CommandReply.TIMEOUT, text)
            items.append(_timeout(pending, f"command {pending.command_id} ({pending.name!r}): {text} from the peer"))
        return items

    def on_link_down(self, entry: Entry, link: int) -> list[Item]:
        """End the commands of a disconnected peer, in both directions."""
        self._from_peers.on_link_down(link)
        items: list[Item] = []
        for pending in self._to_peers.on_link_down(link):
            items += self._reply_to_ros(entry, pending, CommandReply.NO_PEER, "the peer has gone")
        return items

    # -- from peers -----------------------------------------------------------------------------------------------

    def accept(self, entry: Entry, peer: Peer, message: Message) -> tuple[list[Item], str]:
        """Keep a command of a peer until its reply; return a reply for one that cannot be accepted.

        A peer must be able to rely on a failure: a rejected command does not reach ROS.  A reply of a peer ends the
        waiting of its command from ROS, whose device is returned beside it, else "".
        """
        command = message.content
        if not isinstance(command, Command):
            return [], ""
        if visible(message.type) != "COMMAND":
            asked = self._to_peers.take(command.command_id, peer.link)
            return [], asked.device if asked else ""
        deadline_ns = entry.stamp_ns + int(self._config.command_timeout_s * NS_PER_S)
        pending = PendingCommand(
            peer.link, command.command_id, visible(message.device_name), visible(command.name), deadline_ns
        )
        if self._from_peers.add(pending):
            return [], ""
        text = f"command {pending.command_id} ({pending.name!r}) refused: its id, or too many others, wait already"
        items = self._reply(entry, pending, CommandReply.FAIL, text)
        return [*items, Finding(Level.WARN, "command_refused", text, entry.channel, (peer.link,))], ""

    def deny(self, entry: Entry, peer: Peer, message: Message, why: str) -> list[Item]:
        """Return the reply to a COMMAND that is refused."""
        asked = _asked(entry, peer, message)
        return self._reply(entry, asked, CommandReply.FAIL, f"COMMAND is {why}")

    def marked(self, entry: Entry, peer: Peer, message: Message, refused: str) -> list[Item]:
        """Return the reply to a COMMAND that made a mark, or the reason why it made none."""
        asked = _asked(entry, peer, message)
        return self._reply(entry, asked, CommandReply.FAIL if refused else CommandReply.SUCCESS, refused)

    def _reply(self, entry: Entry, pending: PendingCommand, status: int, text: str) -> list[Item]:
        """Return an RTS_COMMAND of the gateway itself."""
        peer = self._peers.get(pending.link)
        if peer is None:
            return []
        header = RosHeader(entry.stamp_ns)
        message = CommandReply(header, pending.device, pending.command_id, pending.name, status, text)
        return self._delivery.to(entry, [peer], [self._replying(entry, pending, message, peer)])

    def _replying(self, entry: Entry, pending: PendingCommand, message: CommandReply, peer: Peer) -> OutboundMessage:
        """Return a reply with the device and the name of its command."""
        device = short_device_name(pending.device)  # escaped bytes make a name longer
        named = replace(message, device_name=device, name=message.name or pending.name)
        if peer.version == 1 and self._config.fitting >= _FAILURE_IN_TEXT:
            named = conversions.with_failure_in_text(named)
        outgoing = conversions.reply_to_igtl(named, ToIgtlContext())
        stamp_ns = message.header.stamp_ns or entry.stamp_ns
        return OutboundMessage("RTS_COMMAND", device, outgoing.content, stamp_ns, metadata=outgoing.metadata)

    # -- from ROS -------------------------------------------------------------------------------------------------

    def sender_for(self, igtl_type: str) -> MakeItems | None:
        """Return the function that sends messages of a type for which the sender and the addressee matter."""
        return self._makers.get(igtl_type)

    def deny_ros(self, entry: Entry, stream: ToIgtlStream, outgoing: ConvertedMessage, igtl_type: str) -> list[Item]:
        """Return the reply to a COMMAND from ROS that ``deny_out`` denies; nothing for other types."""
        return self.refuse_ros(entry, stream, outgoing, "COMMAND is denied") if igtl_type == "COMMAND" else []

    def refuse_ros(self, entry: Entry, stream: ToIgtlStream, outgoing: ConvertedMessage, text: str) -> list[Item]:
        """Return the reply to a COMMAND from ROS that is not sent; nothing for other contents."""
        command = outgoing.content
        if not isinstance(command, Command):
            return []
        device = outgoing.device_name or stream.full_name
        asked = PendingCommand(outgoing.link, command.command_id, device, visible(command.name), entry.stamp_ns)
        return self._reply_to_ros(entry, asked, CommandReply.FAIL, text)

    def _send_command(self, entry: Entry, stream: ToIgtlStream, outgoing: ConvertedMessage) -> list[Item]:
        """Send a COMMAND: give it an id if it has none, and keep it until its reply."""
        command = outgoing.content
        assert isinstance(command, Command)
        if not command.command_id:
            command = replace(command, command_id=self._to_peers.new_id())
        out = self._composer.compose(entry, stream, stream.conversion, replace(outgoing, content=command))
        timeout_s = RosCommand.unpack(entry.payload[0]).timeout
        if not 0 < timeout_s <= MAX_TIMEOUT_S:
            timeout_s = self._config.command_timeout_s
        deadline_ns = entry.stamp_ns + int(timeout_s * NS_PER_S)
        pending = PendingCommand(0, command.command_id, out.full_name, visible(command.name), deadline_ns)
        readers = (peer for peer in self._peers.all() if peer.may_send(out.igtl_type))
        peers = [peer for peer in readers if outgoing.link in (0, peer.link)]
        asked = [one for one in peers if self._to_peers.add(replace(pending, link=one.link))]
        if not asked:
            text = "the id, or too many others, wait already" if peers else "no peer is there to be asked"
            status = CommandReply.FAIL if peers else CommandReply.NO_PEER
            return self._reply_to_ros(entry, replace(pending, link=outgoing.link), status, text)
        try:
            return self._delivery.to(entry, asked, [out])
        except WireError as error:
            for one in asked:
                self._to_peers.take(pending.command_id, one.link)
            finding = conversion_failure(error, "not sent", entry)
            return [
                finding,
                *self._reply_to_ros(entry, replace(pending, link=outgoing.link), CommandReply.FAIL, finding.text),
            ]

    def _send_reply(self, entry: Entry, stream: ToIgtlStream, outgoing: ConvertedMessage) -> list[Item]:
        """Send an RTS_COMMAND to the peer that waits for it."""
        message = CommandReply.unpack(entry.payload[0])
        pending = self._from_peers.take(message.id, message.link)
        if pending is None:
            raise ConversionError(f"CommandReply: found id {message.id}, expected one of a command that waits")
        peer = self._peers[pending.link]
        try:
            return self._delivery.to(entry, [peer], [self._replying(entry, pending, message, peer)])
        except (ConversionError, WireError) as error:
            finding = conversion_failure(error, "the reply cannot be sent", entry)
            return [finding, *self._reply(entry, pending, CommandReply.FAIL, finding.text)]

    def _reply_to_ros(self, entry: Entry, pending: PendingCommand, status: int, text: str) -> list[Item]:
        """Return a reply to ROS that does not come from a peer."""
        stream = self._streams.to_ros("RTS_COMMAND", pending.device)
        if stream is None:
            return []
        header = RosHeader(entry.stamp_ns, stream.frame_id)
        message = CommandReply(
            header, pending.device, pending.command_id, pending.name, status, text, link=pending.link
        )
        return [
            ros_output(topic, message, entry.stamp_ns) for row, topic in stream.outputs if row.message is CommandReply
        ]


def _asked(entry: Entry, peer: Peer, message: Message) -> PendingCommand:
    """Return the command of a peer that is answered at once."""
    assert isinstance(message.content, Command)
    name, device = visible(message.content.name), visible(message.device_name)
    return PendingCommand(peer.link, message.content.command_id, device, name, entry.stamp_ns)


def _timeout(pending: PendingCommand, text: str) -> Finding:
    return Finding(Level.WARN, "command_timeout", text, f"COMMAND/{pending.device}", (pending.link,))
