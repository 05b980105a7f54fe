"""Work of the full path on a ROS message that is done before the message has its number; see ``to_ros/beforehand``."""

from __future__ import annotations

from dataclasses import dataclass

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.convert.table import ConversionToIgtl
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.gateway.streams import Streams, ToIgtlStream

#: From this size on a message is converted beforehand: a list of a hundred elements, half a millisecond.
_LEAST_BYTES = 8 << 10

#: The message and what it was converted to.
Converted = tuple[RosMessage, ConvertedMessage]


@dataclass(frozen=True, slots=True)
class RosResults:
    """What a ROS message has given beforehand.

    Attributes:
        payload: its CDR.
        conversion, lengths: what it was converted with.
        made: the message and what it was converted to, or why it cannot be.
        warnings: those of the conversion.
    """

    payload: Buffer
    conversion: ConversionToIgtl
    lengths: LengthUnits
    made: Converted | ConversionError | WireError
    warnings: list[tuple[str, str]]


class RosBeforehand:
    """The results of the next ROS message.

    Attributes:
        results: of the message that is handled now; set and used with the sequence lock.
    """

    def __init__(self, config: Config, streams: Streams, peers: Peers) -> None:
        self.results: RosResults | None = None
        self._config = config
        self._streams = streams
        self._peers = peers

    def work(self, topic: str, ros_type: str, payload: Buffer) -> RosResults | None:
        """Decode and convert a message that takes long, if there is a peer; from any thread."""
        if len(payload) < _LEAST_BYTES or not self._peers:
            return None
        row, conversion = self._streams.rows(topic, ros_type)
        if row is None or conversion is None:
            return None
        to = ToIgtlContext(self._config.lengths(row))
        return RosResults(payload, conversion, to.lengths, _attempted(conversion, payload, to), to.warnings)

    def converted(self, entry: Entry, stream: ToIgtlStream, to: ToIgtlContext) -> Converted:
        """Return the message of an entry, and what it is converted to.  Raises ConversionError and WireError."""
        results, payload = self.results, entry.payload[0]
        if (
            results is None
            or results.payload is not payload
            or results.conversion is not stream.conversion
            or results.lengths != to.lengths
        ):
            made = _attempted(stream.conversion, payload, to)
        else:
            made = results.made
            to.warnings.extend(results.warnings)
        if not isinstance(made, tuple):
            raise made
        return made


def _attempted(
    conversion: ConversionToIgtl, payload: Buffer, to: ToIgtlContext
) -> Converted | ConversionError | WireError:
    try:
        message = conversion.message.unpack(payload)
        return message, conversion.convert(message, to)
    except (ConversionError, WireError) as error:
        return error
