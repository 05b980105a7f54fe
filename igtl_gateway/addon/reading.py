"""Recordings: as the streams of the Python API, or as the entries of a session."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.api.moments import Moment as Moment
    from igtl_gateway.api.moments import to_ns as to_ns
    from igtl_gateway.api.recording import Recording as Recording
    from igtl_gateway.api.recording import of_session as of_session
    from igtl_gateway.api.recording import open as open_recording
    from igtl_gateway.api.recording import session_of as session_of
    from igtl_gateway.api.stream import RecordedMessage as RecordedMessage
    from igtl_gateway.api.stream import Stream as Stream
    from igtl_gateway.api.verbs import AnyRecording as AnyRecording
    from igtl_gateway.base.buffers import Buffer as Buffer
    from igtl_gateway.base.buffers import join as join
    from igtl_gateway.base.qos import Endpoint as Endpoint
    from igtl_gateway.base.qos import Qos as Qos
    from igtl_gateway.base.qos import incompatible as incompatible
    from igtl_gateway.gateway.log.clock_offset import ANSWERS as CLOCK_ANSWERS
    from igtl_gateway.gateway.log.clock_offset import DEVICE as CLOCK_DEVICE
    from igtl_gateway.gateway.log.clock_offset import QUESTIONS as CLOCK_QUESTIONS
    from igtl_gateway.gateway.log.entry import Entry as Entry
    from igtl_gateway.gateway.log.entry import Kind as Kind
    from igtl_gateway.gateway.log.groups import input_groups as input_groups
    from igtl_gateway.gateway.log.marks import Mark as Mark
    from igtl_gateway.gateway.log.marks import MarkNote as MarkNote
    from igtl_gateway.gateway.log.marks import ago_ns as ago_ns
    from igtl_gateway.gateway.log.note import Level as Level
    from igtl_gateway.gateway.log.note import Note as Note
    from igtl_gateway.record.retention.stored import RecordingFolder as RecordingFolder
    from igtl_gateway.record.retention.stored import StoredRecording as StoredRecording
    from igtl_gateway.record.retention.stored import identity_of as file_identity
    from igtl_gateway.record.retention.stored import open_unlinked as open_unlinked
    from igtl_gateway.record.retention.upload_state import FileState as FileState
    from igtl_gateway.record.retention.upload_state import UploadState as UploadState
    from igtl_gateway.record.retention.upload_state import UploadStates as UploadStates
    from igtl_gateway.record.retention.upload_state import base_of as recording_name
    from igtl_gateway.record.retention.upload_state import belongs as is_of_recording
    from igtl_gateway.record.sessionfile import layout as layout
    from igtl_gateway.record.sessionfile import records as records
    from igtl_gateway.record.sessionfile.added_marks import added_marks as added_marks
    from igtl_gateway.record.sessionfile.added_marks import marks_files as marks_files
    from igtl_gateway.record.sessionfile.bulk import MessageBlock as MessageBlock
    from igtl_gateway.record.sessionfile.bulk import block_of as block_of
    from igtl_gateway.record.sessionfile.bulk import check_time as check_time
    from igtl_gateway.record.sessionfile.bulk import gathered as gathered
    from igtl_gateway.record.sessionfile.bulk import joined_blocks as joined_blocks
    from igtl_gateway.record.sessionfile.columns import EntryColumns as EntryColumns
    from igtl_gateway.record.sessionfile.columns import Stream as EntryStream
    from igtl_gateway.record.sessionfile.columns import Unfit as Unfit
    from igtl_gateway.record.sessionfile.columns import in_larger_blocks as in_larger_blocks
    from igtl_gateway.record.sessionfile.index import read_index as read_index
    from igtl_gateway.record.sessionfile.index import read_record as read_record
    from igtl_gateway.record.sessionfile.index import recover_hint as recover_hint
    from igtl_gateway.record.sessionfile.only import only_of_kinds as only_of_kinds
    from igtl_gateway.record.sessionfile.order import message_rows as message_rows
    from igtl_gateway.record.sessionfile.places import MessagePlace as MessagePlace
    from igtl_gateway.record.sessionfile.places import messages_at as messages_at
    from igtl_gateway.record.sessionfile.ranges import RangeFile as RangeFile
    from igtl_gateway.record.sessionfile.ranges import named as named
    from igtl_gateway.record.sessionfile.reader import SessionFile as SessionFile
    from igtl_gateway.record.sessionfile.seals import stated_seals as stated_seals
    from igtl_gateway.record.sessionfile.stream_rows import StreamName as StreamName
    from igtl_gateway.record.sessionfile.stream_rows import StreamNumbers as StreamNumbers
    from igtl_gateway.record.sessionfile.stream_rows import StreamRows as StreamRows
    from igtl_gateway.replay.moment import check_part as check_part
    from igtl_gateway.replay.moment import since_text as since_text
    from igtl_gateway.replay.played_action import PlayedAction as PlayedAction
    from igtl_gateway.replay.recorded_calls import RecordedRequests as RecordedRequests
    from igtl_gateway.replay.recorded_calls import RecordedService as RecordedService
    from igtl_gateway.replay.recorded_calls import recorded_calls as recorded_calls
    from igtl_gateway.replay.recorded_clocks import RecordedClocks as RecordedClocks
    from igtl_gateway.replay.recorded_config import config_to_run as config_to_run
    from igtl_gateway.replay.recorded_config import recorded_acceptance as recorded_acceptance
    from igtl_gateway.replay.recorded_config import recorded_units as recorded_units
    from igtl_gateway.replay.recorded_marks import carry_marks as carry_marks
    from igtl_gateway.replay.recorded_marks import marked_moment as marked_moment
    from igtl_gateway.replay.recorded_marks import marks_of as marks_of
    from igtl_gateway.replay.recorded_stamps import RecordedStamps as RecordedStamps
    from igtl_gateway.replay.rows import Head as Head
    from igtl_gateway.replay.rows import Heads as Heads
    from igtl_gateway.replay.rows import Rows as Rows
    from igtl_gateway.replay.rows import rows_of as rows_of
    from igtl_gateway.replay.rows import rows_of_entries as rows_of_entries
    from igtl_gateway.replay.source import check_recorded as check_recorded
    from igtl_gateway.replay.source import through_gateway as through_gateway
    from igtl_gateway.replay.source import without_messages as without_messages
    from igtl_gateway.replay.stamp_places import StampPlaces as StampPlaces
    from igtl_gateway.replay.state_before import latched_before as latched_before
    from igtl_gateway.replay.state_before import messages_before as messages_before
    from igtl_gateway.replay.state_before import notes_before as notes_before
    from igtl_gateway.replay.state_before import with_state as with_state

#: Names that are others there; the rest of the group is above.
__all__ = [
    "CLOCK_ANSWERS",
    "CLOCK_DEVICE",
    "CLOCK_QUESTIONS",
    "EntryStream",
    "file_identity",
    "is_of_recording",
    "open_recording",
    "recording_name",
]

HOMES: Homes = (
    # Recordings, for who does not need entries: those of the Python API
    ("api.recording", "Recording of_session open_recording=open session_of"),
    ("api.stream", "RecordedMessage Stream"),
    ("api.moments", "Moment to_ns"),
    ("api.verbs", "AnyRecording"),
    # Sessions: entries as they are in the file
    ("record.sessionfile.reader", "SessionFile"),
    ("record.sessionfile.only", "only_of_kinds"),
    ("record.sessionfile", "layout"),
    ("record.sessionfile.bulk", "MessageBlock block_of check_time gathered joined_blocks"),
    ("record.sessionfile.columns", "EntryColumns EntryStream=Stream Unfit in_larger_blocks"),
    ("record.sessionfile.stream_rows", "StreamName StreamNumbers StreamRows"),
    ("record.sessionfile.ranges", "RangeFile named"),
    ("gateway.log.entry", "Entry Kind"),
    ("replay.rows", "Head Heads Rows rows_of rows_of_entries"),
    ("gateway.log.note", "Level Note"),
    ("gateway.log.groups", "input_groups"),
    ("base.qos", "Endpoint Qos incompatible"),
    ("base.buffers", "Buffer join"),
    # What a session states: configuration, units, stamps, marks, seals
    ("gateway.log.clock_offset", "CLOCK_ANSWERS=ANSWERS CLOCK_DEVICE=DEVICE CLOCK_QUESTIONS=QUESTIONS"),
    ("replay.recorded_clocks", "RecordedClocks"),
    ("replay.recorded_config", "config_to_run recorded_acceptance recorded_units"),
    ("replay.recorded_stamps", "RecordedStamps"),
    ("replay.stamp_places", "StampPlaces"),
    ("gateway.log.marks", "Mark MarkNote ago_ns"),
    ("record.sessionfile.added_marks", "added_marks marks_files"),
    ("replay.moment", "check_part since_text"),
    ("replay.recorded_marks", "carry_marks marked_moment marks_of"),
    ("record.sessionfile.seals", "stated_seals"),
    ("replay.recorded_calls", "RecordedRequests RecordedService recorded_calls"),
    ("replay.played_action", "PlayedAction"),
    # Its entries as they were before, and through a gateway
    ("replay.source", "check_recorded through_gateway without_messages"),
    ("replay.state_before", "latched_before messages_before notes_before with_state"),
    # MCAP files of other programs: their index and records
    ("record.sessionfile", "records"),
    ("record.sessionfile.index", "read_index read_record recover_hint"),
    ("record.sessionfile.order", "message_rows"),
    ("record.sessionfile.places", "MessagePlace messages_at"),
    # Closed recordings of a folder, and what of them is uploaded
    ("record.retention.stored", "RecordingFolder StoredRecording file_identity=identity_of open_unlinked"),
    (
        "record.retention.upload_state",
        "FileState UploadState UploadStates is_of_recording=belongs recording_name=base_of",
    ),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
