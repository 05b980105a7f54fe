"""Processes a message of a peer: check, decode, deny list, route to ROS, reply."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.base.errors import WireError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.profiles import is_hello
from igtl_gateway.gateway.activity import INACTIVE, Activity
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.dialogue.clocks import ClockQuestions
from igtl_gateway.gateway.dialogue.commanding import Commands
from igtl_gateway.gateway.dialogue.links import Links
from igtl_gateway.gateway.dialogue.marking import Marking
from igtl_gateway.gateway.dialogue.probing import is_probe
from igtl_gateway.gateway.dialogue.querying import Queries
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.fates import ASKED, GREETED, MARKED, PROBED
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding, Item, Outcome, conversion_failure
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.to_ros.beforehand import Beforehand
from igtl_gateway.gateway.to_ros.deviations import as_meant, deviation_finding
from igtl_gateway.gateway.to_ros.route import Router
from igtl_gateway.wire import Message
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.query import split_query


class IgtlReceiver:
    """Receives the messages of peers.

    Args:
        denied: types that are not accepted (``deny_in``).
    """

    def __init__(
        self,
        config: Config,
        peers: Peers,
        denied: Denials,
        router: Router,
        beforehand: Beforehand,
        *,
        links: Links,
        queries: Queries,
        commands: Commands,
        activity: Activity,
        marking: Marking,
        questions: ClockQuestions,
    ) -> None:
        self._config = config
        self._peers = peers
        self._denied = denied
        self._router = router
        self._beforehand = beforehand
        self._links = links
        self._queries = queries
        self._commands = commands
        self._activity = activity
        self._marking = marking
        self._questions = questions

    def take(self, entry: Entry) -> Outcome:
        """Process a message of any type."""
        try:
            message = self._beforehand.decode(entry)
        except WireError as error:
            return Outcome([conversion_failure(error, "message refused", entry, error.code)], error.code)
        peer = self._peers.get(entry.links[0])
        if is_probe(message):
            return Outcome(self._queries.identify(entry, peer) if peer else [], PROBED, decoded=True)
        is_first = peer is not None and not peer.shown
        news = self._links.learned(entry, peer, message) if peer else []
        if message.deviation:
            news.append(deviation_finding(entry, peer, message.deviation))
        clock = self._questions.take(entry, peer, message) if peer else None
        if clock is not None:
            return Outcome([*news, *clock], ASKED, decoded=True)
        if denied := self._denied.message(message):
            return Outcome([*news, *self._deny(entry, peer, message, denied)], "denied", decoded=True)
        if not self._activity.active:
            finding = self._activity.refuse(entry)
            items = self._rejected(entry, peer, message, finding, "refused: the gateway is not active")
            return Outcome([*news, *items], INACTIVE, decoded=True)
        if peer and self._config.naming and (is_hello(message) or (is_first and peer.greets_with(message))):
            return Outcome([*news, *self._links.on_message(entry, peer, message)], GREETED, decoded=True)
        makes_mark = self._marking.takes(message)
        if makes_mark:
            refused = self._marking.make(entry, message, peer)
            if refused:
                news.append(Finding(Level.WARN, "mark_refused", refused, entry.channel, entry.links))
            if isinstance(message.content, Command):
                answer = self._commands.marked(entry, peer, message, refused) if peer else []
                return Outcome([*news, *answer], "mark_refused" if refused else MARKED, decoded=True)
        answered = ""
        if peer:
            refusal, answered = self._commands.accept(entry, peer, message)
            if refusal:
                return Outcome([*news, *refusal], "command_refused", decoded=True)
        restored = self._beforehand.restored(entry, message)
        if answered and not restored.device_name and self._config.naming:
            restored = replace(restored, device_name=answered)
        message = as_meant(message, peer)
        outcome = self._router.route(entry, message, restored)
        outcome.decoded = True
        if peer is None:
            outcome.origin = None
            return outcome
        if news:
            outcome.items[:0] = news
        if makes_mark or news or peer.held_until_ns or peer.must_see(message):
            outcome.origin = None
        if not isinstance(message.content, Command):
            outcome.items += self._queries.respond(entry, peer, message)
        outcome.items += self._links.on_message(entry, peer, message)  # last: who asks reads the answer first
        return outcome

    def _deny(self, entry: Entry, peer: Peer | None, message: Message, denied: str) -> list[Item]:
        """Reject a denied message; a query or command gets a reply."""
        igtl_type = visible(message.type)
        inside = f" that contains {denied}" if denied != igtl_type else ""
        text = f"{igtl_type}{inside} from {peer.address or 'the peer' if peer else 'a peer'} is denied (deny_in)"
        link = entry.links[0]
        finding = Finding(Level.WARN, "denied", text, entry.channel, entry.links, subject=igtl_type, by=link)
        return self._rejected(entry, peer, message, finding, "denied")

    def _rejected(self, entry: Entry, peer: Peer | None, message: Message, finding: Finding, why: str) -> list[Item]:
        """Return the finding about a message that is refused, and the reply to a query or command."""
        if peer is None:
            return [finding]
        if isinstance(message.content, Command) and visible(message.type) == "COMMAND":
            return [finding, *self._commands.deny(entry, peer, message, why)]
        if query := split_query(message.type):
            return [finding, *self._queries.deny(entry, peer, message, *query, why)]
        return [finding]
