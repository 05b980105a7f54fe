"""Sessions computed again, compared and judged: verification, differences, seals, findings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.app.linting import observe as observe_entries
    from igtl_gateway.app.sealing import SealVerification as SealVerification
    from igtl_gateway.app.sealing import verify_seal as verify_seal
    from igtl_gateway.app.verification import Verification as Verification
    from igtl_gateway.app.verification import recorded_by as recorded_by
    from igtl_gateway.app.verification import segments_of as segments_of
    from igtl_gateway.app.verification import verify_recording as verify_recording
    from igtl_gateway.app.verification import verify_segment_of as verify_segment_of
    from igtl_gateway.app.verification import verify_session as verify_session
    from igtl_gateway.doctor.report import DoctorReport as DoctorReport
    from igtl_gateway.doctor.rules import RULES as RULES
    from igtl_gateway.gateway import Session as Session
    from igtl_gateway.gateway import make_core as make_core
    from igtl_gateway.gateway.log.ledger import gaps as ledger_gaps
    from igtl_gateway.record.sessionfile.layout import IMPORTED_KEY as IMPORTED
    from igtl_gateway.record.sessionfile.seal_check import UNSEALED as UNSEALED
    from igtl_gateway.replay.compare import EXACT as EXACT
    from igtl_gateway.replay.compare import Delta as Delta
    from igtl_gateway.replay.compare import ElementArray as ElementArray
    from igtl_gateway.replay.compare import LeafDecoder as LeafDecoder
    from igtl_gateway.replay.compare import Tolerance as Tolerance
    from igtl_gateway.replay.compare import Undecodable as Undecodable
    from igtl_gateway.replay.compare import compare_values as compare_values
    from igtl_gateway.replay.compare import first_byte as first_byte
    from igtl_gateway.replay.content_summary import ContentSummary as ContentSummary
    from igtl_gateway.replay.diff import DiffInput as DiffInput
    from igtl_gateway.replay.diff import StreamDiff as StreamDiff
    from igtl_gateway.replay.diff import diff as diff
    from igtl_gateway.replay.segments import Segment as Segment
    from igtl_gateway.replay.segments import SegmentResult as SegmentResult
    from igtl_gateway.replay.segments import verify_in_segments as verify_in_segments
    from igtl_gateway.replay.verify import VerifyReport as VerifyReport

#: Names that are others there; the rest of the group is above.
__all__ = ["IMPORTED", "ledger_gaps", "observe_entries"]

HOMES: Homes = (
    # The gateway: inputs of a session to its outputs
    ("gateway", "Session make_core"),
    ("app.verification", "Verification recorded_by segments_of verify_recording verify_segment_of verify_session"),
    ("record.sessionfile.layout", "IMPORTED=IMPORTED_KEY"),
    ("replay.segments", "Segment SegmentResult verify_in_segments"),
    ("replay.verify", "VerifyReport"),
    # Differences of messages and of recordings
    ("replay.compare", "Delta EXACT ElementArray LeafDecoder Tolerance Undecodable compare_values first_byte"),
    ("replay.diff", "DiffInput StreamDiff diff"),
    # Seals
    ("app.sealing", "SealVerification verify_seal"),
    ("record.sessionfile.seal_check", "UNSEALED"),
    # Findings about a session, and what it contains
    ("doctor.report", "DoctorReport"),
    ("doctor.rules", "RULES"),
    ("app.linting", "observe_entries=observe"),
    ("replay.content_summary", "ContentSummary"),
    ("gateway.log.ledger", "ledger_gaps=gaps"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
