"""Links that go up and down: the list of peers for ROS, latched messages for late joiners, pings."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Any

from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.igtl_msgs import LinkStatusList
from igtl_gateway.convert.profiles import PLUS_1
from igtl_gateway.convert.rosmsg import Header as RosHeader
from igtl_gateway.gateway.activity import Activity
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.dialogue.clocks import ClockQuestions
from igtl_gateway.gateway.dialogue.commanding import Commands
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.ledger import PEERS
from igtl_gateway.gateway.log.note import LINK_UP, Level, Note
from igtl_gateway.gateway.naming import SharedNames
from igtl_gateway.gateway.outcome import Finding, Item, Outcome, Tally
from igtl_gateway.gateway.output import Output, ros_output
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.to_igtl.composer import Composer
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.latest import Latest
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.tf_receive import TfReceiver
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery, split_query

#: Latched messages wait for the first message of a peer, at most this time, and this time after its last GET_.
_HELLO_NS, _ASKING_NS = NS_PER_S // 4, 2 * NS_PER_S

#: Types that a peer asks for to learn of the link, and not of data.
_OF_THE_LINK = frozenset({"STATUS", "CAPABILITY"})

#: Topic of the list of connected peers.
LINKS_TOPIC = "/igtl/links"
LINKS_QOS = Qos(depth=10, latched=True)


class Links:
    """Handles link events.

    Args:
        denied: types that are not sent to peers (``deny_out``).
    """

    def __init__(
        self,
        config: Config,
        peers: Peers,
        guard: Guard,
        denied: Denials,
        *,
        latest: Latest,
        composer: Composer,
        delivery: Delivery,
        frames: TfReceiver,
        commands: Commands,
        activity: Activity,
        questions: ClockQuestions,
        shared: SharedNames | None = None,
    ) -> None:
        self._config = config
        self._peers = peers
        self._guard = guard
        self._denied = denied
        self._latest = latest
        self._composer = composer
        self._delivery = delivery
        self._frames = frames
        self._commands = commands
        self._activity = activity
        self._questions = questions
        self._shared = shared

    def take(self, entry: Entry) -> Outcome:
        """Handle a link that went up or down."""
        event = Note.of(entry.data())
        outcome = Outcome()
        for link in entry.links:
            self._peers.changed(link)
            if event.code == LINK_UP:
                peer = self._peers.up(link, event.data, entry.stamp_ns)
                self._questions.clocks.up(link, peer.address)
                if peer.recent:
                    peer.held_until_ns = entry.stamp_ns + _HELLO_NS
                elif self._activity.active:  # else when it becomes active
                    outcome.items += self._send_latched(entry, peer)
            else:
                outcome.tallies += self._final_counts(link, event.data)
                self._peers.down(link)
                self._guard.on_link_down(link)
                self._questions.on_link_down(link)
                if self._shared:
                    self._shared.on_link_down(link)
                outcome.items += self._commands.on_link_down(entry, link)
        outcome.items.append(self.status(entry.stamp_ns))
        return outcome

    def status(self, now_ns: int) -> Output:
        """Return the list of peers as an output to ROS."""
        header = RosHeader(now_ns, self._config.base_frame)
        statuses = tuple(peer.status() for peer in self._peers.all())
        return ros_output(LINKS_TOPIC, LinkStatusList(header, statuses), now_ns)

    def learned(self, entry: Entry, peer: Peer, message: Message) -> list[Item]:
        """Learn version and profile of the sender of a message; return the new list of peers, and the findings."""
        before, gets = peer.profile, peer.gets
        if not peer.learn_from(message):
            return []
        if peer.gets != gets:  # not with the first message of each peer: all streams would be compiled again
            self._peers.changed(peer.link)
        items: list[Item] = [self.status(entry.stamp_ns)]
        if peer.profile is before:
            return items
        text, level = f"{peer.address or 'peer'}: profile {peer.profile.name}, detected from its messages", Level.INFO
        if peer.profile is PLUS_1:
            level = Level.WARN
            text += (
                ": it looks like PLUS and sends header version 1, which does not mark invalid poses: they are published"
                f" as valid ones, also on /tf. --peer {peer.place}=plus, or "
                'ClientHeaderVersion="2" in <DefaultClientInfo> of PLUS, makes it send version 2'
            )
        return [*items, Finding(level, "peer_profile", text, entry.channel, (peer.link,))]

    @property
    def due_ns(self) -> int | None:
        """Gateway time (UTC ns) of the next ping, and of latched messages that are held back; None if there is none."""
        pings = (peer.last_sent_ns + peer.profile.ping_ns for peer in self._peers_to_ping())
        held = (peer.held_until_ns for peer in self._peers.all() if peer.held_until_ns)
        return min(chain(pings, held), default=None)

    def on_message(self, entry: Entry, peer: Peer, message: Message) -> list[Item]:
        """Return the latched messages for a peer that has sent its first message; none while it asks for data.

        A program that asks (GET_) reads the next message as the answer, whatever it is.  GET_STATUS is a ping.
        """
        if not peer.held_until_ns:
            return []
        query = split_query(message.type)
        if query and query[0] == "GET" and query[1] not in _OF_THE_LINK:
            peer.held_until_ns = entry.stamp_ns + _ASKING_NS
            return []
        return self._release(entry, peer)

    def release(self, entry: Entry) -> list[Item]:
        """Return the latched messages that are no longer held back; ``entry`` is a tick."""
        due = [peer for peer in self._peers.all() if 0 < peer.held_until_ns <= entry.stamp_ns]
        return [item for peer in due for item in self._release(entry, peer)]

    def _release(self, entry: Entry, peer: Peer) -> list[Item]:
        gets = peer.gets
        peer.held_until_ns = 0
        if peer.gets != gets:
            self._peers.changed(peer.link)
        return self._send_latched(entry, peer) if self._activity.active else []

    def ping(self, entry: Entry) -> list[Item]:
        """Return pings for the peers that close a silent link; ``entry`` is a tick."""
        items: list[Item] = []
        now_ns = entry.stamp_ns
        for peer in list(self._peers_to_ping()):
            if peer.last_sent_ns + peer.profile.ping_ns <= now_ns:
                items += self._delivery.to(entry, [peer], [OutboundMessage("GET_STATUS", "", EmptyQuery(), now_ns)])
        return items

    def _peers_to_ping(self) -> Iterable[Peer]:
        """Return the peers whose profile has a ping interval."""
        if self._denied.type("GET_STATUS"):
            return ()
        return (peer for peer in self._peers.all() if peer.profile.ping_ns)

    def activate(self, entry: Entry, *, active: bool) -> list[Item]:
        """Let messages pass, or refuse them, from now on; a gateway that becomes active is a late joiner to ROS.

        So all peers get the latched messages: of those that came while it was not active they know nothing.
        """
        was_active = self._activity.active
        items: list[Item] = [*self._activity.change(active)]
        if active and not was_active:
            for peer in self._peers.all():
                if not peer.held_until_ns:
                    items += self._send_latched(entry, peer)
        return items

    def _send_latched(self, entry: Entry, peer: Peer) -> list[Item]:
        """Return the latest message of each latched stream for a late joiner, as transient-local durability does."""
        items: list[Item] = []
        for latest, stream in self._latest.latched():
            if self._commands.sender_for(stream.conversion.igtl_type):
                continue
            try:
                out = self._composer.convert(latest, stream, stream.conversion)
                items += self._delivery.to(entry, [peer], [out])
            except (ConversionError, WireError) as error:
                items.append(Finding(Level.ERROR, "conversion", f"not sent: {error}", latest.channel))
        return items + self._frames.send_static(entry, peer)

    def _final_counts(self, link: int, counts: dict[str, Any]) -> list[Tally]:
        """Return the counts of a closed link: messages delivered, dropped, and lost at its end."""
        peer = self._peers.get(link)
        if peer is None or not isinstance(delivered := counts.get("sent_messages"), int):
            return []
        row = f"{link} {peer.address}"
        by_stream = counts.get("dropped", {})
        dropped = sum(by_stream.values()) if isinstance(by_stream, dict) else by_stream
        gone = peer.sent - delivered - dropped  # sent while the link was closing
        losses = (("queue", dropped), ("link_closed", gone))
        return [
            Tally(PEERS, row, "sent", peer.sent),
            Tally(PEERS, row, "delivered", delivered),
            *(Tally(PEERS, row, reason, number, dropped=True) for reason, number in losses if number > 0),
        ]
