"""The latest message of each bridged topic: for queries, for late joiners and for tracking data."""

from __future__ import annotations

from collections.abc import Iterator

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.table import row_to_igtl
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.streams import Streams, ToIgtlStream
from igtl_gateway.gateway.to_igtl.composer import Composer
from igtl_gateway.gateway.to_igtl.pose_forms import as_type
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.tf_out import TfOut


class Latest:
    """Keeps the latest message of each bridged topic.

    Args:
        forms: answer with frames of the tf tree as the other type of poses, too; False in old recordings.

    Attributes:
        entries: topic → its latest message; at most one for each bridged topic.
    """

    def __init__(self, streams: Streams, guard: Guard, tf: TfOut, composer: Composer, *, forms: bool = True) -> None:
        self.entries: dict[str, Entry] = {}
        self._streams = streams
        self._guard = guard
        self._tf = tf
        self._composer = composer
        self._forms = forms

    def of(self, cause: Entry, igtl_type: str, device: str) -> list[OutboundMessage]:
        """Return the latest messages of a type and device ("" for any), composed for the time of ``cause``.

        They come from the streams that are sent as this type; if there are none, from streams that can be converted.
        """
        native: list[OutboundMessage] = []
        other: list[OutboundMessage] = []
        for entry in self.entries.values():
            stream = self._streams.to_igtl(entry.channel, entry.type)
            if stream is None or device not in ("", stream.device, stream.full_name):
                continue
            outs = self._as_type(entry, stream, igtl_type)
            if stream.max_age_s and not stream.latched:  # a late query must not make old data look new
                least_ns = cause.stamp_ns - self._guard.ahead_ns - round(stream.max_age_s * NS_PER_S)
                outs = [out for out in outs if out.stamp_ns >= least_ns]
            (native if stream.conversion.igtl_type == igtl_type else other).extend(outs)
        for out in self._tf.latest(cause.stamp_ns - self._guard.ahead_ns):
            if device not in ("", out.device, out.full_name):
                continue
            if out.igtl_type == igtl_type:
                native.append(out)
            elif self._forms and (form := as_type(out, igtl_type)):
                other.append(form)
        return native or other

    def has_stream_of(self, igtl_type: str) -> bool:
        """Return whether a stream is sent as this type."""
        streams = (self._streams.to_igtl(one.channel, one.type) for one in self.entries.values())
        own = any(stream.conversion.igtl_type == igtl_type for stream in streams if stream)
        return own or any(out.igtl_type == igtl_type for out in self._tf.latest())

    def latched(self) -> Iterator[tuple[Entry, ToIgtlStream]]:
        """Yield the latest messages of latched streams."""
        for entry in self.entries.values():
            stream = self._streams.to_igtl(entry.channel, entry.type)
            if stream and stream.latched:
                yield entry, stream

    def _as_type(self, entry: Entry, stream: ToIgtlStream, igtl_type: str) -> list[OutboundMessage]:
        """Convert a kept ROS message to ``igtl_type`` ("": that of its stream); none if it cannot be converted."""
        conversion = row_to_igtl(entry.type, igtl_type) if igtl_type else stream.conversion
        if conversion is None:
            return []
        try:
            return [self._composer.convert(entry, stream, conversion)]
        except ConversionError:  # reported when it arrived
            return []
