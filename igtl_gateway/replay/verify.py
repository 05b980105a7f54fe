"""Verification: passes the recorded inputs to the gateway and compares its outputs with the recorded ones.

Outputs are compared byte by byte, or by their digest where the recording has that; of notes the code, level, stream and
links, not the text.  If bytes differ, both messages are decoded, and the first differing field is reported.

Entry numbers without an entry are losses.  Losses that the recording declares are accepted and counted: entries that
the recorder dropped or did not select, entries that `recover` could not read.  If an input is lost, its recorded
outputs are counted, too.  An output that changed, or that no input can have caused, is never accepted.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from operator import attrgetter
from typing import Any

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.errors import ChecksumMismatch, GatewayError
from igtl_gateway.base.quantities import counted
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.igtl_msgs import LinkStatusList, Metadata, RawMessage
from igtl_gateway.convert.table import TO_ROS
from igtl_gateway.gateway import Session, make_core
from igtl_gateway.gateway.guard import CODES
from igtl_gateway.gateway.log.clock_offset import CODES as CLOCK_CODES
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.stream_units import StreamUnits
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.large_outputs import DigestedOutput
from igtl_gateway.replay.compare import LeafDecoder, compare_values, first_byte, flattened, same
from igtl_gateway.wire import describe

#: Maximum number of differences that are kept, and of streams of which the first is kept; all are counted.
MAX_KEPT = 1_000

#: Stream of entries that are not in the recording.
UNKNOWN = "(not recorded)"

#: Types that the gateway publishes: by conversion, and its own.
_MESSAGES = {row.message.TYPE: row.message for row in TO_ROS} | {
    kind.TYPE: kind for kind in (LinkStatusList, Metadata, RawMessage)
}

#: The field that differs where the recording has the digest of an output.
DIGEST = "SHA-256"
#: Attributes of outputs that are compared besides the bytes.
_COMPARED = ("kind", "channel", "type", "links", "stamp_ns", "source_ns")
_OUTSIDE = attrgetter(*_COMPARED)

_STREAM_NEWS = "stream"
#: Codes of notes that depend on inputs from long before.
_BY_HISTORY = CODES | CLOCK_CODES
_OTHERS = "(others)"


@dataclass(frozen=True, slots=True)
class Difference:
    """One output that differs from the recording.

    Attributes:
        seq: entry number of the output.
        cause: entry number of the input that caused it.
        stream: channel of the output.
        field: path of the first field that differs, or ``"message"`` if one side has no message.
        recorded: value in the recording.
        computed: computed value.
        measure: the difference in millimetres, degrees, pixels …; ``""`` if it has no unit.
    """

    seq: int
    cause: int
    stream: str
    field: str
    recorded: Any
    computed: Any
    measure: str = ""

    def __str__(self) -> str:
        return (
            f"entry {self.seq} (caused by entry {self.cause}), {self.stream}: {self.field}: "
            f"recorded {_value_text(self.recorded)}, computed {_value_text(self.computed)}"
            + (f" ({self.measure})" if self.measure else "")
        )


@dataclass(frozen=True, slots=True)
class DeclaredLosses:
    """The losses that a recording declares.

    Attributes:
        entries: number of lost entries.
        streams: number of lost entries by stream.
        uncounted: further entries and the end may be lost: in a recovered file, or without a ledger.
        midway: the recording starts in the middle of a session.
    """

    entries: int = 0
    streams: Mapping[str, int] = field(default_factory=dict)
    uncounted: bool = False
    midway: bool = False

    @classmethod
    def of(cls, session: Mapping[str, str], ledger: Mapping[str, Any] | None) -> DeclaredLosses:
        """Return the losses that the metadata of a recording declare."""
        midway = layout.SNAPSHOT_KEY in session or session.get(layout.PART_KEY, "0") != "0"
        if ledger is None:
            return cls(uncounted=True, midway=midway)
        recorder, recovered = ledger.get("recorder", {}), ledger.get("recovered", {"whole": True})
        streams = Counter(recorder.get("dropped", {}))
        streams.update(recorder.get("left_out", {}))
        entries = recorder.get("dropped_entries", 0) + recorder.get("left_out_entries", 0)
        uncounted = not recovered.get("whole") or layout.CUT_OFF_KEY in ledger
        return cls(entries, dict(streams), uncounted, midway)


@dataclass(slots=True)
class VerifyReport:
    """The result: ``good`` if all outputs are equal and all losses are declared.

    Attributes:
        inputs, outputs: number of entries in the recording.
        equal: number of outputs that are equal.
        lost: number of computed outputs that were not recorded, as declared.
        missing: number of other declared losses: inputs and their outputs.
        orphans: number of recorded outputs of such inputs; not verified.
        late: number of notes at other times than recorded, because the entries that they report were lost.
        differing: number of outputs that are different, missing or additional.
        compiled: number of inputs whose outputs compiled conversions computed, instead of the full path.
        by_stream: differing outputs by stream.
        firsts: first difference of each stream.
        differences: all differences, up to MAX_KEPT.
    """

    inputs: int = 0
    outputs: int = 0
    equal: int = 0
    lost: int = 0
    missing: int = 0
    orphans: int = 0
    late: int = 0
    differing: int = 0
    compiled: int = 0
    by_stream: dict[str, int] = field(default_factory=dict)
    firsts: dict[str, Difference] = field(default_factory=dict)
    differences: list[Difference] = field(default_factory=list)

    @property
    def good(self) -> bool:
        return self.differing == 0

    def add(self, difference: Difference) -> None:
        self.differing += 1
        self.by_stream[difference.stream] = self.by_stream.get(difference.stream, 0) + 1
        if difference.stream not in self.firsts and len(self.firsts) < MAX_KEPT:
            self.firsts[difference.stream] = difference
        if len(self.differences) < MAX_KEPT:
            self.differences.append(difference)


def verify(
    entries: Iterable[Entry],
    config: Config,
    losses: DeclaredLosses = DeclaredLosses(),
    *,
    before: Iterable[Entry] = (),
    decoder: LeafDecoder | None = None,
) -> VerifyReport:
    """Compare the recorded outputs with those that the gateway computes from the recorded inputs.

    Args:
        entries: entries of the recording in order.
        config: configuration of the gateway, usually the recorded one.
        losses: declared losses of the recording.
        before: the prologue of the recording.
        decoder: decoder for the recording, to report differences with units.
    """
    verifier = Verifier(config, losses, decoder)
    verifier.before(before)
    for entry in entries:
        verifier.take(entry)
    return verifier.end()


class Verifier:
    """Compares entry by entry, with the full path.

    Attributes:
        core: of the gateway that computes the outputs.
    """

    def __init__(
        self, config: Config, losses: DeclaredLosses, decoder: LeafDecoder | None, *, compiles: bool = False
    ) -> None:
        # without the fast path: its recorded outputs are checked against the full path
        self.core = make_core(config, fast_path=compiles)
        self._session = Session(self.core)
        decoder = decoder or LeafDecoder(units=StreamUnits(config))
        self._losses, self._decoder = losses, decoder
        self._left, self._left_of = losses.entries, dict(losses.streams)  # remaining declared losses
        self._report = VerifyReport()
        self._expected: deque[Entry] = deque()
        self._cause = 0
        self._last: int | None = None if losses.midway else 0
        # notes of the guard depend on earlier inputs: in a part of a session they can come at other times
        self._partial = losses.midway or losses.uncounted or losses.entries > 0
        # whether an input may be lost since the last recorded one: also before a file that begins behind a loss
        self._gap = losses.midway and losses.entries > 0

    def before(self, prologue: Iterable[Entry]) -> None:
        """Process what came before the start."""
        for group in input_groups(prologue):
            self._session.restored(group.input, group.outputs)

    def compute(self, entry: Entry) -> list[Entry]:
        """Process an input before the start that has no outputs in the recording; return them, which are numbered."""
        outputs = self._session.recorded(entry)
        self._last = (outputs[-1] if outputs else entry).seq
        return outputs

    @property
    def is_good(self) -> bool:
        """Whether nothing differs so far."""
        return self._report.good

    def go_on(self, number: int) -> None:
        """The entries before this number were verified by another one."""
        self._last = number - 1

    @property
    def settled_at(self) -> int | None:
        """Number of the last entry, if no output of it is expected any more; None before the first entry, too."""
        return None if self._expected else self._last

    def took(self, inputs: int, outputs: int, cause: int, last: int) -> None:
        """Take over entries that follow the last one, whose outputs are equal to those of compiled streams.

        Args:
            inputs, outputs: their number.
            cause, last: number of the last input, and of the last entry.
        """
        self._report.inputs += inputs
        self._report.compiled += inputs
        self._report.outputs += outputs
        self._report.equal += outputs
        self._cause, self._last, self._gap = cause, last, False

    def take(self, entry: Entry) -> None:
        """Process the next entry of the recording."""
        self._skip_to(entry.seq)
        self._last = entry.seq
        if entry.kind.is_input:
            self._miss()
            self._report.inputs += 1
            self._cause, self._gap = entry.seq, False
            self._expected.extend(self._session.recorded(entry))
            return
        self._report.outputs += 1
        if self._expected and self._expected[0].seq == entry.seq:
            expected = self._expected.popleft()
            difference = compare(entry, expected, self._cause, self._decoder)
            if difference and self._is_elsewhere(entry) and self._is_elsewhere(expected):
                self._report.late += 1
            elif difference:
                self._report.add(difference)
            else:
                self._report.equal += 1
        elif self._gap:
            self._report.orphans += 1
        elif self._is_elsewhere(entry):
            self._report.late += 1
        else:
            self._differ(entry, _kind(entry), "nothing")

    def end(self) -> VerifyReport:
        """Return the report, at the end of the recording."""
        while self._expected:
            expected = self._expected.popleft()
            if self._losses.uncounted or self._use_declared_loss(_name(expected)):
                self._report.lost += 1
            else:
                self._differ(expected, "nothing", _kind(expected))
        return self._report

    def _skip_to(self, seq: int) -> None:
        """Account for entry numbers before ``seq`` that have no entry."""
        if self._last is None:
            return
        numbers = seq - self._last - 1
        while self._expected and self._last < self._expected[0].seq < seq:
            expected = self._expected.popleft()
            numbers -= 1
            if self._losses.uncounted or self._use_declared_loss(_name(expected)):
                self._report.lost += 1
            else:
                self._differ(expected, "nothing", _kind(expected))
        if numbers <= 0:
            return
        if self._losses.uncounted or numbers <= self._left:
            self._left -= numbers
            self._report.missing += numbers
            self._gap = True
        else:
            text = f"{numbers} of the entries {self._last + 1} to {seq - 1}"
            self._report.add(Difference(seq - 1, self._cause, UNKNOWN, "entries", "nothing", text))

    def _miss(self) -> None:
        """Account for a computed output whose number belongs to another entry in the recording."""
        while self._expected:
            expected = self._expected.popleft()
            if (self._report.missing and _is_news(expected)) or self._is_elsewhere(expected):
                self._report.late += 1
            else:
                self._differ(expected, "nothing", _kind(expected))

    def _use_declared_loss(self, stream: str) -> bool:
        """Use one declared loss of this stream; return False if there is none left."""
        stream = stream if self._left_of.get(stream) else _OTHERS
        if self._left <= 0 or not self._left_of.get(stream):
            return False
        self._left -= 1
        self._left_of[stream] -= 1
        return True

    def _is_elsewhere(self, entry: Entry) -> bool:
        """Return whether an output is a note of the guard, or of a peer's clock, in a part of a session."""
        return self._partial and entry.kind is Kind.NOTE and Note.of(entry.data()).code in _BY_HISTORY

    def _differ(self, entry: Entry, recorded: str, computed: str) -> None:
        self._report.add(Difference(entry.seq, self._cause, _name(entry), "message", recorded, computed))


def _is_news(entry: Entry) -> bool:
    return entry.kind is Kind.NOTE and Note.of(entry.data()).code == _STREAM_NEWS


def compare(recorded: Entry, computed: Entry, cause: int, decoder: LeafDecoder | None = None) -> Difference | None:
    """Return the first difference of two outputs, None if they are equal; with a decoder also in units."""

    def differ(what: str, one: Any, other: Any, measure: str = "") -> Difference:
        return Difference(recorded.seq, cause, _name(recorded), what, one, other, measure)

    if recorded.kind is Kind.NOTE and computed.kind is Kind.NOTE:
        try:
            one, other = Note.unpack(recorded.data()), Note.unpack(computed.data())
        except ValueError:
            return differ(*first_byte(recorded.data(), computed.data()))
        for what in ("code", "level", "stream"):
            if getattr(one, what) != getattr(other, what):
                return differ(f"note.{what}", getattr(one, what), getattr(other, what))
    if _OUTSIDE(recorded) != _OUTSIDE(computed):
        for what in _COMPARED:
            if getattr(recorded, what) != getattr(computed, what):
                return differ(what, getattr(recorded, what), getattr(computed, what))
    if isinstance(recorded, DigestedOutput):
        digest = sha256()
        for part in computed.payload:
            digest.update(part)
        stated, found = (
            f"{value.hex()} ({counted(size, 'byte')})"
            for size, value in ((recorded.true_size, recorded.digest), (computed.size, digest.digest()))
        )
        return None if stated == found else differ(DIGEST, stated, found)
    if recorded.kind is Kind.NOTE or _equal(recorded.payload, computed.payload):
        return None
    return differ(*_first_field(recorded, computed), _measure(recorded, computed, decoder) if decoder else "")


def _equal(recorded: Sequence[Buffer], computed: Sequence[Buffer]) -> bool:
    """Return whether the bytes are equal; a single buffer from a file is compared without a copy."""
    one = recorded[0] if len(recorded) == 1 else join(recorded)
    other = join(computed)
    return memoryview(one).nbytes == len(other) and other.startswith(one)


def _measure(recorded: Entry, computed: Entry, decoder: LeafDecoder) -> str:
    try:
        return compare_values(decoder.leaves(recorded), decoder.leaves(computed)).measure
    except GatewayError:
        return ""  # not decodable: the bytes are reported


def _first_field(recorded: Entry, computed: Entry) -> tuple[str, Any, Any]:
    """Return path and values of the first field in which two payloads of one type differ."""
    one, other = recorded.data(), computed.data()
    try:
        for (path, value), (other_path, other_value) in zip(
            _fields(recorded, one), _fields(computed, other), strict=False
        ):
            if path != other_path:
                return path, value, f"nothing ({other_path} follows)"
            if not same(value, other_value):
                return path, value, other_value
    except GatewayError:
        pass  # not decodable: the bytes are reported
    return first_byte(one, other)


def _fields(entry: Entry, data: Buffer) -> Iterator[tuple[str, Any]]:
    if entry.kind is Kind.IGTL_OUT:
        description = describe(data)
        if description.get("error", {}).get("code") == ChecksumMismatch.code:
            del description["error"]  # `crc` has the reason
        # errors, sizes and CRC depend on the content: report the cause first
        for derived in ("error", "crc", "crc_ok", "body_size", "content_size"):
            if derived in description:
                description[derived] = description.pop(derived)
        return flattened(description, "")
    message = _MESSAGES.get(entry.type)
    return flattened(message.unpack(data), "") if message else iter(())


def _name(entry: Entry) -> str:
    return entry.channel or entry.kind.value


def _kind(entry: Entry) -> str:
    return f"{entry.kind.value} of {counted(entry.size, 'byte')}"


def _value_text(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 120 else f"{text[:100]}… ({counted(len(text), 'character')})"
