"""The latest message of each bridged topic: for queries, for late joiners and for tracking data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.table import row_to_igtl
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.kept import beyond, largest_first
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.streams import Streams, ToIgtlStream
from igtl_gateway.gateway.to_igtl.composer import Composer
from igtl_gateway.gateway.to_igtl.pose_forms import as_type
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.tf_out import TfOut

#: Messages up to this size are never forgotten: poses, and the states of robots.
_SMALL_BYTES = 64 << 10


class Latest:
    """Keeps the latest message of each bridged topic.

    Args:
        moments: tracking data has the poses of its stamp; False in old recordings: all poses.
        forms: answer with frames of the tf tree as the other type of poses, too; False in old recordings.
        room: bytes of large messages that ``forget`` leaves, of streams that are not latched; None: any number, as in
            old recordings.
        latched_room: the same of latched streams.

    Attributes:
        moments: as above.
        entries: topic → its latest message, without its payload if it was forgotten; one for each bridged topic.
    """

    def __init__(
        self,
        streams: Streams,
        guard: Guard,
        tf: TfOut,
        composer: Composer,
        *,
        moments: bool = True,
        forms: bool = True,
        room: int | None = None,
        latched_room: int | None = None,
    ) -> None:
        self.entries: dict[str, Entry] = {}
        self.moments = moments
        self._room = room
        self._latched_room = latched_room
        self._streams = streams
        self._guard = guard
        self._tf = tf
        self._composer = composer
        self._forms = forms

    def get(self, topic: str) -> Entry | None:
        """Return the latest message of a topic; None if there is none, or it was forgotten."""
        entry = self.entries.get(topic)
        return entry if entry and entry.payload else None

    def of(self, cause: Entry, igtl_type: str, device: str) -> list[OutboundMessage]:
        """Return the latest messages of a type and device ("" for any), composed for the time of ``cause``.

        They come from the streams that are sent as this type; if there are none, from streams that can be converted.
        """
        native: list[OutboundMessage] = []
        other: list[OutboundMessage] = []
        for entry in self.entries.values():
            stream = self._streams.to_igtl(entry.channel, entry.type)
            if stream is None or not entry.payload or device not in ("", stream.device, stream.full_name):
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
            if stream and stream.latched and entry.payload:
                yield entry, stream

    def forgotten(self, igtl_type: str, device: str) -> str:
        """Return the setting for which the last message of this type and device ("" for any) was forgotten, or ""."""
        for entry in self.entries.values():
            stream = None if entry.payload else self._streams.to_igtl(entry.channel, entry.type)
            if stream and stream.conversion.igtl_type == igtl_type and device in ("", stream.device, stream.full_name):
                return "latched_mib" if stream.latched else "keep_mib"
        return ""

    def exceed(self) -> bool:
        """Return whether ``forget`` has anything to do."""
        return any(self._beyond())

    def forget(self) -> dict[str, int]:
        """Forget messages that alone exceed their room, then others, until the rest is within it.

        The oldest are first, of latched streams the largest.

        Returns:
            Topic → bytes, of the latched streams.
        """
        others, latched = self._beyond()
        for entry in (*others, *latched):
            self.entries[entry.channel] = replace(entry, payload=())  # in its place: answers are in their order
        return {entry.channel: entry.size for entry in latched}

    def _beyond(self) -> tuple[list[Entry], list[Entry]]:
        """Return the large messages that are too many: of other streams, but not the newest, and of latched ones."""
        large = sorted((one for one in self.entries.values() if one.size > _SMALL_BYTES), key=lambda one: one.seq)
        latched = [one for one in large if self._is_latched(one)]
        others = [one for one in large[:-1] if not self._is_latched(one)]
        return (
            beyond(self._room, others, _size),
            beyond(self._latched_room, largest_first(latched, _size), _size),
        )

    def _is_latched(self, entry: Entry) -> bool:
        stream = self._streams.to_igtl(entry.channel, entry.type)
        return stream is not None and stream.latched

    def _as_type(self, entry: Entry, stream: ToIgtlStream, igtl_type: str) -> list[OutboundMessage]:
        """Convert a kept ROS message to ``igtl_type`` ("": that of its stream); none if it cannot be converted."""
        conversion = row_to_igtl(entry.type, igtl_type) if igtl_type else stream.conversion
        if conversion is None:
            return []
        try:
            out = self._composer.convert(entry, stream, conversion)
            return [replace(out, is_static=stream.latched and not out.ros_stamp_ns)]
        except ConversionError:  # reported when it arrived
            return []


def _size(entry: Entry) -> int:
    return entry.size
