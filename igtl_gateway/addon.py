"""What add-ons are written with: the one surface beside the Python API, for those of this package and for others.

An add-on is a folder with a verb.  Its module has ``EXAMPLES``, ``add_arguments(parser)`` and ``run(options) -> int``;
its ``Verb`` is a row in a table (of ``igtl_gateway.base.addons``), or of another distribution by an entry point of the
group ``igtl_gateway.verbs``.  ``docs/how-to/write-an-addon.md`` shows one, and ``examples/addon`` is it.

The names are those of the modules that ``HOMES`` states, where they are documented.  They load at their first use, so
that ``--help`` does not wait for what only ``run`` needs.  A name with ``from igtl_gateway.addon import NAME`` stays;
names of the modules below may move.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igtl_gateway.api.recording import Recording, of_session
    from igtl_gateway.api.recording import open as open_recording
    from igtl_gateway.api.stream import Stream
    from igtl_gateway.app.verification import IMPORTED, verify_recording, verify_session
    from igtl_gateway.base import extras
    from igtl_gateway.base.addons import ADDONS, check_present, is_present, part_of
    from igtl_gateway.base.buffers import Buffer, join
    from igtl_gateway.base.clock import Clock, SystemClock
    from igtl_gateway.base.errors import (
        ConfigError,
        ConversionError,
        DamagedRecording,
        GatewayError,
        LimitExceeded,
        MissingAddon,
        OutputError,
        RecordingError,
        RosError,
        Unavailable,
        UnknownTypeError,
        UnsupportedRecording,
        ViewerError,
        WireError,
        first_line,
    )
    from igtl_gateway.base.extras import in_use, missing
    from igtl_gateway.base.globs import matches
    from igtl_gateway.base.qos import Endpoint, Qos
    from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ros, ros_to_ns
    from igtl_gateway.base.untrusted import files, limits
    from igtl_gateway.base.untrusted.files import is_same, open_file, read_bytes
    from igtl_gateway.base.untrusted.numbers import whole_number
    from igtl_gateway.base.untrusted.text import check_nesting, parse_json, printable
    from igtl_gateway.base.version import __version__
    from igtl_gateway.cli.common import count_text, load_config, size_text, stop_event, utc_text
    from igtl_gateway.cli.next_steps import command, print_next
    from igtl_gateway.cli.options import (
        RECORDING,
        RECORDING_OR_BAG,
        Options,
        add_config,
        add_file,
        add_file_mode,
        add_json,
        add_output,
        add_overwrite,
        add_streams,
        default,
        definitions,
        file_name,
        new_recording,
        output_file,
        parser_of,
    )
    from igtl_gateway.cli.settings import add_settings, values_with_effect
    from igtl_gateway.cli.terminal import (
        aligned,
        cell,
        clear_live_line,
        is_terminal,
        live_line,
        print_json,
        print_line,
        width,
    )
    from igtl_gateway.cli.verbs import Verb
    from igtl_gateway.config.configuration import Config, read_toml
    from igtl_gateway.config.notations import DDS, STREAM
    from igtl_gateway.config.setting import HOST, RECORD, ROS_GRAPH, Setting, grouped
    from igtl_gateway.convert.structs import Pose
    from igtl_gateway.gateway.log.entry import Entry, Kind
    from igtl_gateway.gateway.log.note import Level, Note
    from igtl_gateway.record.sessionfile import layout
    from igtl_gateway.record.sessionfile.beside import check_target, is_unfinished, write_error, written
    from igtl_gateway.record.sessionfile.new_file import (
        make_folder,
        open_new,
        open_text,
        os_error_text,
        write_bytes,
        write_text,
    )
    from igtl_gateway.record.sessionfile.ranges import RangeFile, named
    from igtl_gateway.record.sessionfile.reader import SessionFile
    from igtl_gateway.record.sessionfile.writer import SessionWriter
    from igtl_gateway.replay.recorded_config import config_to_run

#: Module → its names here; a name that is a module below it is that module.
HOMES: dict[str, tuple[str, ...]] = {
    # Errors: each message has the place, the value found and the value expected
    "base.errors": (
        "ConfigError",
        "ConversionError",
        "DamagedRecording",
        "GatewayError",
        "LimitExceeded",
        "MissingAddon",
        "OutputError",
        "RecordingError",
        "RosError",
        "Unavailable",
        "UnknownTypeError",
        "UnsupportedRecording",
        "ViewerError",
        "WireError",
        "first_line",
    ),
    # Recordings, for a writer of add-ons who does not need entries: those of the Python API
    "api.recording": ("Recording", "open_recording", "of_session"),
    "api.stream": ("Stream",),
    # Sessions: entries as they are in the file, and their writing
    "record.sessionfile.reader": ("SessionFile",),
    "record.sessionfile.ranges": ("RangeFile", "named"),
    "record.sessionfile.writer": ("SessionWriter",),
    "record.sessionfile": ("layout",),
    "gateway.log.entry": ("Entry", "Kind"),
    "gateway.log.note": ("Level", "Note"),
    "base.qos": ("Endpoint", "Qos"),
    "convert.structs": ("Pose",),
    "base.buffers": ("Buffer", "join"),
    "config.configuration": ("Config", "read_toml"),
    "replay.recorded_config": ("config_to_run",),
    "app.verification": ("IMPORTED", "verify_recording", "verify_session"),
    # New files: written beside their place, moved there when they are whole
    "record.sessionfile.beside": ("check_target", "is_unfinished", "write_error", "written"),
    "record.sessionfile.new_file": (
        "make_folder",
        "open_new",
        "open_text",
        "os_error_text",
        "write_bytes",
        "write_text",
    ),
    # Untrusted files and text, with their limits
    "base.untrusted": ("files", "limits"),
    "base.untrusted.files": ("is_same", "open_file", "read_bytes"),
    "base.untrusted.text": ("check_nesting", "parse_json", "printable"),
    "base.untrusted.numbers": ("whole_number",),
    # Time: integer UTC nanoseconds
    "base.stamp": ("NS_PER_MS", "NS_PER_S", "ns_to_ros", "ros_to_ns"),
    "base.clock": ("Clock", "SystemClock"),
    # The verb: its row, its options, its output, its progress
    "cli.verbs": ("Verb",),
    "cli.options": (
        "Options",
        "RECORDING",
        "RECORDING_OR_BAG",
        "add_config",
        "add_file",
        "add_file_mode",
        "add_json",
        "add_output",
        "add_output",
        "add_overwrite",
        "add_streams",
        "default",
        "definitions",
        "file_name",
        "new_recording",
        "output_file",
        "parser_of",
    ),
    "cli.settings": ("add_settings", "values_with_effect"),
    "config.notations": ("DDS", "STREAM"),
    "config.setting": ("HOST", "RECORD", "ROS_GRAPH", "Setting", "grouped"),
    "cli.terminal": (
        "aligned",
        "cell",
        "clear_live_line",
        "is_terminal",
        "live_line",
        "print_json",
        "print_line",
        "width",
    ),
    "cli.common": ("count_text", "load_config", "size_text", "stop_event", "utc_text"),
    "cli.next_steps": ("command", "print_next"),
    # What an installation has: extras, other add-ons; names of streams by patterns
    "base": ("extras",),
    "base.extras": ("in_use", "missing"),
    "base.addons": ("ADDONS", "check_present", "is_present", "part_of"),
    "base.globs": ("matches",),
    "base.version": ("__version__",),
}
#: Name here → name there, where the latter alone would be unclear.
_RENAMED = {"open_recording": "open"}
_MODULE_OF = {name: module for module, names in HOMES.items() for name in names}

__all__ = [
    "ADDONS",
    "DDS",
    "HOST",
    "IMPORTED",
    "NS_PER_MS",
    "NS_PER_S",
    "RECORD",
    "RECORDING",
    "RECORDING_OR_BAG",
    "ROS_GRAPH",
    "STREAM",
    "Buffer",
    "Clock",
    "Config",
    "ConfigError",
    "ConversionError",
    "DamagedRecording",
    "Endpoint",
    "Entry",
    "GatewayError",
    "Kind",
    "Level",
    "LimitExceeded",
    "MissingAddon",
    "Note",
    "Options",
    "OutputError",
    "Pose",
    "Qos",
    "RangeFile",
    "Recording",
    "RecordingError",
    "RosError",
    "SessionFile",
    "SessionWriter",
    "Setting",
    "Stream",
    "SystemClock",
    "Unavailable",
    "UnknownTypeError",
    "UnsupportedRecording",
    "Verb",
    "ViewerError",
    "WireError",
    "__version__",
    "add_config",
    "add_file",
    "add_file_mode",
    "add_json",
    "add_output",
    "add_overwrite",
    "add_settings",
    "add_streams",
    "aligned",
    "cell",
    "check_nesting",
    "check_present",
    "check_target",
    "clear_live_line",
    "command",
    "config_to_run",
    "count_text",
    "default",
    "definitions",
    "extras",
    "file_name",
    "files",
    "first_line",
    "grouped",
    "in_use",
    "is_present",
    "is_same",
    "is_terminal",
    "is_unfinished",
    "join",
    "layout",
    "limits",
    "live_line",
    "load_config",
    "make_folder",
    "matches",
    "missing",
    "named",
    "new_recording",
    "ns_to_ros",
    "of_session",
    "open_file",
    "open_new",
    "open_recording",
    "open_text",
    "os_error_text",
    "output_file",
    "parse_json",
    "parser_of",
    "part_of",
    "print_json",
    "print_line",
    "print_next",
    "printable",
    "read_bytes",
    "read_toml",
    "ros_to_ns",
    "size_text",
    "stop_event",
    "utc_text",
    "values_with_effect",
    "verify_recording",
    "verify_session",
    "whole_number",
    "width",
    "write_bytes",
    "write_error",
    "write_text",
    "written",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"igtl_gateway.{_MODULE_OF[name]}")
    original = _RENAMED.get(name, name)
    found = getattr(module, original) if hasattr(module, original) else import_module(f"{module.__name__}.{name}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
