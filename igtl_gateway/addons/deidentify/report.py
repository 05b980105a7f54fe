"""The report: for each rule what it changed and how often, what was left and why."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.addons.deidentify.rules import NOT_COVERED, OPTIONS, RULES


@dataclass(slots=True)
class Report:
    """Counts of one run.

    Attributes:
        rules: name of the rule → number of changes.
        streams: new name of the stream → rule → number of changed messages.
        removed: new name of the stream → number of removed messages.
        left: what was left → reason.
        kept_times: whether the times are those of the recording.
        unused: row of the profile that matches nothing → question with names of the recording, for the screen only.
    """

    rules: Counter[str] = field(default_factory=Counter)
    streams: dict[str, Counter[str]] = field(default_factory=dict)
    removed: Counter[str] = field(default_factory=Counter)
    left: dict[str, str] = field(default_factory=dict)
    unused: dict[str, str] = field(default_factory=dict)
    kept_times: bool = False
    inputs: int = 0
    outputs: int = 0

    def add(self, rule: str, number: int = 1) -> None:
        """Count changes by a rule."""
        if rule not in RULES:
            raise KeyError(rule)
        self.rules[rule] += number

    @property
    def options(self) -> dict[str, str]:
        """The options of DICOM PS3.15 that were applied: code → meaning.

        113101 only if no picture is left without a mask; 113102 never.
        """
        codes = {"113100", "113104", "113105", "113106" if self.kept_times else "113107"}
        if not any("no mask" in reason for reason in self.left.values()):
            codes.add("113101")
        if self.rules["kept type"]:
            codes.add("113111")
        return {code: OPTIONS[code] for code in sorted(codes)}

    @property
    def may_miss_pictures(self) -> bool:
        """Whether pictures are left without a mask, and a mask of the profile matches no stream."""
        return "pixels" in self.left and any(place.startswith("mask") for place in self.unused)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON values; it has no name of the recording."""
        return {
            "inputs": self.inputs,
            "outputs": self.outputs,
            "options": self.options,
            "rules": [
                {"rule": rule.name, "changes": self.rules[rule.name], "what": rule.what, "action": rule.action.value,
                 "option": "113106" if rule.name == "time" and self.kept_times else rule.option}
                for rule in RULES.values()
            ],
            "streams": {name: dict(sorted(counts.items())) for name, counts in sorted(self.streams.items())},
            "removed": dict(sorted(self.removed.items())),
            "left": dict(sorted(self.left.items())),
            "unused": sorted(self.unused),
            "not_covered": list(NOT_COVERED),
        }  # fmt: skip
