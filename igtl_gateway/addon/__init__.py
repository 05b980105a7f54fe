"""The door of add-ons: what they are written with beside ``igtl_gateway``, those of this package and of others.

An add-on is a folder with a verb.  Its module has ``EXAMPLES``, ``add_arguments(parser)`` and ``run(options) -> int``;
its ``Verb`` is a row in a table (of ``igtl_gateway.base.addons``), or of another distribution by an entry point of the
group ``igtl_gateway.verbs``.  ``docs/how-to/write-an-addon.md`` shows one, and ``examples/addon`` is it.

Here is what most add-ons need: errors, time, names.  The rest is in groups by purpose, a module each:

``reading``    Recordings: as the streams of the Python API, or as the entries of a session.
``notes``      Codes of the notes in a session that add-ons act on, and words for their reasons.
``streams``    Streams of a recording as numbers: on one clock, and as poses, pictures, clouds and tables.
``writing``    New files: beside their place until they are whole; sessions, and sessions of several recorders.
``untrusted``  Files and text of others, read within limits; ROS messages by the definitions in a file.
``terminal``   The verb of an add-on: its row, its options, its output, its progress.
``settings``   Settings: rows of an add-on, the configuration of a gateway, and the choices that the core has.
``messages``   Messages of both protocols: conversions one at a time, pictures, units, names, metadata, definitions.
``checking``   Sessions computed again, compared and judged: verification, differences, seals, findings.
``live``       What runs: a bridge and its recording, replays, and a server of pages beside them.
``ros_side``   A ROS side over another middleware: what the application asks of it, and the halves that all sides share.
``processes``  What an installation has, and programs in processes of their own.
``igtl``       A class for each type of OpenIGTLink message.
``ros``        A class for each type of ROS message.

``HOMES`` of a group states where each of its names is documented.  Names load at their first use, so that ``--help``
does not wait for what only ``run`` needs.  They stay; names of the modules below may move.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.base.clock import Clock as Clock
    from igtl_gateway.base.clock import SystemClock as SystemClock
    from igtl_gateway.base.distinct import distinct_names as distinct_names
    from igtl_gateway.base.errors import BeingRecorded as BeingRecorded
    from igtl_gateway.base.errors import ClockWarning as ClockWarning
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
    from igtl_gateway.base.free_names import FreeNames as FreeNames
    from igtl_gateway.base.globs import matches as matches
    from igtl_gateway.base.near import did_you_mean as did_you_mean
    from igtl_gateway.base.near import near_names as near_names
    from igtl_gateway.base.near import near_streams as near_streams
    from igtl_gateway.base.near import one_of as one_of
    from igtl_gateway.base.near import streams_expected as streams_expected
    from igtl_gateway.base.near import unmatched as unmatched
    from igtl_gateway.base.near import without_match as without_match
    from igtl_gateway.base.stamp import NS_PER_MS as NS_PER_MS
    from igtl_gateway.base.stamp import NS_PER_S as NS_PER_S
    from igtl_gateway.base.stamp import ns_to_ros as ns_to_ros
    from igtl_gateway.base.stamp import ros_to_ns as ros_to_ns
    from igtl_gateway.base.version import __version__ as __version__
    from igtl_gateway.base.versions import Self as Self
    from igtl_gateway.base.versions import StrEnum as StrEnum
    from igtl_gateway.base.versions import iso_time as iso_time
    from igtl_gateway.base.versions import limit_values as limit_values
    from igtl_gateway.base.versions import python_command as python_command
    from igtl_gateway.base.versions import read_blob as read_blob

#: The modules beside this one whose names load at their first use.
GROUPS = ("reading", "notes", "streams", "writing", "untrusted", "terminal", "settings", "messages", "checking",
          "live", "ros_side", "processes")  # fmt: skip

HOMES: Homes = (
    # Errors: each message has the place, the value found and the value expected
    (
        "base.errors",
        "BeingRecorded ClockWarning ConfigError ConversionError DamagedRecording GatewayError LimitExceeded "
        "MessageTooLarge MissingAddon NoSuchRecording OutputError RecordingError RosError Unavailable "
        "UnknownTypeError UnsupportedRecording ViewerError WireError failure_text first_line",
    ),
    # Time: integer UTC nanoseconds
    ("base.stamp", "NS_PER_MS NS_PER_S ns_to_ros ros_to_ns"),
    ("base.clock", "Clock SystemClock"),
    # Names by patterns, names that are new, and names that were meant
    ("base.globs", "matches"),
    ("base.free_names", "FreeNames"),
    ("base.distinct", "distinct_names"),
    ("base.near", "did_you_mean near_names near_streams one_of streams_expected unmatched without_match"),
    # This version, and what Python 3.10 does not have
    ("base.version", "__version__"),
    ("base.versions", "Self StrEnum iso_time limit_values python_command read_blob"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
