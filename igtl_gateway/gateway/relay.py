"""The relay: forwards all messages between two OpenIGTLink programs unchanged.

Each message of a link goes to its partner link, byte for byte, including other header versions, unknown types and
damaged bodies.  The notes of the links name the partners.  So this core is a pure function of its inputs, too, and its
recordings replay and verify in the same way.

Deny lists apply: ``deny_in`` from the clients to the server, ``deny_out`` in the other direction.  A denied message is
not forwarded and gets no reply, because a relay sends no messages of its own.

With ``faults`` in the configuration the relay injects faults, see ``igtl_gateway.config.faults``.  A message is then
sent with the input, which may be a tick, at which it is due, and with the faults applied.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import WireError
from igtl_gateway.base.once import Once
from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.faults import Fate, FaultLine, RelayFaults
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.activity import INACTIVE, Activity
from igtl_gateway.gateway.command_guard import Write
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.dialogue.clocks import ClockQuestions
from igtl_gateway.gateway.fastpath import FastHandler, PrepareMessage, no_fast_path
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.changes import SETTING, is_change
from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP, ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import RELAYED
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.log.marks import MarkNote, OpenPhases
from igtl_gateway.gateway.log.note import LINK_DOWN, LINK_UP, Level, Note
from igtl_gateway.gateway.output import Output, note_output
from igtl_gateway.gateway.stamps import moved
from igtl_gateway.gateway.to_ros.subscribers import HasSubscriber
from igtl_gateway.wire import decode

#: Key in the note of a link that was opened for another link: the number of that link.
PARTNER = "partner"

#: Codes of the notes about an injected fault, and of the notes that make the edge close their links.
FAULT, CUT = "fault", "fault_disconnect"

_IN, _OUT = "igtl_in", "igtl_out"


class RelayGateway:
    """The core of a relay.  It has no ROS side.  Without fault injection it needs no ticks and drops nothing."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.fast: FastHandler = no_fast_path
        self.prepare: PrepareMessage = no_fast_path
        self.collect: Callable[[], None] = no_fast_path
        self.receivers: Callable[[], dict[str, int]] = dict
        self.has_subscriber: HasSubscriber | None = None
        self.deadline_set: Callable[[], None] | None = None
        self.guard = Guard(watch=False)
        self.ledger = Ledger()
        self.phases = OpenPhases()
        self.on_mark: Callable[[MarkNote], None] | None = None
        self.write: Write | None = None
        self.questions: ClockQuestions | None = None
        self.take_unwritten: Callable[[], Note | None] = no_fast_path
        self._partners: dict[int, int] = {}
        self._servers: set[int] = set()  # links to the server
        self._denied_in, self._denied_out = Denials(config.deny_in), Denials(config.deny_out)
        self._activity = Activity()
        self._noted: dict[int, Once] = {}  # link → codes and streams
        self._faults = RelayFaults.parse(config.faults)
        self._lines: dict[int, FaultLine[Entry]] = {}  # link → fault line of the messages to it
        self._cut: set[int] = set()  # links that are being closed

    def handle(self, entry: Entry) -> list[Entry]:
        """Return the entries that ``entry`` causes, with the numbers and nanoseconds directly after it."""
        outputs: list[Output] = []
        for link, line in self._lines.items():
            outputs += self._forward(link, line.due(entry.stamp_ns))
        if entry.kind is Kind.LINK:
            outputs += self._on_link(entry)
        elif entry.kind is Kind.IGTL_IN:
            outputs += self._relay(entry)
        elif ClockStep.of(entry):
            self.ledger.count("edges", "", CLOCK_STEP)
        elif is_change(entry) and (settings := LiveSettings.from_note(Note.of(entry.data()))):
            self.ledger.count("edges", "", SETTING)
            outputs += self._change(settings)
        elif entry.kind is Kind.EDGE_NOTE:
            self.phases.follow(Note.of(entry.data()))
        if self._lines and self.deadline_set:
            self.deadline_set()
        return [output.entry(entry, step) for step, output in enumerate(outputs, start=1)]

    @property
    def due_ns(self) -> int | None:
        """Gateway time (UTC ns) at which the core needs a tick (see ``TICK``); None if it needs none."""
        return min((line.due_ns for line in self._lines.values() if line.due_ns is not None), default=None)

    def profile_of(self, link: int) -> str:
        """Return "": a relay adapts nothing to its peers."""
        return ""

    def reads_milliseconds(self, link: int) -> bool:
        """Return False: a relay reads no stamps."""
        return False

    def subscription(self, topic: str, ros_type: str) -> Qos | None:
        """Return None: a relay bridges no topic."""
        return None

    def lacks_conversion(self, topic: str, ros_type: str) -> bool:
        """Return False: a relay bridges no topic."""
        return False

    def qos(self, topic: str) -> Qos | None:
        """Return None: a relay publishes no topic."""
        return None

    def frames(self) -> set[str]:
        """Return no frames: a relay has no ROS side."""
        return set()

    def frames_apart(self) -> dict[str, str]:
        """Return no frames."""
        return {}

    def until_ns(self, entry: Entry) -> int:
        """Return 0: a relay publishes no topic."""
        return 0

    def must_keep(self, entry: Entry) -> bool:
        """Return True: a relay drops no message."""
        return True

    def _on_link(self, entry: Entry) -> list[Output]:
        link_note = Note.of(entry.data())
        link = entry.links[0]
        if link_note.code == LINK_UP and isinstance(partner := link_note.data.get(PARTNER), int):
            self._partners |= {link: partner, partner: link}
            self._servers.add(link)
        elif link_note.code == LINK_DOWN:
            partner = self._partners.pop(link, 0)
            self._partners.pop(partner, None)
            self._servers.discard(link)
            self._cut.discard(link)
            self._noted.pop(link, None)
            if line := self._lines.pop(link, None):
                self._drop_waiting(line, LINK_DOWN)
            if line := self._lines.get(partner):  # its last messages are still in the line
                return self._forward(partner, line.drain())
        return []

    def _relay(self, entry: Entry) -> list[Output]:
        link = entry.links[0]
        self.ledger.count(_IN, entry.channel, "received")
        partner = self._partners.get(link)
        if partner is None:
            self.ledger.drop(_IN, entry.channel, "no_partner")
            text = "message dropped: the other side of the relay is disconnected"
            return self._warn_once(entry, "no_partner", text)
        if not self._activity.active:
            self.ledger.drop(_IN, entry.channel, INACTIVE)
            finding = self._activity.refuse(entry)
            return self._warn_once(entry, INACTIVE, finding.text, finding.subject)
        if (denied := self._denied(entry)) is not None:
            self.ledger.drop(_IN, entry.channel, "denied")
            return self._warn_once(entry, "denied", denied)
        if partner in self._cut:
            self.ledger.drop(_IN, entry.channel, CUT)
            return []
        if faults := self._faults.outward if link in self._servers else self._faults.inward:
            line = self._lines.get(partner)
            if line is None:
                line = self._lines[partner] = FaultLine(
                    faults, self.config.fault_seed, f"{partner}", partial(moved, acceptance=Acceptance.of(self.config))
                )
            return self._forward(partner, line.take(entry.stamp_ns, entry, entry.data()))
        return self._sent(entry, entry.payload, partner)

    def _sent(self, entry: Entry, payload: Sequence[Buffer], partner: int) -> list[Output]:
        """Forward a message to the partner of its link."""
        self.ledger.count(_IN, entry.channel, RELAYED)
        self.ledger.count(_OUT, entry.channel, "sent")
        sent = Output(Kind.IGTL_OUT, entry.channel, entry.type, payload, (partner,), entry.source_ns)
        try:
            Acceptance.of(self.config).message(entry.payload[0])
        except WireError as error:
            # damaged bytes are forwarded: each kind is reported once, and the recording has all of them
            return [sent, *self._warn_once(entry, error.code, f"relayed unchanged: {error}")]
        return [sent]

    def _forward(self, link: int, fates: list[Fate[Entry]]) -> list[Output]:
        """Return the outputs for messages that leave a fault line, or are lost in it."""
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
                text = "connection closed by fault injection (--fault)"
                outputs.append(note_output(Level.INFO, CUT, text, entry.channel, (link,)))
                self._drop_waiting(self._lines[link], CUT)
        return outputs

    def _drop_waiting(self, line: FaultLine[Entry], reason: str) -> None:
        """Count the messages that are still in a line as dropped."""
        for fate in line.drain():
            self.ledger.drop(_IN, fate.message.channel, reason)

    def _denied(self, entry: Entry) -> str | None:
        """Return why a message is denied; None if it may pass."""
        setting = "deny_out" if entry.links[0] in self._servers else "deny_in"
        denials = self._denied_out if setting == "deny_out" else self._denied_in
        if denials.type(entry.type):
            return f"{entry.type} is denied ({setting})"
        if not denials or entry.type != "BIND":
            return None
        try:
            denied = denials.message(decode(entry.payload[0], check_crc=False, reading=self.config.reading))
        except WireError as error:  # another program may be able to read it
            return f"BIND is denied because it cannot be decoded ({setting}): {error}"
        return f"BIND that contains {denied} is denied ({setting})" if denied else None

    def _change(self, settings: LiveSettings) -> list[Output]:
        """Use other settings from now on."""
        self.config = config = settings.applied(self.config)
        self._denied_in.change(config.deny_in)
        self._denied_out.change(config.deny_out)
        return [note_output(found.level, found.code, found.text) for found in self._activity.change(settings.active)]

    def _warn_once(self, entry: Entry, code: str, text: str, subject: str | None = None) -> list[Output]:
        """Return a warning, unless this stream (or ``subject``) of the link already had it."""
        if not self._noted.setdefault(entry.links[0], Once()).first(code, subject or entry.channel):
            return []
        return [note_output(Level.WARN, code, text, entry.channel, entry.links)]
