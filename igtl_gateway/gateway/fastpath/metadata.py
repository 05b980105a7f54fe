"""Metadata of header version 2 in compiled streams to ROS.

3D Slicer sends the same metadata with every message of a node: they are a constant part of its compiled stream,
compared byte by byte, and so is the ROS message of them, in which only stamp and message id are new.  A device may have
a few compiled streams, one for each of the blocks of metadata that it alternates between, such as those of a tool that
is seen and of the same tool out of sight.
"""

from __future__ import annotations

import struct
from dataclasses import replace

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.gateway.fastpath.common import STAMP_AT, ToRosKey
from igtl_gateway.gateway.metadata import STAMP
from igtl_gateway.gateway.to_ros.beforehand import metadata_message
from igtl_gateway.wire import Message
from igtl_gateway.wire.header import HEADER_SIZE, NAMES
from igtl_gateway.wire.message import EXTENDED_SIZE

#: Blocks of metadata of a device that are compiled at a time: another one takes the place of the oldest.
MOST_BLOCKS = 4

#: A larger block of metadata, in bytes, is left to the full path: it is compared with each message.
LARGEST_BLOCK = 4_096

_NAMES_SIZE = NAMES.stop
_VERSION_2 = b"\0\2"
#: Sizes in the extended header: of the metadata header, and of the metadata.
_SIZES = struct.Struct(">2xHI")
_IDS = (0x11111111, 0x22222222)


def to_ros_key(link: int, message: Buffer) -> ToRosKey:
    """Return the key of the stream of a whole message: its names, and its metadata as they are at its end."""
    names = bytes(message[NAMES])
    if names[:2] != _VERSION_2 or len(message) < HEADER_SIZE + EXTENDED_SIZE:
        return link, names
    size = block_size(message)
    if not 0 < size <= min(LARGEST_BLOCK, len(message) - HEADER_SIZE - EXTENDED_SIZE):
        return link, names
    return link, names + bytes(message[len(message) - size :])


def names_of(key: ToRosKey) -> bytes:
    """Return the names of a key, without the metadata."""
    return key[1][:_NAMES_SIZE]


def block_size(message: Buffer) -> int:
    """Return the size that a message of header version 2 states for its metadata with their header."""
    head, data = _SIZES.unpack_from(message, HEADER_SIZE)
    return int(head + data)


def are_constant(message: Message) -> bool:
    """Return whether a stream can be compiled with the metadata of a message: without a stamp, and as we write them."""
    return message.layout is None and all(item.key != STAMP for item in message.metadata)


def metadata_form(to: ToRosContext) -> tuple[bytes, int, int]:
    """Return the ROS message of the metadata, with the offsets of stamp and message id."""
    one, other = (metadata_message(replace(to, message_id=message_id)).pack() for message_id in _IDS)
    id_at = next(at for at, (mine, its) in enumerate(zip(one, other, strict=True)) if mine != its)
    return one, STAMP_AT, id_at


class Blocks:
    """The blocks of metadata of each device that are compiled, or would be if they could.

    Args:
        most_devices: with metadata; the messages of others take the full path.
    """

    def __init__(self, most_devices: int) -> None:
        self._most_devices = most_devices
        self._known: dict[ToRosKey, list[ToRosKey]] = {}  # device → its keys, the oldest first
        self._last: dict[ToRosKey, ToRosKey] = {}  # device → key of its last message on the full path

    def admits(self, key: ToRosKey) -> bool:
        """Return whether the stream of a message on the full path may be compiled.

        The first block of a device may be at once, another one when it comes a second time running: metadata that
        change with each message are never compiled.
        """
        device = key[0], names_of(key)
        if key == device:
            return True  # without metadata
        known = self._known.get(device)
        if known is None:
            return len(self._known) < self._most_devices
        comes_again = key in known or self._last.get(device) == key
        self._last[device] = key
        return comes_again

    def add(self, key: ToRosKey) -> ToRosKey | None:
        """Keep an admitted key; return the one whose place it takes, if any."""
        device = key[0], names_of(key)
        if key == device:
            return None
        known = self._known.setdefault(device, [])
        if key in known:
            return None
        known.append(key)
        return known.pop(0) if len(known) > MOST_BLOCKS else None

    def drop(self, link: int) -> None:
        """Forget the devices of a link."""
        self._known = {device: keys for device, keys in self._known.items() if device[0] != link}
        self._last = {device: key for device, key in self._last.items() if device[0] != link}

    def clear(self) -> None:
        self._known.clear()
        self._last.clear()
