"""All errors of the package.

::

    GatewayError                    base class of all errors of the package
    ├── ConfigError                 invalid configuration or command line (fault of the caller)
    ├── Unavailable                 not available on this machine: a package, a free port
    ├── WireError                   OpenIGTLink bytes that violate the protocol (fault of the peer)
    │   ├── TruncatedMessage        the stream ended inside a message
    │   ├── ChecksumMismatch        CRC-64 of the body differs from that in the header
    │   ├── MessageTooLarge         announced body size exceeds the limit
    │   └── MalformedBody           a length, count or value that the format does not allow
    ├── PeerError                   a peer of ``connect`` or ``serve`` did not do what was waited for
    │   ├── NoReply                 no connection, message or reply within the time (a TimeoutError)
    │   ├── LinkClosed              the connection is closed (a ConnectionError)
    │   └── Refused                 the peer refuses a query
    ├── ConversionError             a message without a counterpart on the other side
    │   ├── NotFinite               NaN or infinity
    │   └── NoBase                  part of an image that is not kept
    ├── RosError                    ROS 2: not installed, unknown type, rejected name
    ├── ViewerError                 rerun and its viewer: not installed, no display, no reply
    ├── OutputError                 standard output or error cannot be written: the disk is full
    └── RecordingError              invalid or unwritable session file (fault of the file or disk)
        ├── DiskRefused             the disk is full, read-only or not accessible
        ├── ClosedRecording         read after it was closed (a ValueError)
        ├── FileTaken               the file was removed, replaced or changed while it was written
        ├── UnsupportedRecording    not a session log, or an unknown version
        │   └── NoSuchRecording     there is no such file (a FileNotFoundError)
        └── DamagedRecording        a session log that cannot be read to its end
            ├── BeingRecorded       another process is still writing the file
            └── LimitExceeded       the file needs more memory, depth or time than the limits allow

Every error message contains the place, the value found and the value expected.
"""

from __future__ import annotations


class GatewayError(Exception):
    """Base class of all errors that this package raises."""


class ClockWarning(UserWarning):
    """Streams are joined whose clocks are not one: what was corrected, or why their times of receipt are used."""


class ConfigError(GatewayError):
    """A setting is missing, unknown or out of range."""


class MissingAddon(GatewayError):
    """This installation lacks an add-on, a folder of ``igtl_gateway/addons``."""


class Unavailable(GatewayError):
    """A function is not available on this machine: a package is missing, or a port is in use."""


class WireError(GatewayError):
    """Bytes that are not valid OpenIGTLink.

    Attributes:
        place: place in the message, such as ``"POLYDATA content, offset 12"``.
        found: the value in the message.
        expected: the values that the protocol allows.
    """

    #: Stable machine-readable name, used in notes and in the loss ledger.
    code = "wire_error"

    def __init__(self, place: str, found: object, expected: object) -> None:
        super().__init__(f"{place}: found {found}, expected {expected}")
        self.place = place
        self.found = found
        self.expected = expected


class TruncatedMessage(WireError):
    """The stream ended, or the body is shorter than its fields declare."""

    code = "truncated"


class ChecksumMismatch(WireError):
    """The CRC-64 of the body differs from that in the header."""

    code = "bad_crc"


class MessageTooLarge(WireError):
    """The header announces a body that exceeds the configured limit."""

    code = "too_large"


class MalformedBody(WireError):
    """A field of the message contradicts the format."""

    code = "malformed"


class PeerError(GatewayError):
    """A peer of ``connect`` or ``serve`` did not do what was waited for."""


class NoReply(PeerError, TimeoutError):
    """No connection, message or reply arrived within the time."""


class LinkClosed(PeerError, ConnectionError):
    """The connection is closed."""


class Refused(PeerError):
    """The peer refuses a query."""


class ConversionError(GatewayError):
    """A well-formed message cannot be represented on the other side."""

    #: Name in the loss ledger.
    code = "conversion"


class NotFinite(ConversionError):
    """A number of a pose is NaN or infinite."""

    code = "not_finite"


class NoBase(ConversionError):
    """The image that a message is a part of is not kept."""

    code = "no_base"


class RosError(GatewayError):
    """ROS 2 is not installed, or rejects a type or a name."""


class UnknownTypeError(RosError):
    """The definition of a message type, or its Python package, is not installed here."""


class ViewerError(GatewayError):
    """rerun or its viewer is not installed, has no display, or does not reply."""


class OutputError(GatewayError):
    """Standard output or error cannot be written: the disk is full."""


class RecordingError(GatewayError):
    """A recording cannot be written or read."""


class DiskRefused(RecordingError):
    """A recording cannot start because the disk is full, read-only or not accessible; the settings are valid."""


class FileTaken(RecordingError):
    """The file of a recording was removed, replaced, truncated or written to by another program."""


class UnsupportedRecording(RecordingError):
    """The file is not a session log, or has a version that this release does not support."""


class NoSuchRecording(UnsupportedRecording, FileNotFoundError):
    """There is no file of this name."""


class ClosedRecording(RecordingError, ValueError):
    """A recording was read after it was closed."""


class DamagedRecording(RecordingError):
    """The file is a session log, but truncated or corrupt."""


class BeingRecorded(DamagedRecording):
    """Another process is still recording this file."""


class LimitExceeded(DamagedRecording):
    """The file needs more memory, nesting, repetition or time than the limits allow (``--limit``)."""


def failure_text(error: Exception) -> str:
    """Return why a message is not written: the text of our own errors, otherwise type and text of the error."""
    if isinstance(error, GatewayError | ValueError) and str(error):
        return str(error)
    return f"cannot be decoded: {type(error).__name__}: {error}"


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text: that of rclpy might have several paragraphs."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
