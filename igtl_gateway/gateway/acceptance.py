"""Which bytes of peers are messages: the rule of a session, for the gateway and for all that read its recording."""

from __future__ import annotations

from dataclasses import dataclass

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.versions import Self
from igtl_gateway.config.configuration import Config
from igtl_gateway.wire import Message, decode
from igtl_gateway.wire.header import READING


@dataclass(frozen=True, slots=True)
class Acceptance:
    """What a session accepts.

    Attributes:
        check_crc: bytes with a wrong CRC are rejected.
        reading: which messages that deviate from the protocol are read, see ``wire.message.decode``.
    """

    check_crc: bool = True
    reading: int = READING

    @classmethod
    def of(cls, config: Config) -> Self:
        """Return the rule of a session with a configuration."""
        return cls(config.check_crc, config.reading)

    def message(self, data: Buffer) -> Message:
        """Decode a message.  Raises WireError for what the session rejects."""
        return decode(data, check_crc=self.check_crc, reading=self.reading)


#: The rule without a configuration.
DEFAULT_ACCEPTANCE = Acceptance()
