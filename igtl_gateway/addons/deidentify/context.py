"""What the rules of one session share: profile, names, times, pictures and the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from igtl_gateway.addon import matches
from igtl_gateway.addon.messages import TO_ROS
from igtl_gateway.addon.reading import CLOCK_DEVICE
from igtl_gateway.addons.deidentify.pixels import PixelCleaner
from igtl_gateway.addons.deidentify.profile import Profile
from igtl_gateway.addons.deidentify.pseudonyms import WORDS, Pseudonyms, TimeShift
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.addons.deidentify.unused import Asked


class Removed(Exception):
    """A message that has to be removed.

    Attributes:
        rule: name of the rule.
    """

    def __init__(self, rule: str) -> None:
        super().__init__(rule)
        self.rule = rule


@dataclass(slots=True)
class Context:
    """See the module.

    Attributes:
        profile: what may stay.
        names, times: pseudonyms and the shift.
        report: counts.
        asked: what the profile was asked about.
        pixels: masks of pictures.
    """

    profile: Profile
    names: Pseudonyms
    times: TimeShift
    report: Report
    asked: Asked = field(default_factory=Asked)
    pixels: PixelCleaner = field(init=False)

    @classmethod
    def of(cls, profile: Profile, key: bytes, shift_ns: int | None) -> Context:
        """Return a context; ``shift_ns`` None: from the key."""
        report = Report(kept_times=shift_ns == 0)
        words = WORDS | {CLOCK_DEVICE} | {row.kind for row in TO_ROS}
        names = Pseudonyms(key, profile.names, profile.keep_names, words, lambda: report.add("name"))
        asked = Asked(names=names.asked)
        times = TimeShift(names.shift_ns() if shift_ns is None else shift_ns, lambda: report.add("time"))
        return cls(profile, names, times, report, asked)

    def __post_init__(self) -> None:
        self.pixels = PixelCleaner(self.profile, self.report, self.asked.streams)

    def text(self, text: str, stream: str) -> str:
        """Return the new text of a stream."""
        self.asked.streams.add(stream)
        new = self.profile.text_rule(stream).apply(text) if text else text
        if new != text:
            self.report.add("text")
        elif text:
            self.report.left.setdefault(f"text of {self.stream_label(stream)}", "the profile keeps it")
        return new

    def patient_name(self, name: str) -> str:
        """Return "", the new name of every patient."""
        self.report.add("patient", bool(name))
        return ""

    def patient_id(self, identifier: str) -> str:
        """Return the pseudonym of an identifier."""
        self.report.add("patient", bool(identifier))
        return self.names.identifier(identifier)

    def keeps_type(self, name: str) -> bool:
        """Return whether the profile keeps messages of a type without a known layout."""
        self.asked.types.add(name)
        return any(matches(glob, name) for glob in self.profile.keep_types)

    def keeps_key(self, key: str) -> bool:
        """Return whether the profile keeps a key of metadata."""
        self.asked.keys.add(key)
        return any(matches(glob, key) for glob in self.profile.keep_metadata)

    def stream_name(self, stream: str) -> str:
        """Return the new name of a stream: of a topic, or of TYPE/device."""
        return _of_stream(stream, self.names.name)

    def stream_label(self, stream: str) -> str:
        """As ``stream_name``, for the report: it counts as no replaced name."""
        return _of_stream(stream, self.names.label)


def _of_stream(stream: str, name: Callable[[str], str]) -> str:
    if stream.startswith("/") or not stream:
        return "/".join(map(name, stream.split("/")))
    kind, _, device = stream.partition("/")
    return f"{kind}/{name(device)}"
