"""The report of ``doctor``: peers, streams, findings, and the probable cause."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.natural import natural
from igtl_gateway.base.quantities import count_text, rate_text
from igtl_gateway.doctor.observations import ObservedStream
from igtl_gateway.doctor.observer import Observer
from igtl_gateway.doctor.rules import RuleFinding, Severity, judge


@dataclass(frozen=True, slots=True)
class DoctorReport:
    """The findings about a session.

    Attributes:
        observed: the observations.
        findings: in the order of the rules.
    """

    observed: Observer
    findings: tuple[RuleFinding, ...]

    @classmethod
    def of(cls, observed: Observer) -> DoctorReport:
        """Apply the rules to the observations."""
        return cls(observed, tuple(judge(observed)))

    @property
    def cause(self) -> RuleFinding | None:
        """The finding that explains most: the first error, or the first warning if there is no error."""
        for severity in (Severity.ERROR, Severity.WARNING):
            for finding in self.findings:
                if finding.rule.severity is severity:
                    return finding
        return None

    @property
    def failed(self) -> bool:
        """Whether there is an error among the findings."""
        return any(finding.rule.severity is Severity.ERROR for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        observed, cause = self.observed, self.cause
        return {
            "nothing_arrives": not observed.good,
            "cause": cause.to_dict() if cause else None,
            "findings": [finding.to_dict() for finding in self.findings],
            "peers": [
                {
                    "link": peer.number,
                    "peer": peer.address,
                    "role": peer.role,
                    "connected": bool(peer.up_ns and not peer.down_ns),
                    "messages": peer.messages,
                    "header_versions": {
                        str(version): count for version, count in sorted(peer.received_versions.items())
                    },
                    "reason": peer.reason,
                }
                for peer in observed.peers.values()
            ],
            "streams": [_stream(stream) for stream in observed.streams.values()],
        }

    def peer_lines(self) -> Iterator[str]:
        """Yield a line for each peer."""
        for peer in self.observed.peers.values():
            side = "client" if peer.role == "server" else "server"
            versions = ", ".join(f"header version {version}" for version in sorted(peer.received_versions))
            count = count_text(peer.messages, "message")
            yield f"  {peer.name}: {side}; {count}{', ' if versions else ''}{versions}"

    def stream_rows(self) -> list[tuple[str, ...]]:
        """Return a table of the streams, the first row being its titles; empty without streams."""
        rows = [
            (
                stream.name,
                f"{stream.messages:,}",
                rate_text(stream.rate_hz) if stream.rate_hz else "",
                f"{_stream(stream)['crc']}, {stream.timing}",
            )
            for stream in self.observed.streams.values()
        ]
        return [("stream", "messages", "rate", ""), *sorted(rows, key=lambda row: natural(row[0]))] if rows else []

    def finding_lines(self) -> Iterator[str]:
        """Yield the lines of the findings, and the probable cause."""
        last, number = "", 0
        for finding in self.findings:
            rule, match = finding.rule, finding.match
            number = number + 1 if rule.id == last else 1
            if number == 1:
                yield f"{rule.severity.value.upper():<7} {rule.id}  {rule.title}"
                yield f"        {rule.advice}  [{rule.section}]"
            if number <= rule.shown:
                is_named = match.text.partition(": ")[0].split(" ")[-1] == match.where
                yield f"        - {match.text if is_named else f'{match.where}: {match.text}'}"
            elif number == rule.shown + 1:
                more = sum(other.rule is rule for other in self.findings) - rule.shown
                yield f"        - and {more:,} more, see --json"
            last = rule.id
        cause = self.cause
        if cause:
            why = "probable cause" if not self.observed.good else "most important finding"
            yield f"{why}: {cause.rule.title} ({cause.rule.id}): {cause.match.text}"
        elif self.findings:
            first = self.findings[0]
            yield f"no problems found, but see {first.rule.id}: {first.rule.title}: {first.match.text}"
        else:
            yield "no problems found"


def _stream(stream: ObservedStream) -> dict[str, Any]:
    bad = stream.bad_crc
    return {
        "link": stream.link,
        "stream": stream.name,
        "messages": stream.messages,
        "bytes": stream.bytes,
        "rate_hz": round(stream.rate_hz, 3),
        "header_versions": sorted(stream.versions),
        "crc": f"CRC of {bad:,} wrong" if bad else "CRC right",
        "decoded": stream.good,
        "stamps": stream.timing.to_dict(),
    }
