"""The relay: two OpenIGTLink programs talk through the gateway as if it were not there.

Whatever comes from a link goes to its partner, byte for byte: other header versions, unknown types and broken
bodies too.  Which links are partners is told by the notes of the links themselves, so that this core is a pure
function of its inputs like the other one, and recordings of it replay and verify in the same way.

Types may be denied: ``deny_in`` on the way from the clients to the server, ``deny_out`` on the way back.  Such a
message goes nowhere, and nobody is answered for it: a relay has no words of its own.

With ``faults`` in the configuration it is a bad line between the two, see ``igtl_gateway.faults``: a message then
leaves with the input that makes it due, be it a tick, and as it became on the way.
"""

from __future__ import annotations

from collections.abc import Sequence

from igtl_gateway.buffers import Buffer
from igtl_gateway.config import Config
from igtl_gateway.errors import WireError
from igtl_gateway.faults import Fate, FaultLine, RelayFaults
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.dialogue.links import LINK_DOWN, LINK_UP
from igtl_gateway.gateway.fastpath import Fast, no_fast_path
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.output import Output, note_output
from igtl_gateway.gateway.stamps import moved
from igtl_gateway.gateway.to_ros.subscribers import Ask
from igtl_gateway.qos import Qos
from igtl_gateway.session.clocksteps import CLOCK_STEP, ClockStep
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.ledger import Ledger
from igtl_gateway.session.note import Level, Note
from igtl_gateway.wire import decode

#: In the note of a link that was made for another one: the number of that one.
PARTNER = "partner"

#: Codes of the notes that say what a fault did to a message, and of those that ask the edge to close their links.
FAULT, CUT = "fault", "fault_disconnect"

_IN, _OUT = "igtl_in", "igtl_out"


class RelayGateway:
    """See the module.  It has no ROS side, and but for faults it wants no ticks and loses nothing while both live."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.fast: Fast = no_fast_path
        self.has_subscriber: Ask | None = None
        self.guard = Guard(watch=False)
        self.ledger = Ledger()
        self._partners: dict[int, int] = {}
        self._servers: set[int] = set()  # links to the server
        self._denied_in, self._denied_out = Denials(config.deny_in), Denials(config.deny_out)
        self._said: set[tuple[str, str, int]] = set()
        self._faults = RelayFaults.parse(config.faults)
        self._lines: dict[int, FaultLine[Entry]] = {}  # link → the way of the messages to it
        self._cut: set[int] = set()  # links that are being closed

    def handle(self, entry: Entry) -> list[Entry]:
        """The entries that ``entry`` causes, numbered and stamped directly behind it."""
        outputs: list[Output] = []
        for link, line in self._lines.items():
            outputs += self._forward(link, line.due(entry.stamp_ns))
        if entry.kind is Kind.LINK:
            outputs += self._on_link(entry)
        elif entry.kind is Kind.IGTL_IN:
            outputs += self._relay(entry)
        elif ClockStep.of(entry):
            self.ledger.count("edges", "", CLOCK_STEP)
        return [output.entry(entry, step) for step, output in enumerate(outputs, start=1)]

    @property
    def due_ns(self) -> int | None:
        """The gateway time (UTC ns) at which it wants a tick, None if none; see ``TICK``."""
        return min((line.due_ns for line in self._lines.values() if line.due_ns is not None), default=None)

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

    def _on_link(self, entry: Entry) -> list[Output]:
        told = Note.of(entry.data())
        link = entry.links[0]
        if told.code == LINK_UP and isinstance(partner := told.data.get(PARTNER), int):
            self._partners |= {link: partner, partner: link}
            self._servers.add(link)
        elif told.code == LINK_DOWN:
            partner = self._partners.pop(link, 0)
            self._partners.pop(partner, None)
            self._servers.discard(link)
            self._cut.discard(link)
            self._said = {said for said in self._said if said[2] != link}
            if line := self._lines.pop(link, None):
                self._drop_waiting(line, LINK_DOWN)
            if line := self._lines.get(partner):  # what it said last is still to arrive
                return self._forward(partner, line.rest())
        return []

    def _relay(self, entry: Entry) -> list[Output]:
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
        if partner in self._cut:
            self.ledger.drop(_IN, entry.channel, CUT)
            return []
        if faults := self._faults.outward if link in self._servers else self._faults.inward:
            line = self._lines.get(partner)
            if line is None:
                line = self._lines[partner] = FaultLine(faults, self.config.fault_seed, f"{partner}", moved)
            return self._forward(partner, line.take(entry.stamp_ns, entry, entry.data()))
        return self._sent(entry, entry.payload, partner)

    def _sent(self, entry: Entry, payload: Sequence[Buffer], partner: int) -> list[Output]:
        """A message goes to the partner of its link."""
        self.ledger.count(_IN, entry.channel, "relayed")
        self.ledger.count(_OUT, entry.channel, "sent")
        sent = Output(Kind.IGTL_OUT, entry.channel, entry.type, payload, (partner,), entry.source_ns)
        try:
            decode(entry.payload[0], check_crc=self.config.check_crc)
        except WireError as error:
            # the bytes are for the other side to judge; each kind of fault is told once, all are in the recording
            return [sent, *self._once(entry, error.code, f"relayed as it is: {error}")]
        return [sent]

    def _forward(self, link: int, fates: list[Fate[Entry]]) -> list[Output]:
        """Messages leave a line with faults, or are lost."""
        outputs: list[Output] = []
        for fate in fates:
            entry = fate.message
            if link in self._cut:
                self.ledger.drop(_IN, entry.channel, CUT)
                continue
            for fault, words in fate.reportable.items():
                text = f"{fault}: {entry.channel}, message {entry.seq}: {words}"
                outputs.append(note_output(Level.INFO, FAULT, text, entry.channel, (link,)))
            if fate.lost:
                self.ledger.drop(_IN, entry.channel, "fault_loss")
            else:
                payload = entry.payload if fate.data is None else (fate.data,)
                outputs += self._sent(entry, payload, link)
            if fate.disconnect:
                self._cut.add(link)
                text = "connection closed on purpose: --fault"
                outputs.append(note_output(Level.INFO, CUT, text, entry.channel, (link,)))
                self._drop_waiting(self._lines[link], CUT)
        return outputs

    def _drop_waiting(self, line: FaultLine[Entry], reason: str) -> None:
        """What still waits in a line does not arrive."""
        for fate in line.rest():
            self.ledger.drop(_IN, fate.message.channel, reason)

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

    def _once(self, entry: Entry, code: str, text: str) -> list[Output]:
        """A warning, unless this link's stream had it before."""
        said = (code, entry.channel, entry.links[0])
        if said in self._said:
            return []
        self._said.add(said)
        return [note_output(Level.WARN, code, text, entry.channel, entry.links)]
