"""``cohort verify`` of a long recording: its segments are tasks of their own.

The states at both ends of each joint show whether the segments are the recording; where they do not, the file is one
task.
"""

from __future__ import annotations

from collections.abc import Sequence

from igtl_gateway.addon.checking import Segment, SegmentResult, verify_in_segments
from igtl_gateway.addons.cohort import ends
from igtl_gateway.addons.cohort.jobs import SEGMENT, SEGMENTS, verification_row
from igtl_gateway.addons.cohort.run import KnownFile, Reply, Runner, RunSettings

#: Bytes of a segment, about, and the most segments of a file.
_BYTES, _MOST = 32 << 20, 64
#: How often a segment is tried again alone whose worker died: another one may have been the cause.
_AGAIN = 2


def is_long(work: RunSettings, item: KnownFile) -> bool:
    """Return whether a file may be verified in segments."""
    return work.verb == "verify" and item.file.size >= 2 * _BYTES


def in_segments(work: RunSettings, item: KnownFile, do: Runner) -> Reply | None:
    """Return the reply for a file whose segments are tasks; None: the file has to be one task."""
    most = min(_MOST, item.file.size // _BYTES)
    reply = next(reply for _, reply in do(work, [item._replace(part={SEGMENTS: most})]))
    if reply["status"] == ends.UNCHANGED:
        return reply
    plan = reply["rows"][SEGMENTS][0] if reply["status"] == ends.OK else {}
    if not plan.get("segments"):
        return None
    seconds = [reply["seconds"]]

    def run(segments: Sequence[Segment]) -> list[SegmentResult | None]:
        found: dict[int, SegmentResult | None] = {}
        waiting = {number: item._replace(part={SEGMENT: each.to_dict()}) for number, each in enumerate(segments)}
        for _ in range(1 + _AGAIN):
            numbers = {id(each): number for number, each in waiting.items()}
            for each, part in do(work, list(waiting.values())):
                number = numbers[id(each)]
                seconds.append(part.get("seconds", 0.0))
                if part["status"] == ends.KILLED:
                    continue
                rows = part["rows"].get(SEGMENT, [None]) if part["status"] == ends.OK else [None]
                found[number] = rows[0] and SegmentResult(**rows[0])
                del waiting[number]
            if not waiting:
                break
        return [found.get(number) for number in range(len(segments))]

    report = verify_in_segments([Segment.from_dict(each) for each in plan["segments"]], run, plan["entries"])
    if report is None:
        return None
    row = verification_row(report, plan["recorded_by"])
    return reply | {"rows": {"verifications": [row]}, "seconds": sum(seconds)}
