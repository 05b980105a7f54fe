"""Every error of the package, in one small tree.

::

    GatewayError                    base: catch this and nothing of ours escapes
    ├── ConfigError                 the configuration or the command line (fault of the caller)
    ├── Unavailable                 this machine lacks it now: a package, a free port
    ├── WireError                   OpenIGTLink bytes that break the protocol (fault of the peer)
    │   ├── TruncatedMessage        the stream ended inside a message
    │   ├── ChecksumMismatch        CRC-64 of the body differs from the header's
    │   ├── MessageTooLarge         announced body size above the limit
    │   └── MalformedBody           a length, count or value that the format forbids
    ├── ConversionError             a message that has no counterpart on the other side
    │   └── NotFinite               numbers that are none (NaN), or without end
    ├── RosError                    the ROS 2 side: missing installation, unknown type, refused name
    ├── ViewerError                 rerun and its viewer: not installed, nothing to draw with, no answer
    ├── OutputError                 standard output or error takes nothing more: the disk is full
    └── RecordingError              a session file (fault of the file or of the disk)
        ├── DiskRefused             the disk is full, read-only or not ours
        ├── UnsupportedRecording    not a session log, or a version we do not know
        └── DamagedRecording        a session log that cannot be read to its end
            ├── BeingRecorded       a session log that another process is still writing
            └── LimitExceeded       a file that asks for more memory, depth or time than it may have

Every message of an error names the place, the value found and the value expected.
"""

from __future__ import annotations


class GatewayError(Exception):
    """Base of all errors raised on purpose by this package."""


class ConfigError(GatewayError):
    """A setting is missing, unknown or out of range."""


class Unavailable(GatewayError):
    """What was asked for can be, but not on this machine as it is: a package is missing, a port is taken."""


class WireError(GatewayError):
    """Bytes that are not valid OpenIGTLink.

    Attributes:
        place: where in the message, as ``"POLYDATA content, offset 12"``.
        found: what was read.
        expected: what the protocol asks for.
    """

    #: Stable machine-readable name, used in notes and in the loss ledger.
    code = "wire_error"

    def __init__(self, place: str, found: object, expected: object) -> None:
        super().__init__(f"{place}: found {found}, expected {expected}")
        self.place = place
        self.found = found
        self.expected = expected


class TruncatedMessage(WireError):
    """The stream ended, or the body is shorter than its own fields say."""

    code = "truncated"


class ChecksumMismatch(WireError):
    """The CRC-64 in the header is not that of the body."""

    code = "bad_crc"


class MessageTooLarge(WireError):
    """The header announces a body above the configured limit."""

    code = "too_large"


class MalformedBody(WireError):
    """A field of the message contradicts the format."""

    code = "malformed"


class ConversionError(GatewayError):
    """A well-formed message that cannot be expressed on the other side."""

    #: What the loss ledger calls it.
    code = "conversion"


class NotFinite(ConversionError):
    """A number of a pose is NaN or infinite."""

    code = "not_finite"


class RosError(GatewayError):
    """ROS 2 is not installed here, or refuses a type or a name."""


class ViewerError(GatewayError):
    """rerun or its viewer is not installed, has nothing to draw with, or does not answer."""


class OutputError(GatewayError):
    """What is printed cannot be written: the disk that stdout goes to is full."""


class RecordingError(GatewayError):
    """A recording cannot be written or read."""


class DiskRefused(RecordingError):
    """A recording cannot begin, and not by a slip of who wants it: the disk is full, read-only or not ours."""


class UnsupportedRecording(RecordingError):
    """The file is not a session log, or of a version that this release does not know."""


class DamagedRecording(RecordingError):
    """The file is a session log, but cut off or corrupt."""


class BeingRecorded(DamagedRecording):
    """The file has no end yet, and another process holds the lock of its writer."""


class LimitExceeded(DamagedRecording):
    """The file asks for more memory, nesting, repetition or time than the limits allow (``--limit``)."""
