"""Large outputs in a file: all bytes, the digest, or nothing.

An output follows from its input and the state of the gateway, byte for byte, as ``verify`` shows.  So its digest is
enough to prove it, and a reader of the file computes its bytes (``derived``).  That needs the input and the state.
Therefore an output is written in full

* if one entry between its input and it is not in the file;
* if its input is small, such as a query or a link: then it follows from the state, not from the input;
* after the recorder's queue has refused an entry: it may have been one that the gateway learned from;
* in a file that lacks earlier inputs, if the gateway keeps something from input to input: of videos, and of volumes
  that come in parts, which makes an output larger than its input.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable
from hashlib import sha256
from typing import TYPE_CHECKING, Literal

from mcap.records import Channel

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.values import value
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.layout import WIRE_TOPICS, LayoutError
from igtl_gateway.record.sessionfile.messages import RawPacker, unpack_raw

if TYPE_CHECKING:
    from igtl_gateway.record.sessionfile.chunk_columns import Row

#: How large outputs are written.
Outputs = Literal["full", "digest", "none"]
#: An output of this size is large.
LARGE_BYTES = 64 << 10
#: An input below this size is small: what follows from it alone is not large.
_SMALL_BYTES = 1 << 10
#: What an output may have besides the bytes of its input: names, metadata.
_BESIDE_BYTES = 64 << 10
#: Zeros that stand for bytes that are not at hand: more than a message has.
_MOST_ZEROS = 1 << 30
#: Name of the digest in the metadata of a channel.
DIGEST_NAME = "sha256"
_DIGEST = struct.Struct("<Q32s")
#: The bytes that stand for a payload.
DIGEST_BYTES = _DIGEST.size


class LargeOutputs:
    """How the files of a recording have large outputs.

    Attributes:
        mode: as above.
        lacks_inputs: an input is not in the recording that the gateway may have learned from.
        lacks_parts: earlier inputs of some streams are not in the recording.
        left_out: outputs that were not written, by stream.
    """

    def __init__(self, mode: Outputs) -> None:
        self.mode = mode
        self.lacks_inputs = self.lacks_parts = False
        self.left_out: Counter[str] = Counter()


class Causes:
    """Follows the entries of one file, and decides which outputs can be computed from it.

    Args:
        outputs: of the recording.
        midway: the file begins with a prologue.
    """

    def __init__(self, outputs: LargeOutputs, *, midway: bool) -> None:
        self._outputs, self._midway = outputs, midway
        self._seq = self._place = -1  # of the last input: its number, and how many entries were before it
        self._size = 0

    def input(self, entry: Entry, place: int) -> None:
        """An input follows; ``place``: how many entries are before it."""
        self._seq, self._place, self._size = entry.seq, place, entry.size

    def follows(self, entry: Entry, place: int) -> bool:
        """Whether a large output can be computed; arguments as of :meth:`input`."""
        outputs, size = self._outputs, self._size
        if self._seq < 0 or outputs.lacks_inputs or size < _SMALL_BYTES:
            return False
        # numbers increase, so as many entries as numbers are all of them, and the cause is one of them
        if entry.seq - self._seq != place - self._place:
            return False
        is_kept = "video" in entry.type.lower() or entry.size > size + _BESIDE_BYTES
        return not (is_kept and (self._midway or outputs.lacks_parts))


def pack_digest(entry: Entry, data: Buffer) -> bytes:
    """The message that stands for an output whose payload is ``data``.  Raises LayoutError."""
    content = _DIGEST.pack(len(data), sha256(data).digest())
    if entry.kind in WIRE_TOPICS:
        return RawPacker(entry).head(entry, content) + content
    named = Entry(
        entry.seq, entry.stamp_ns, Kind.IGTL_OUT, f"{entry.type}/", entry.type, (content,), (), entry.source_ns
    )
    return RawPacker(named).head(named, content) + content


class OutputDigest:
    """An output of which a file has the digest.

    Args:
        message: as :func:`pack_digest` made it.
        seq, log_ns, publish_ns: of the MCAP message.

    Attributes:
        entry: of OpenIGTLink its channel, type, links and stamps.
        size: bytes of its payload.

    Raises LayoutError.
    """

    def __init__(self, message: Buffer, seq: int, log_ns: int, publish_ns: int) -> None:
        self.entry = unpack_raw(message, seq, log_ns, publish_ns)
        content = self.entry.data()
        if len(content) != _DIGEST.size:
            raise LayoutError(f"digest: found {counted(len(content), 'byte')}, expected {_DIGEST.size}")
        self.size, self.digest = _DIGEST.unpack(content)

    def is_of(self, payload: Buffer) -> bool:
        """Whether a payload is that of the output."""
        return len(payload) == self.size and sha256(payload).digest() == self.digest

    def message(self, payload: bytes, kind: Kind) -> bytes:
        """The message of the output in a file that has all bytes."""
        return RawPacker(self.entry).head(self.entry, payload) + payload if kind in WIRE_TOPICS else payload


@value(frozen=True, slots=True)
class DigestedOutput(Entry):
    """An output whose bytes are not at hand: as many zeros are in their place.

    Attributes:
        digest: SHA-256 of its bytes.
        true_size: their number; more than there are zeros in a damaged file.
    """

    digest: bytes = b""
    true_size: int = 0


def digest_decoder(channel: Channel, kind: Kind) -> Callable[[Row, int], Entry]:
    """What makes entries of the digests of a channel, without computing anything; it raises LayoutError."""
    topic, ros_type = (channel.metadata.get(key, "") for key in (layout.DIGEST_TOPIC_KEY, layout.DIGEST_TYPE_KEY))

    def decode(row: Row, seq: int) -> Entry:
        _, _, log_ns, publish_ns, begin, end, data = row
        digest = OutputDigest(memoryview(data)[begin:end], seq, log_ns, publish_ns)
        found, payload = digest.entry, (bytes(min(digest.size, _MOST_ZEROS)),)
        if kind in WIRE_TOPICS:
            of = found.channel, found.type, payload, found.links
        else:
            of = topic, ros_type, payload, ()
        return DigestedOutput(seq, log_ns, kind, *of, found.source_ns, digest.digest, digest.size)

    return decode


class NotComputed(DamagedRecording):
    """The bytes of an output are not in the file, and cannot be computed from it."""
