"""The loss ledger of a session as lines for people: at the end of a bridge, and of a recording."""

from __future__ import annotations

from typing import Any

from igtl_gateway.base.quantities import count_text
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.fates import DROPPED, NOT_FOR, REFUSED_COMMANDS
from igtl_gateway.gateway.log.ledger import PEERS, gaps
from igtl_gateway.record.sessionfile import layout

#: What the log calls it → what people call it.
DIRECTIONS = {
    Kind.IGTL_IN: "OpenIGTLink in",
    Kind.IGTL_OUT: "OpenIGTLink out",
    Kind.ROS_IN: "ROS in",
    Kind.ROS_OUT: "ROS out",
}

#: Reason of a loss → its text for people.
_REASONS = DROPPED | {code: f"command refused: {text}" for code, text in REFUSED_COMMANDS.items()}

#: The code of the note → what people call it; others stand for themselves.
_LINK_FAULTS = {
    "truncated": "disconnected inside a message",
    "too_large": "message above the size limit, or not OpenIGTLink",
    "stalled": "pause inside a message, or transfer rate too low",
    "unreachable": "peer unreachable",
    "idle": "no traffic for the idle time",
    "queue_full": "send queue full of messages that must not be dropped",
    "refused": "TLS on an address without TLS",
    "tls_failed": "invalid TLS",
    "websocket_failed": "invalid WebSocket",
}


#: What the counts of video call it → what people call it.
_VIDEO = {
    "queue_full": "faster than its codec",
    "refused": "not encoded: see the note video_refused",
    "broken": "not valid",
    "internal_error": "an internal error: see the note video_failed",
    "no_key_frame": "before a key frame",
    "no_picture": "no picture yet: the codec looks ahead",
    "too_many_streams": "more streams than are served",
    "stopped": "waited when the bridge stopped",
    "upper_8_of_16_bits": "encoded by the upper 8 of 16 bits",
    "without_alpha": "encoded without alpha",
    "padded_to_even": "encoded with a repeated last column or row: its size was odd",
}

#: Of a split recording whose last part is not the last one.
NO_END = "unknown: the last part was closed for a next one, which is not there"


def _side(direction: str) -> str:
    return DIRECTIONS[Kind(direction)] if direction in {kind.value for kind in DIRECTIONS} else direction


def reason_text(reason: str) -> str:
    """Return the text of a reason of a loss; a word of another version stands for itself."""
    if reason.startswith(NOT_FOR) and reason not in _REASONS:
        return f"not sent to a peer of profile {reason.removeprefix(NOT_FOR)}"
    return _REASONS.get(reason, reason)


def losses(ledger: dict[str, Any] | None) -> list[str]:
    """Return the losses, and the sums of the ledger that do not close, as lines; empty without either."""
    if ledger is None:
        return ["   unknown: the recording has no ledger"]
    lines = []
    if layout.CUT_OFF_KEY in ledger and layout.GOES_ON_KEY in ledger:
        lines.append(f"   {NO_END}")
    elif layout.CUT_OFF_KEY in ledger and (why := ledger.get("recorder", {}).get("failure")):
        lines.append(f"   unknown: {why}; the file has what was written before")
    elif layout.CUT_OFF_KEY in ledger:
        lines.append(
            "   unknown: the bridge was killed; its recorder wrote all entries that it received and closed the file"
        )
    recovered = ledger.get("recovered")
    if recovered:
        places = len(recovered["lost"]) + recovered["more_lost"]
        lines.append(
            f"recovered from {recovered['from']} by {recovered['by']}: "
            + ("nothing was lost" if recovered["whole"] else f"{count_text(places, 'loss', 'losses')}, see --json")
        )
        if "streams" not in ledger:
            lines.append("   unknown: the recording was not closed, so it has no counts")
    lines += [f"LEDGER DOES NOT CLOSE: {gap}" for gap in gaps(ledger)]
    for direction, streams in ledger.get("streams", {}).items():
        for stream, fates in streams.items() if direction != PEERS else ():  # shown with their links
            for reason, number in fates.get("dropped", {}).items():
                lines.append(f"{number:>7,}  {_side(direction)} {stream}: {reason_text(reason)}")
    for link, fates in ledger.get("links", {}).items():
        peer = "closed links" if link == "0" else f"link {link}"
        for fate, reason in (("dropped", "send queue full, or link closed"), ("ignored", "link was closed already")):
            for stream, number in fates.get(fate, {}).items():
                lines.append(f"{number:>7,}  to {peer}, {stream}: {reason}")
    for code, number in ledger.get("link_faults", {}).items():
        lines.append(f"{number:>7,}  links: {_LINK_FAULTS.get(code, code)}")
    for topic, counts in ledger.get("ros_topics", {}).items():
        if number := counts.get("lost", 0):
            lines.append(f"{number:>7,}  ROS in {topic}: lost before the bridge received them")
    for side, streams in ledger.get("video", {}).items():
        for stream, counts in streams.items():
            for fate in ("dropped", "changed"):
                for reason, number in counts.get(fate, {}).items():
                    lines.append(f"{number:>7,}  {side} {stream}: {_VIDEO.get(reason, reason)}")
    recorder = ledger.get("recorder", {})
    if recorder.get("dropped_entries"):
        why = "its queue was full, or the disk failed"
        lines.append(f"{recorder['dropped_entries']:>7,}  entries that the recorder dropped: {why}")
    return lines
