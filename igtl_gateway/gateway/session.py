"""The gateway with its numbering: raw inputs in, numbered entries out.  Still pure: the time is an argument."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache

from igtl_gateway.buffers import Buffer
from igtl_gateway.gateway.core import Gateway
from igtl_gateway.gateway.plans import NAMES, Plans
from igtl_gateway.gateway.relay import RelayGateway
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.stamp import ticks_to_ns
from igtl_gateway.wire import HEADER_SIZE, Header
from igtl_gateway.wire.fields import visible

_TICKS, _TICKS_AT = struct.Struct(">Q"), 34


class Session:
    """The door through which live traffic, replay and verification come to the gateway."""

    def __init__(self, gateway: Gateway | RelayGateway) -> None:
        self.gateway = gateway
        self._plans = gateway.plans if isinstance(gateway, Gateway) else Plans()
        self._seq = 0
        self._stamp_ns = 0

    def input(
        self,
        now_ns: int,
        kind: Kind,
        payload: Sequence[Buffer],
        *,
        channel: str = "",
        type_name: str = "",
        links: tuple[int, ...] = (),
        source_ns: int = 0,
    ) -> list[Entry]:
        """The entry of an input that arrived at ``now_ns`` (UTC), followed by what it caused.

        OpenIGTLink input names its own channel, type and stamp: they are read from its header.
        """
        stamp_ns = max(now_ns, self._stamp_ns + 1)  # log order is time order, even where the host's clock steps back
        entries = self._planned(stamp_ns, kind, payload, channel, type_name, links, source_ns)
        if entries:
            self._seq, self._stamp_ns = entries[-1].seq, entries[-1].stamp_ns
            return entries
        if kind is Kind.IGTL_IN:
            channel, type_name, source_ns = head_of(payload[0])
        entry = Entry(
            self._seq + 1,
            stamp_ns,
            kind,
            channel,
            type_name,
            payload,
            links,
            source_ns,
        )
        entries = [entry, *self.gateway.handle(entry)]
        self._seq, self._stamp_ns = entries[-1].seq, entries[-1].stamp_ns
        return entries

    def _planned(
        self,
        stamp_ns: int,
        kind: Kind,
        payload: Sequence[Buffer],
        channel: str,
        type_name: str,
        links: tuple[int, ...],
        source_ns: int,
    ) -> list[Entry] | None:
        """What the plan of the stream says, if it has one that fits; nothing where the general way has to say more."""
        plans, entries = self._plans, None
        if kind is Kind.ROS_IN:
            topic_key = (channel, type_name)
            if to_igtl := plans.to_igtl.get(topic_key):
                entries = to_igtl(self._seq + 1, stamp_ns, payload, channel, type_name, source_ns)
                if entries is None:
                    del plans.to_igtl[topic_key]
        elif kind is Kind.IGTL_IN:
            device_key = (links[0], bytes(payload[0][NAMES]))
            if to_ros := plans.to_ros.get(device_key):
                entries = to_ros(self._seq + 1, stamp_ns, payload, links, self.gateway.heard)  # type: ignore[union-attr]
                if entries is None:
                    del plans.to_ros[device_key]
        return entries


def head_of(message: Buffer) -> tuple[str, str, int]:
    """What the header of an OpenIGTLink message names: stream, type, and its stamp in UTC ns.

    Raises TruncatedMessage below 58 bytes.
    """
    if len(message) < HEADER_SIZE:
        Header.unpack(message)  # which says what is wrong
    stream, igtl_type = _named(bytes(message[NAMES]))
    (ticks,) = _TICKS.unpack_from(message, _TICKS_AT)
    return stream, igtl_type, ticks_to_ns(ticks)


@lru_cache(maxsize=4_096)
def _named(names: bytes) -> tuple[str, str]:
    """Stream and type of the first bytes of a header: the same come again and again."""
    header = Header.unpack(names.ljust(HEADER_SIZE, b"\0"))
    return f"{visible(header.type)}/{visible(header.device_name)}", visible(header.type)
