"""What add-ons are written with: the one surface beside the Python API, for those of this package and for others.

An add-on is a folder with a verb.  Its module has ``EXAMPLES``, ``add_arguments(parser)`` and ``run(options) -> int``;
its ``Verb`` is a row in a table (of ``igtl_gateway.base.addons``), or of another distribution by an entry point of the
group ``igtl_gateway.verbs``.  ``docs/how-to/write-an-addon.md`` shows one, and ``examples/addon`` is it.

The names are those of the modules that ``HOMES`` states, where they are documented.  They load at their first use, so
that ``--help`` does not wait for what only ``run`` needs.  A name with ``from igtl_gateway.addon import NAME`` stays;
names of the modules below may move.  Messages are in ``addon.ros`` and ``addon.igtl``, a class for each type.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igtl_gateway.api.clouds import Cloud as Cloud
    from igtl_gateway.api.igtl_columns import POSE_TYPES as POSE_TYPES
    from igtl_gateway.api.igtl_columns import quaternions_of as quaternions_of
    from igtl_gateway.api.named_numbers import NAME_FIELDS as NAME_FIELDS
    from igtl_gateway.api.named_numbers import by_name as by_name
    from igtl_gateway.api.named_numbers import completed as completed
    from igtl_gateway.api.poses import between_poses as between_poses
    from igtl_gateway.api.poses import matrices_of as matrices_of
    from igtl_gateway.api.posing import tools_of as tools_of
    from igtl_gateway.api.posing import transforms_of as transforms_of
    from igtl_gateway.api.recording import Recording as Recording
    from igtl_gateway.api.recording import of_session as of_session
    from igtl_gateway.api.recording import open as open_recording
    from igtl_gateway.api.stream import RecordedMessage as RecordedMessage
    from igtl_gateway.api.stream import Stream as Stream
    from igtl_gateway.app.verification import IMPORTED as IMPORTED
    from igtl_gateway.app.verification import verify_recording as verify_recording
    from igtl_gateway.app.verification import verify_session as verify_session
    from igtl_gateway.base import extras as extras
    from igtl_gateway.base.addons import ADDONS as ADDONS
    from igtl_gateway.base.addons import check_present as check_present
    from igtl_gateway.base.addons import is_present as is_present
    from igtl_gateway.base.addons import part_of as part_of
    from igtl_gateway.base.buffers import Buffer as Buffer
    from igtl_gateway.base.buffers import join as join
    from igtl_gateway.base.child import Child as Child
    from igtl_gateway.base.child import report_facts as report_facts
    from igtl_gateway.base.clock import Clock as Clock
    from igtl_gateway.base.clock import SystemClock as SystemClock
    from igtl_gateway.base.distinct import distinct_names as distinct_names
    from igtl_gateway.base.distinct import numbered as numbered
    from igtl_gateway.base.errors import BeingRecorded as BeingRecorded
    from igtl_gateway.base.errors import ConfigError as ConfigError
    from igtl_gateway.base.errors import ConversionError as ConversionError
    from igtl_gateway.base.errors import DamagedRecording as DamagedRecording
    from igtl_gateway.base.errors import GatewayError as GatewayError
    from igtl_gateway.base.errors import LimitExceeded as LimitExceeded
    from igtl_gateway.base.errors import MessageTooLarge as MessageTooLarge
    from igtl_gateway.base.errors import MissingAddon as MissingAddon
    from igtl_gateway.base.errors import NoSuchRecording as NoSuchRecording
    from igtl_gateway.base.errors import OutputError as OutputError
    from igtl_gateway.base.errors import RecordingError as RecordingError
    from igtl_gateway.base.errors import RosError as RosError
    from igtl_gateway.base.errors import Unavailable as Unavailable
    from igtl_gateway.base.errors import UnknownTypeError as UnknownTypeError
    from igtl_gateway.base.errors import UnsupportedRecording as UnsupportedRecording
    from igtl_gateway.base.errors import ViewerError as ViewerError
    from igtl_gateway.base.errors import WireError as WireError
    from igtl_gateway.base.errors import failure_text as failure_text
    from igtl_gateway.base.errors import first_line as first_line
    from igtl_gateway.base.extras import in_use as in_use
    from igtl_gateway.base.extras import missing as missing
    from igtl_gateway.base.free_names import FreeNames as FreeNames
    from igtl_gateway.base.globs import matches as matches
    from igtl_gateway.base.near import did_you_mean as did_you_mean
    from igtl_gateway.base.near import near_names as near_names
    from igtl_gateway.base.near import near_streams as near_streams
    from igtl_gateway.base.near import unmatched as unmatched
    from igtl_gateway.base.near import without_match as without_match
    from igtl_gateway.base.once import Once as Once
    from igtl_gateway.base.qos import Endpoint as Endpoint
    from igtl_gateway.base.qos import Qos as Qos
    from igtl_gateway.base.stamp import NS_PER_MS as NS_PER_MS
    from igtl_gateway.base.stamp import NS_PER_S as NS_PER_S
    from igtl_gateway.base.stamp import ns_to_ros as ns_to_ros
    from igtl_gateway.base.stamp import ros_to_ns as ros_to_ns
    from igtl_gateway.base.systems.leaving import expect_threads_of as expect_threads_of
    from igtl_gateway.base.untrusted import cpu_time as cpu_time
    from igtl_gateway.base.untrusted import definitions as ros_definitions
    from igtl_gateway.base.untrusted import files as files
    from igtl_gateway.base.untrusted import limits as limits
    from igtl_gateway.base.untrusted.decoding import MessageDecoder as MessageDecoder
    from igtl_gateway.base.untrusted.decoding import new_store as new_store
    from igtl_gateway.base.untrusted.decoding import register_types as register_types
    from igtl_gateway.base.untrusted.definition_checks import Types as Types
    from igtl_gateway.base.untrusted.elements import ElementCounter as ElementCounter
    from igtl_gateway.base.untrusted.files import deadline_of as deadline_of
    from igtl_gateway.base.untrusted.files import is_same as is_same
    from igtl_gateway.base.untrusted.files import open_file as open_file
    from igtl_gateway.base.untrusted.files import read_bytes as read_bytes
    from igtl_gateway.base.untrusted.files import size_of as size_of
    from igtl_gateway.base.untrusted.files import stored_bytes as stored_bytes
    from igtl_gateway.base.untrusted.limits import Deadline as Deadline
    from igtl_gateway.base.untrusted.limits import check_limit as check_limit
    from igtl_gateway.base.untrusted.numbers import whole_number as whole_number
    from igtl_gateway.base.untrusted.parquet_file import parquet_columns as parquet_columns
    from igtl_gateway.base.untrusted.parquet_file import read_parquet as read_parquet
    from igtl_gateway.base.untrusted.parquet_file import read_parquet_schema as read_parquet_schema
    from igtl_gateway.base.untrusted.text import check_nesting as check_nesting
    from igtl_gateway.base.untrusted.text import parse_json as parse_json
    from igtl_gateway.base.untrusted.text import printable as printable
    from igtl_gateway.base.untrusted.xml_text import Element as Element
    from igtl_gateway.base.untrusted.xml_text import parse_xml as parse_xml
    from igtl_gateway.base.untrusted.yaml_text import parse_yaml as parse_yaml
    from igtl_gateway.base.version import __version__ as __version__
    from igtl_gateway.base.versions import Self as Self
    from igtl_gateway.base.versions import StrEnum as StrEnum
    from igtl_gateway.base.versions import iso_time as iso_time
    from igtl_gateway.base.versions import limit_values as limit_values
    from igtl_gateway.base.versions import python_command as python_command
    from igtl_gateway.base.versions import read_blob as read_blob
    from igtl_gateway.cli.common import count_text as count_text
    from igtl_gateway.cli.common import load_config as load_config
    from igtl_gateway.cli.common import size_text as size_text
    from igtl_gateway.cli.common import stop_event as stop_event
    from igtl_gateway.cli.common import utc_text as utc_text
    from igtl_gateway.cli.next_steps import command as command
    from igtl_gateway.cli.next_steps import print_next as print_next
    from igtl_gateway.cli.options import RECORDING as RECORDING
    from igtl_gateway.cli.options import RECORDING_OR_BAG as RECORDING_OR_BAG
    from igtl_gateway.cli.options import Options as Options
    from igtl_gateway.cli.options import add_config as add_config
    from igtl_gateway.cli.options import add_file as add_file
    from igtl_gateway.cli.options import add_file_mode as add_file_mode
    from igtl_gateway.cli.options import add_json as add_json
    from igtl_gateway.cli.options import add_output as add_output
    from igtl_gateway.cli.options import add_overwrite as add_overwrite
    from igtl_gateway.cli.options import add_streams as add_streams
    from igtl_gateway.cli.options import default as default
    from igtl_gateway.cli.options import definitions as definitions
    from igtl_gateway.cli.options import file_name as file_name
    from igtl_gateway.cli.options import new_recording as new_recording
    from igtl_gateway.cli.options import output_file as output_file
    from igtl_gateway.cli.options import parser_of as parser_of
    from igtl_gateway.cli.settings import add_settings as add_settings
    from igtl_gateway.cli.settings import values_with_effect as values_with_effect
    from igtl_gateway.cli.terminal import aligned as aligned
    from igtl_gateway.cli.terminal import cell as cell
    from igtl_gateway.cli.terminal import clear_live_line as clear_live_line
    from igtl_gateway.cli.terminal import is_terminal as is_terminal
    from igtl_gateway.cli.terminal import live_line as live_line
    from igtl_gateway.cli.terminal import print_json as print_json
    from igtl_gateway.cli.terminal import print_line as print_line
    from igtl_gateway.cli.terminal import width as width
    from igtl_gateway.cli.verbs import CONVERT as CONVERT
    from igtl_gateway.cli.verbs import INSPECT as INSPECT
    from igtl_gateway.cli.verbs import KEEP as KEEP
    from igtl_gateway.cli.verbs import MANY as MANY
    from igtl_gateway.cli.verbs import Verb as Verb
    from igtl_gateway.config.configuration import Config as Config
    from igtl_gateway.config.configuration import read_toml as read_toml
    from igtl_gateway.config.notations import DDS as DDS
    from igtl_gateway.config.notations import STREAM as STREAM
    from igtl_gateway.config.setting import HOST as HOST
    from igtl_gateway.config.setting import RECORD as RECORD
    from igtl_gateway.config.setting import ROS_GRAPH as ROS_GRAPH
    from igtl_gateway.config.setting import Setting as Setting
    from igtl_gateway.config.setting import grouped as grouped
    from igtl_gateway.convert.bitstream import is_key_frame as is_key_frame
    from igtl_gateway.convert.clouds import cloud_to_polydata as cloud_to_polydata
    from igtl_gateway.convert.context import ConvertedMessage as ConvertedMessage
    from igtl_gateway.convert.context import ToIgtlContext as ToIgtlContext
    from igtl_gateway.convert.context import ToRosContext as ToRosContext
    from igtl_gateway.convert.images import image_to_igtl as image_to_igtl
    from igtl_gateway.convert.images import pixel_layout as pixel_layout
    from igtl_gateway.convert.names import frames_of as frames_of
    from igtl_gateway.convert.pictures import JPEG as JPEG
    from igtl_gateway.convert.pictures import PNG as PNG
    from igtl_gateway.convert.pictures import Coding as Coding
    from igtl_gateway.convert.pictures import bayer_pattern as bayer_pattern
    from igtl_gateway.convert.pictures import coding_of as coding_of
    from igtl_gateway.convert.pictures import demosaiced as demosaiced
    from igtl_gateway.convert.pictures import depths as depths
    from igtl_gateway.convert.pictures import is_deep_png as is_deep_png
    from igtl_gateway.convert.polydata import polydata_to_igtl as polydata_to_igtl
    from igtl_gateway.convert.poses import rotation_matrix as rotation_matrix
    from igtl_gateway.convert.poses import unit_quaternion as unit_quaternion
    from igtl_gateway.convert.scaling import into_ros as into_ros
    from igtl_gateway.convert.structs import Pose as Pose
    from igtl_gateway.convert.surfaces import marker_to_igtl as marker_to_igtl
    from igtl_gateway.convert.surfaces import mesh_to_igtl as mesh_to_igtl
    from igtl_gateway.convert.units import UNITS as UNITS
    from igtl_gateway.convert.units import LengthUnits as LengthUnits
    from igtl_gateway.convert.units import ieee_754 as ieee_754
    from igtl_gateway.convert.units import millimetres as millimetres
    from igtl_gateway.convert.units import scale as scale
    from igtl_gateway.convert.volumes import volume_to_image as volume_to_image
    from igtl_gateway.edges.video.still import decoded_still as decoded_still
    from igtl_gateway.edges.video.worker import MAX_PIXELS as MAX_PIXELS
    from igtl_gateway.edges.video.worker import THREADS as VIDEO_THREADS
    from igtl_gateway.edges.video.worker import import_av as import_av
    from igtl_gateway.gateway import LINK_DOWN as LINK_DOWN
    from igtl_gateway.gateway import LINK_UP as LINK_UP
    from igtl_gateway.gateway import LISTENED as LISTENED
    from igtl_gateway.gateway import PARTNER as PARTNER
    from igtl_gateway.gateway import TICK as TICK
    from igtl_gateway.gateway import Session as Session
    from igtl_gateway.gateway import header_names as header_names
    from igtl_gateway.gateway import make_core as make_core
    from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE as DEFAULT_ACCEPTANCE
    from igtl_gateway.gateway.acceptance import Acceptance as Acceptance
    from igtl_gateway.gateway.log import joining as joining
    from igtl_gateway.gateway.log.changes import SETTING as SETTING
    from igtl_gateway.gateway.log.changes import SETTINGS as SETTINGS
    from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP as CLOCK_STEP
    from igtl_gateway.gateway.log.corrections import CORRECTED as CORRECTED
    from igtl_gateway.gateway.log.corrections import CORRECTIONS as CORRECTIONS
    from igtl_gateway.gateway.log.corrections import StampCorrection as StampCorrection
    from igtl_gateway.gateway.log.entry import Entry as Entry
    from igtl_gateway.gateway.log.entry import Kind as Kind
    from igtl_gateway.gateway.log.fates import REFUSED_COMMANDS as REFUSED_COMMANDS
    from igtl_gateway.gateway.log.fates import REFUSED_DEVICE as REFUSED_DEVICE
    from igtl_gateway.gateway.log.groups import input_groups as input_groups
    from igtl_gateway.gateway.log.interleaving import Interleaving as Interleaving
    from igtl_gateway.gateway.log.interleaving import is_mixed as is_mixed
    from igtl_gateway.gateway.log.joining import END_NS as END_NS
    from igtl_gateway.gateway.log.joining import GAP_NS as GAP_NS
    from igtl_gateway.gateway.log.joining import NEAR_NS as NEAR_NS
    from igtl_gateway.gateway.log.joining import pick as pick
    from igtl_gateway.gateway.log.marks import Mark as Mark
    from igtl_gateway.gateway.log.marks import MarkNote as MarkNote
    from igtl_gateway.gateway.log.marks import ago_ns as ago_ns
    from igtl_gateway.gateway.log.note import Level as Level
    from igtl_gateway.gateway.log.note import Note as Note
    from igtl_gateway.gateway.log.one_clock import OneClock as OneClock
    from igtl_gateway.gateway.log.one_clock import StreamTimes as StreamTimes
    from igtl_gateway.gateway.log.one_clock import one_clock as one_clock
    from igtl_gateway.gateway.orders import ORDERS as ORDERS
    from igtl_gateway.gateway.orders import UNWRITTEN as UNWRITTEN
    from igtl_gateway.record.sessionfile import layout as layout
    from igtl_gateway.record.sessionfile.added_marks import added_marks as added_marks
    from igtl_gateway.record.sessionfile.added_marks import marks_files as marks_files
    from igtl_gateway.record.sessionfile.bulk import MessageBlock as MessageBlock
    from igtl_gateway.record.sessionfile.bulk import block_of as block_of
    from igtl_gateway.record.sessionfile.definition import Definition as Definition
    from igtl_gateway.record.sessionfile.definition import FileDefinitions as FileDefinitions
    from igtl_gateway.record.sessionfile.definition import another_definition as another_definition
    from igtl_gateway.record.sessionfile.new_file import create_file as create_file
    from igtl_gateway.record.sessionfile.new_file import empty_file as empty_file
    from igtl_gateway.record.sessionfile.new_file import make_folder as make_folder
    from igtl_gateway.record.sessionfile.new_file import open_new as open_new
    from igtl_gateway.record.sessionfile.new_file import open_text as open_text
    from igtl_gateway.record.sessionfile.new_file import os_error_text as os_error_text
    from igtl_gateway.record.sessionfile.new_file import write_bytes as write_bytes
    from igtl_gateway.record.sessionfile.new_file import write_text as write_text
    from igtl_gateway.record.sessionfile.ranges import RangeFile as RangeFile
    from igtl_gateway.record.sessionfile.ranges import named as named
    from igtl_gateway.record.sessionfile.reader import SessionFile as SessionFile
    from igtl_gateway.record.sessionfile.whole_files import check_folder as check_folder
    from igtl_gateway.record.sessionfile.whole_files import check_target as check_target
    from igtl_gateway.record.sessionfile.whole_files import is_unfinished as is_unfinished
    from igtl_gateway.record.sessionfile.whole_files import write_error as write_error
    from igtl_gateway.record.sessionfile.whole_files import written as written
    from igtl_gateway.record.sessionfile.whole_files import written_folder as written_folder
    from igtl_gateway.record.sessionfile.writer import SessionWriter as SessionWriter
    from igtl_gateway.replay.recorded_config import config_to_run as config_to_run
    from igtl_gateway.replay.recorded_config import recorded_acceptance as recorded_acceptance
    from igtl_gateway.replay.recorded_config import recorded_units as recorded_units
    from igtl_gateway.replay.recorded_marks import carry_marks as carry_marks
    from igtl_gateway.replay.recorded_marks import marked_moment as marked_moment
    from igtl_gateway.replay.recorded_marks import marks_of as marks_of
    from igtl_gateway.replay.recorded_stamps import RecordedStamps as RecordedStamps
    from igtl_gateway.replay.source import check_recorded as check_recorded
    from igtl_gateway.replay.stamp_places import StampPlaces as StampPlaces
    from igtl_gateway.replay.state_before import latched_before as latched_before
    from igtl_gateway.replay.state_before import with_state as with_state

#: Names that are others there; the rest of the surface is above.
__all__ = ["VIDEO_THREADS", "open_recording", "ros_definitions"]

#: Modules, and their names here with spaces between; a name that is a module below it is that module.
HOMES: tuple[tuple[str, str], ...] = (
    # Errors: each message has the place, the value found and the value expected
    (
        "base.errors",
        "BeingRecorded ConfigError ConversionError DamagedRecording GatewayError LimitExceeded "
        "MessageTooLarge MissingAddon NoSuchRecording OutputError RecordingError RosError Unavailable "
        "UnknownTypeError UnsupportedRecording ViewerError WireError failure_text first_line",
    ),
    # Recordings, for a writer of add-ons who does not need entries: those of the Python API
    ("api.recording", "Recording open_recording of_session"),
    ("api.stream", "RecordedMessage Stream"),
    # Sessions: entries as they are in the file, and their writing
    ("record.sessionfile.reader", "SessionFile"),
    ("record.sessionfile.writer", "SessionWriter"),
    ("record.sessionfile.definition", "Definition FileDefinitions another_definition"),
    ("record.sessionfile", "layout"),
    ("record.sessionfile.bulk", "MessageBlock block_of"),
    ("record.sessionfile.ranges", "RangeFile named"),
    ("gateway.log.entry", "Entry Kind"),
    ("gateway.log.note", "Level Note"),
    ("base.qos", "Endpoint Qos"),
    ("base.buffers", "Buffer join"),
    ("config.configuration", "Config read_toml"),
    ("gateway.acceptance", "DEFAULT_ACCEPTANCE Acceptance"),
    ("replay.recorded_config", "config_to_run recorded_acceptance recorded_units"),
    ("replay.recorded_stamps", "RecordedStamps"),
    ("app.verification", "IMPORTED verify_recording verify_session"),
    # The gateway: inputs of a session to its outputs; names in it, and codes of notes that it acts on
    ("gateway", "LINK_DOWN LINK_UP LISTENED PARTNER TICK Session header_names make_core"),
    ("gateway.log.changes", "SETTING SETTINGS"),
    ("gateway.log.corrections", "CORRECTED CORRECTIONS StampCorrection"),
    ("gateway.log.clocksteps", "CLOCK_STEP"),
    ("gateway.log.fates", "REFUSED_COMMANDS REFUSED_DEVICE"),
    ("gateway.log.groups", "input_groups"),
    # Two streams: one clock for both, and the messages that belong to a moment
    ("gateway.log.one_clock", "OneClock StreamTimes one_clock"),
    ("gateway.log.interleaving", "Interleaving is_mixed"),
    ("gateway.log", "joining"),
    ("gateway.log.joining", "END_NS GAP_NS NEAR_NS pick"),
    ("api.poses", "between_poses matrices_of"),
    ("api.posing", "tools_of transforms_of"),
    ("api.clouds", "Cloud"),
    # Numbers of joints, by their names
    ("api.named_numbers", "NAME_FIELDS by_name completed"),
    ("gateway.log.marks", "Mark MarkNote ago_ns"),
    ("gateway.orders", "ORDERS UNWRITTEN"),
    ("record.sessionfile.added_marks", "added_marks marks_files"),
    ("replay.stamp_places", "StampPlaces"),
    ("replay.recorded_marks", "carry_marks marked_moment marks_of"),
    # Conversions of pictures and geometry, one message at a time
    ("convert.context", "ConvertedMessage ToIgtlContext ToRosContext"),
    ("convert.images", "image_to_igtl pixel_layout"),
    ("convert.volumes", "volume_to_image"),
    ("convert.pictures", "Coding JPEG PNG bayer_pattern coding_of demosaiced depths is_deep_png"),
    ("convert.clouds", "cloud_to_polydata"),
    ("convert.polydata", "polydata_to_igtl"),
    ("convert.surfaces", "marker_to_igtl mesh_to_igtl"),
    # Units and rotations
    ("convert.scaling", "into_ros"),
    ("convert.units", "UNITS LengthUnits ieee_754 millimetres scale"),
    ("convert.names", "frames_of"),
    ("convert.poses", "rotation_matrix unit_quaternion"),
    ("convert.structs", "Pose"),
    ("api.igtl_columns", "POSE_TYPES quaternions_of"),
    # Video: a library that an extra installs, and its limits
    ("convert.bitstream", "is_key_frame"),
    ("edges.video.still", "decoded_still"),
    ("edges.video.worker", "MAX_PIXELS VIDEO_THREADS import_av"),
    # New files: written beside their place, moved there when they are whole
    ("record.sessionfile.whole_files", "check_folder check_target is_unfinished write_error written written_folder"),
    (
        "record.sessionfile.new_file",
        "create_file empty_file make_folder open_new open_text os_error_text write_bytes write_text",
    ),
    # Untrusted files and text, with their limits
    ("base.untrusted", "cpu_time files limits"),
    ("base.untrusted.files", "deadline_of is_same open_file read_bytes size_of stored_bytes"),
    ("base.untrusted.limits", "Deadline check_limit"),
    ("base.untrusted.numbers", "whole_number"),
    ("base.untrusted.text", "check_nesting parse_json printable"),
    ("base.untrusted.xml_text", "Element parse_xml"),
    ("base.untrusted.yaml_text", "parse_yaml"),
    ("base.untrusted.parquet_file", "parquet_columns read_parquet read_parquet_schema"),
    # ROS messages of any type, by the definitions in a file
    ("base.untrusted", "ros_definitions"),
    ("base.untrusted.decoding", "MessageDecoder new_store register_types"),
    ("base.untrusted.definition_checks", "Types"),
    ("base.untrusted.elements", "ElementCounter"),
    # Time: integer UTC nanoseconds
    ("base.stamp", "NS_PER_MS NS_PER_S ns_to_ros ros_to_ns"),
    ("base.clock", "Clock SystemClock"),
    # What Python 3.10 does not have
    ("base.versions", "Self StrEnum iso_time limit_values python_command read_blob"),
    # The verb: its row, its options, its output, its progress
    ("cli.verbs", "CONVERT INSPECT KEEP MANY Verb"),
    (
        "cli.options",
        "Options RECORDING RECORDING_OR_BAG add_config add_file add_file_mode add_json add_output "
        "add_overwrite add_streams default definitions file_name new_recording output_file parser_of",
    ),
    ("cli.settings", "add_settings values_with_effect"),
    ("config.notations", "DDS STREAM"),
    ("config.setting", "HOST RECORD ROS_GRAPH Setting grouped"),
    ("cli.terminal", "aligned cell clear_live_line is_terminal live_line print_json print_line width"),
    ("cli.common", "count_text load_config size_text stop_event utc_text"),
    ("cli.next_steps", "command print_next"),
    # What an installation has: extras, other add-ons; names of streams by patterns; once; other processes
    ("base", "extras"),
    ("base.extras", "in_use missing"),
    ("base.addons", "ADDONS check_present is_present part_of"),
    ("base.globs", "matches"),
    ("base.free_names", "FreeNames"),
    ("base.distinct", "distinct_names numbered"),
    ("base.near", "did_you_mean near_names near_streams unmatched without_match"),
    ("replay.source", "check_recorded"),
    ("replay.state_before", "latched_before with_state"),
    ("base.once", "Once"),
    ("base.systems.leaving", "expect_threads_of"),
    ("base.child", "Child report_facts"),
    ("base.version", "__version__"),
)
#: Name here → name there, where the latter alone would be unclear.
_RENAMED = {
    "open_recording": "open",
    "VIDEO_THREADS": "THREADS",
    "ros_definitions": "definitions",
}
_MODULE_OF = {name: module for module, names in HOMES for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"igtl_gateway.{_MODULE_OF[name]}")
    original = _RENAMED.get(name, name)
    found = getattr(module, original, None) or import_module(f"{module.__name__}.{original}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF})
