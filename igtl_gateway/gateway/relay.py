"""The relay: two OpenIGTLink programs talk through the gateway as if it were not there.

Whatever comes from a link goes to its partner, byte for byte: other header versions, unknown types and broken
bodies too.  Which links are partners is told by the notes of the links themselves, so that this core is a pure
function of its inputs like the other one, and recordings of it replay and verify in the same way.

Types may be denied: ``deny_in`` on the way from the clients to the server, ``deny_out`` on the way back.  Such a
message goes nowhere, and nobody is answered for it: a relay has no words of its own.
"""

from __future__ import annotations

from igtl_gateway.config import Config
from igtl_gateway.errors import WireError
from igtl_gateway.gateway.core import LINK_DOWN, LINK_UP, Gateway
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.reply import Reply, note
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.ledger import Ledger
from igtl_gateway.session.note import Level, Note
from igtl_gateway.wire import decode

#: In the note of a link that was made for another one: the number of that one.
PARTNER = "partner"

_IN, _OUT = "igtl_in", "igtl_out"


class RelayGateway:
    """See the module.  It has no ROS side, wants no ticks and loses nothing while both links live."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.ledger = Ledger()
        self.due_ns: int | None = None
        self._partners: dict[int, int] = {}
        self._servers: set[int] = set()  # links to the server
        self._denied_in, self._denied_out = Denials(config.deny_in), Denials(config.deny_out)
        self._said: set[tuple[str, str, int]] = set()

    def handle(self, entry: Entry) -> list[Entry]:
        """The entries that ``entry`` causes, numbered and stamped directly behind it."""
        replies: list[Reply] = []
        if entry.kind is Kind.LINK:
            self._on_link(entry)
        elif entry.kind is Kind.IGTL_IN:
            replies = self._relay(entry)
        return [reply.entry(entry, step) for step, reply in enumerate(replies, start=1)]

    def subscription(self, topic: str, ros_type: str) -> Qos | None:
        """No topic is bridged."""
        return None

    def lacks_conversion(self, topic: str, ros_type: str) -> bool:
        """Nothing is missing where nothing is bridged."""
        return False

    def qos(self, topic: str) -> Qos | None:
        """No topic is published."""
        return None

    def keep(self, entry: Entry) -> bool:
        """No message may be dropped."""
        return True

    def _on_link(self, entry: Entry) -> None:
        told = Note.unpack(entry.data())
        link = entry.links[0]
        if told.code == LINK_UP and isinstance(partner := told.data.get(PARTNER), int):
            self._partners |= {link: partner, partner: link}
            self._servers.add(link)
        elif told.code == LINK_DOWN:
            self._partners.pop(self._partners.pop(link, 0), None)
            self._servers.discard(link)
            self._said = {said for said in self._said if said[2] != link}

    def _relay(self, entry: Entry) -> list[Reply]:
        link = entry.links[0]
        self.ledger.count(_IN, entry.channel, "received")
        partner = self._partners.get(link)
        if partner is None:
            self.ledger.drop(_IN, entry.channel, "no_partner")
            text = "message not relayed: the other side has gone"
            return self._once(entry, "no_partner", text)
        if (denied := self._denied(entry)) is not None:
            self.ledger.drop(_IN, entry.channel, "denied")
            return self._once(entry, "denied", denied)
        self.ledger.count(_IN, entry.channel, "relayed")
        self.ledger.count(_OUT, entry.channel, "sent")
        sent = Reply(Kind.IGTL_OUT, entry.channel, entry.type, entry.payload, (partner,), entry.source_ns)
        try:
            decode(entry.payload[0], check_crc=self.config.check_crc)
        except WireError as error:
            # the bytes are for the other side to judge; each kind of fault is told once, all are in the recording
            return [sent, *self._once(entry, error.code, f"relayed as it is: {error}")]
        return [sent]

    def _denied(self, entry: Entry) -> str | None:
        """Why a message may not pass, None if it may."""
        setting = "deny_out" if entry.links[0] in self._servers else "deny_in"
        denials = self._denied_out if setting == "deny_out" else self._denied_in
        if denials.type(entry.type):
            return f"{entry.type} is denied ({setting})"
        if not denials or entry.type != "BIND":
            return None
        try:
            denied = denials.message(decode(entry.payload[0], check_crc=False))
        except WireError as error:  # it may be readable for others
            return f"a BIND that cannot be looked into is denied ({setting}): {error}"
        return f"BIND with {denied} inside is denied ({setting})" if denied else None

    def _once(self, entry: Entry, code: str, text: str) -> list[Reply]:
        """A warning, unless this link's stream had it before."""
        said = (code, entry.channel, entry.links[0])
        if said in self._said:
            return []
        self._said.add(said)
        return [note(Level.WARN, code, text, entry.channel, entry.links)]


def gateway_of(config: Config) -> Gateway | RelayGateway:
    """The core that a configuration asks for."""
    return RelayGateway(config) if config.relay else Gateway(config)
