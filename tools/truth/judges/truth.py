"""The comparison: each sample with the world, and what an output shows about what is wrong in it."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from tools.truth.files import Recording
from tools.truth.judges.samples import Sample, Thing, moment_of
from tools.truth.senders import MS, Plan, Sent, Stream
from tools.truth.world import BEGIN_NS, SPEED

#: Largest distance of a value from the truth, mm, by its kind; float32 metres and pixels of a video are less exact.
VALUE_MM = 0.05
#: Largest difference of a stamp, ns, beside the resolution of 32.32 ticks; of a time of receipt, ns.
STAMP_NS, RECEIPT_NS = 3_000, MS
#: A value belongs to the message whose moment is nearest, if it is nearer than this, s.
_NEAR_S = 0.004

VALUE, NAME, TIME, PAIR, LOST = "value", "name", "time", "pair", "lost"

#: What an output has to state about a fault of each kind; a line that also names what it is about.
_STATES = {
    VALUE: ("rounded", "cut", "unit", "window", "bits", "not exact"),
    NAME: (
        *("same name", "one name", "share", "collid", "differ", "several", "distinguish", "more than one"),
        *("renamed", "written as", "called", "stands for", "named", "two peers", "two links", "two devices"),
        *(
            "not one movement",
            "two publishers",
            "two streams",
            "two senders",
            r"is (the |that of )?(device|stream|TRANSFORM/)",
        ),
    ),
    TIME: (
        "clock",
        "ahead",
        "behind",
        "apart",
        "offset",
        "correct",
        "receipt",
        "no stamp",
        "without.* stamp",
        "unstamped",
    ),
    PAIR: (
        *("ahead", "behind", "apart", "offset", "two clocks", "other clock", "clocks differ", "different clocks"),
        *("no stamp", "without.* stamp", "unstamped", "not corrected"),
    ),
    LOST: (
        *(
            r"[\d,]+ +[\d,]+ +[1-9][\d,]*( |$)",
            "left out",
            "missing",
            "lost",
            "cannot",
            "latched",
            "invalid",
            "removed",
        ),
        *("unusable", "refused", "dropped", "rejected", "without", "found no", "newest", "not a "),
        *(r"not (exported|written|shown|drawn|recorded|sent|stored|in)", r"no (pose|message|value)"),
    ),
}


@dataclass
class Fault:
    """Something wrong.

    Attributes:
        kind: of it.
        about: names of streams, devices or frames that an output has to name; empty: none.
        text: for the reader of the table.
    """

    kind: str
    about: tuple[str, ...]
    text: str


@dataclass
class Findings:
    """What the judge found in one result.

    Attributes:
        samples: compared.
        faults: all that is wrong, one for each kind, stream and name.
    """

    samples: int = 0
    faults: list[Fault] = field(default_factory=list)
    seen: dict[Thing, set[int]] = field(default_factory=lambda: defaultdict(set))
    _known: set[tuple[str, str]] = field(default_factory=set)

    def fault(self, kind: str, about: Sequence[str], text: str) -> None:
        key = (kind, " ".join(about))
        if key not in self._known:
            self._known.add(key)
            self.faults.append(Fault(kind, tuple(about), text))


def is_stated(fault: Fault, text: str) -> bool:
    """Whether an output names a fault: a line with words of its kind, and one of the names that it is about."""
    for line in text.splitlines():
        if re.search("|".join(_STATES[fault.kind]), line) and (
            not fault.about or any(each in line for each in fault.about)
        ):
            return True
    return False


def things_of(stream: Stream) -> list[Thing]:
    """The things that a stream is about."""
    if stream.kind in ("image", "ros_image"):
        return [("picture", stream.things[0])]
    if stream.kind in ("cloud", "polydata"):
        return [("cloud", stream.things[0])]
    if stream.kind == "joints":
        return [("joint", stream.things[0], number) for number in range(3)]
    if stream.kind in ("transform", "pose", "tf", "tdata"):
        return [("pose", thing) for thing in stream.things]
    return [({"string": "text", "tf_static": "static"}.get(stream.kind, stream.kind), 0)]


class Truth:
    """A world, ready to be asked."""

    def __init__(self, plan: Plan, recording: Recording) -> None:
        self.plan, self.recording = plan, recording
        self.sent: dict[Thing, list[Sent]] = defaultdict(list)
        for one in plan.messages():
            for thing in things_of(one.stream):
                self.sent[thing].append(one)
        for each in self.sent.values():
            each.sort(key=lambda one: one.true_ns)
        self._words = _words(plan)

    def message(self, thing: Thing, at: float | None) -> Sent | None:
        """The message of a thing whose moment is nearest to a time; None if none is near."""
        sent = self.sent.get(thing if thing[0] != "plan" else ("point", 0), [])
        if at is None or not sent:
            return sent[0] if sent else None
        place = bisect_left(sent, at * 1e9, key=lambda one: one.true_ns)
        near = min(sent[max(place - 1, 0) : place + 1], key=lambda one: abs(one.true_ns / 1e9 - at))
        return near if abs(near.true_ns / 1e9 - at) < _NEAR_S else None

    def judge(self, samples: Iterable[Sample], *, interpolated: bool = False) -> Findings:
        """Compare all samples with the truth.

        Args:
            samples: of one result.
            interpolated: whether values between messages are allowed.
        """
        findings = Findings()
        named: dict[tuple[str, str], Thing] = {}
        for sample in samples:
            findings.samples += 1
            thing, at, off = moment_of(sample)
            about = (sample.stream, *((sample.name,) if sample.name else ()))
            if not off <= VALUE_MM:
                findings.fault(VALUE, about, f"{sample.stream} {sample.name or ''}: {off:.3g} mm from every truth")
                continue
            sent = self.message(thing, at)
            if sent is None:
                if not (interpolated and thing in self.sent):
                    findings.fault(VALUE, about, f"{sample.stream}: {thing} at {at} s is no message")
                continue
            findings.seen[thing].add(sent.true_ns)
            self._judge_name(sample, thing, named, findings)
            self._judge_times(sample, sent, about, findings)
        return findings

    def _judge_name(
        self, sample: Sample, thing: Thing, named: dict[tuple[str, str], Thing], findings: Findings
    ) -> None:
        if sample.name is None or thing[0] in ("plan", "static", "text", "depth"):
            return
        other = named.setdefault((sample.stream, sample.name), thing)
        if other != thing:
            about = self.names_of(other) | self.names_of(thing) | {sample.name or sample.stream}
            text = f"{sample.stream} {sample.name}: both {other} and {thing}"
            findings.fault(NAME, sorted(about - {""}), text)
        allowed = self._allowed(sample)
        if allowed and thing not in allowed:
            about = self.names_of(thing) | {sample.name or sample.stream}
            text = f"{sample.stream} {sample.name}: shows {thing}, expected one of {sorted(map(str, allowed))}"
            findings.fault(NAME, sorted(about - {""}), text)

    def names_of(self, thing: Thing) -> set[str]:
        """The names under which senders send a thing: devices or topics, and frames or tools."""
        found = set()
        for stream in self.plan.streams:
            if thing in things_of(stream):
                device = stream.key.partition("/")[2] if not stream.is_ros else stream.key
                found.add(device)
                child, _, parent = device.partition("To")
                if child and parent:  # on /tf a device is a frame in its parent
                    found.add(f"{child} in {parent}")
                if stream.names:
                    found.add(stream.names[things_of(stream).index(thing)])
        return found

    def _allowed(self, sample: Sample) -> set[Thing]:
        """The things that a name of a result can mean; empty: not known."""
        if sample.kind == "joint":
            return {
                thing for thing in self.sent if thing[0] == "joint" and sample.name == f"arm{thing[1]}_joint{thing[2]}"
            }
        kind = moment_of(sample)[0][0]
        text = _plain(f"{sample.stream}/{sample.name}")
        found = [(word, thing) for word, thing in self._words if thing[0] == kind and word in text]
        longest = max((len(word) for word, _ in found), default=0)
        return {thing for word, thing in found if len(word) == longest}

    def _judge_times(self, sample: Sample, sent: Sent, about: Sequence[str], findings: Findings) -> None:
        shift_ns = self.recording.shift_ns
        sender = sent.stream.sender
        received = [BEGIN_NS + sent.receipt_ns + shift_ns]
        corrected = self.plan.recorder_offset_ns if sender.recorder else 0
        stamps = [sent.stamp_ns + shift_ns] if sent.stamp_ns else []
        if sent.stream.is_ros and sender.stamped:
            stamps.append(sender.shows(sent.receipt_ns - sender.delay_ns) + shift_ns)
        stamps += [each - corrected for each in stamps]
        # tools of one TDATA were seen at different moments: half a period of the frame that is seen more often
        is_output = "TDATA" in sample.stream and sent.stream.is_ros
        within_ns = round(5e8 / sent.stream.rate) + STAMP_NS if is_output else STAMP_NS
        if (
            sample.source_ns
            and not _near(sample.source_ns, stamps, within_ns)
            and not (not sender.stamped and _near(sample.source_ns, [*received, received[0] + corrected], RECEIPT_NS))
        ):
            findings.fault(TIME, about, _time_text(sample.stream, "source", sample.source_ns, stamps or received))
        if sample.stamp_ns and not _near(sample.stamp_ns, stamps, within_ns):
            if sent.stamp_ns or not _near(sample.stamp_ns, received, RECEIPT_NS):
                findings.fault(TIME, about, _time_text(sample.stream, "stamp", sample.stamp_ns, stamps or received))
        late_ns = RECEIPT_NS + self.recording.rounded_ns
        # what was latched before a part is shown at its beginning
        is_latched = sent.stream.kind in ("point", "tf_static", "polydata") and not self.recording.whole
        is_later = is_latched and sample.time_ns > received[0]
        if sample.time_ns and not (is_output or is_later) and not _near(sample.time_ns, received, late_ns):
            findings.fault(TIME, about, _time_text(sample.stream, "receipt", sample.time_ns, received))

    def lost(self, findings: Findings, kinds: Sequence[str], asked: Collection[str] | None = None) -> None:
        """Add a fault for each stream of these kinds of which a result has less than the file should have.

        ``asked`` are the keys of the streams that were asked for; None: all.
        """
        for stream in self.plan.streams:
            if stream.kind not in kinds or (asked is not None and stream.key not in asked):
                continue
            for thing in things_of(stream):
                wanted = {one.true_ns for one in self.sent[thing] if one.stream is stream}
                found = findings.seen.get(thing if thing[0] != "point" else ("plan", "P1"), set())
                # a header of version 3 is refused, so its message is not the state of anything
                kept = "recover" not in self.plan.files and stream.sender.version < 3
                latched = stream.kind in ("point", "tf_static") and kept
                if (latched and wanted and not found) or (self.recording.whole and wanted - found):
                    # a note about a type is about all streams of it, but not about those of a part of the recording
                    names = {
                        stream.key,
                        *stream.key.split("/", 1)[latched and not self.recording.whole :],
                        *self.names_of(thing),
                    }
                    about = sorted(names - {""})
                    findings.fault(LOST, about, f"{stream.key}: {len(wanted & found)} of {len(wanted)} are there")

    def _receipt_s(self, thing: Thing, at: float) -> float:
        """When a value of a moment was received, s; between two messages, as they were."""
        sent = self.sent[thing]
        place = min(max(bisect_left(sent, at * 1e9, key=lambda one: one.true_ns), 1), len(sent) - 1)
        before, after = sent[place - 1], sent[place]
        share = (at * 1e9 - before.true_ns) / max(after.true_ns - before.true_ns, 1)
        return (before.receipt_ns + share * (after.receipt_ns - before.receipt_ns)) / 1e9

    def _within_s(self, thing: Thing, nearest: bool) -> float:
        """Half a period of the streams of a thing, s: as far as the nearest message can be."""
        rates = [one.stream.rate for one in self.sent[thing][:1]]
        return 0.5 / min(rates) if nearest and rates and min(rates) else 0.0

    def judge_frames(
        self,
        frames: Iterable[tuple[Sample, Sequence[Sample]]],
        findings: Findings,
        within_s: float,
        stated: str = "",
        *,
        nearest: bool = False,
    ) -> None:
        """Compare what stands together in a frame: a picture and the values at its time.

        Args:
            frames: a reference and the others.
            findings: gets the faults.
            within_s: largest distance in true time.
            stated: clock that the result states, "gateway" or ""; values are together by receipt then, and where
                neither sender has stamps.
            nearest: half a period of the stream is allowed as well.
        """
        allowed_s = within_s
        for reference, others in frames:
            mine, at, off = moment_of(reference)
            if at is None or not off <= VALUE_MM:
                continue  # is a fault already
            for other in others:
                thing, then, _ = moment_of(other)
                within_s = allowed_s + self._within_s(thing, nearest)
                if then is None or abs(then - at) <= within_s:
                    continue
                senders = [self.sent[each][0].stream.sender for each in (mine, thing) if self.sent.get(each)]
                if len(senders) < 2:
                    continue  # of no thing: its value is a fault already
                by_receipt = stated == "gateway" or not any(sender.stamped for sender in senders)
                if by_receipt and abs(self._receipt_s(thing, then) - self._receipt_s(mine, at)) <= within_s:
                    continue
                about = sorted(self.names_of(mine) | self.names_of(thing))
                away = f"{(then - at) * 1000:.1f} ms, {abs(then - at) * SPEED:.1f} mm"
                findings.fault(PAIR, about, f"{other.name or other.stream} beside {reference.stream}: {away}")


def _near(found: int, wanted: Sequence[int], within: int) -> bool:
    return any(abs(found - each) <= within for each in wanted)


def _time_text(stream: str, what: str, found: int, wanted: Sequence[int]) -> str:
    nearest = min(wanted, key=lambda each: abs(each - found)) if wanted else 0
    return f"{stream}: {what} {(found - nearest) / 1e6:+.3f} ms"


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _words(plan: Plan) -> list[tuple[str, Thing]]:
    """Words in names of results, and the things that they stand for."""
    found: list[tuple[str, Thing]] = []
    for stream in plan.streams:
        things = things_of(stream)
        for number, thing in enumerate(things):
            if stream.names:
                words = [stream.names[number]]
            elif stream.is_ros:
                words = [stream.key]
            else:
                device = stream.key.partition("/")[2]
                words = [device, device.partition("To")[0]] if "To" in device[1:] else [device]
                words = [each for each in words if each]
            found += [(_plain(each), thing) for each in words]
    return found
