"""One stream of a recording: its times, and its messages as arrays or one by one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.clouds import Clouds
from igtl_gateway.api.display import html_table
from igtl_gateway.api.images import Images
from igtl_gateway.api.moments import Moment, to_ns
from igtl_gateway.api.poses import Poses
from igtl_gateway.api.posing import read_poses
from igtl_gateway.api.source import Source
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.base.extras import missing
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted.limits import limits_in_force
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.interleaving import is_mixed
from igtl_gateway.gateway.log.one_clock import StreamTimes
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.record.sessionfile.channels import ChannelSummary

if TYPE_CHECKING:
    import pandas
    import pyarrow

Times = npt.NDArray[np.int64]

#: Head of the tables of streams in notebooks.
STREAM_HEAD = ("stream", "type", "direction", "messages", "first, s", "last, s")
#: The window of a whole stream.
_ALWAYS = (0, (1 << 63) - 1)
#: Characters of a content that ``repr`` shows.
_SHOWN = 120


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A decoded message.

    Attributes:
        number: entry number; 0 in files of other programs.
        time: gateway time, UTC ns.
        source_time: the sender's stamp, UTC ns; 0 = unset.
        type: OpenIGTLink or ROS type.
        content: of OpenIGTLink a class of ``igtl_gateway.wire``, such as ``Transform``; of ROS an object with the
            fields of the definition.
        metadata: of OpenIGTLink messages with header version 2.
    """

    number: int
    time: int
    source_time: int
    type: str
    content: Any
    metadata: dict[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        text = " ".join(repr(self.content).split())
        content = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
        return f"<RecordedMessage {self.number:,}: {self.type}, {content}>"


class SeveralSenders(ConfigError):
    """Several peers sent a stream in turn: its messages are not one movement."""


class Stream:
    """One stream of a recording; get it from ``Recording``.  Its items are the decoded messages.

    Nothing is read before it is used, and arrays of times are kept.

    Attributes:
        key: name under which ``recording[key]`` finds it.
        name: ``TYPE/device name`` of OpenIGTLink, or ROS topic.
        type: OpenIGTLink or ROS type.
        direction: ``"igtl_in"`` or ``"ros_in"`` for messages that the gateway received, ``"igtl_out"`` or ``"ros_out"``
            for messages that it sent.
    """

    def __init__(
        self, source: Source, channel: ChannelSummary, key: str, window: tuple[int, int], link: int = 0
    ) -> None:
        self._source, self._channel, self._window, self._link = source, channel, window, link
        self.key = key
        self.name = channel.stream or channel.topic
        self.type = channel.entry_type
        self.direction = channel.kind.value

    def __repr__(self) -> str:
        return f"<Stream {self.key!r}: {self.count:,} × {self.type}, {self.direction}>"

    def _repr_html_(self) -> str:
        return html_table("", STREAM_HEAD, [self.html_row()])

    def html_row(self) -> tuple[object, ...]:
        """The row of the stream in a table with ``STREAM_HEAD``."""
        seconds = [f"{(time - self._source.start_ns) / NS_PER_S:.3f}" if time else "" for time in self._span]
        return self.key, self.type, self.direction, f"{self.count:,}", *seconds

    def __len__(self) -> int:
        return self.count

    @cached_property
    def unit(self) -> str:
        """Unit of lengths in its messages.  Raises ConfigError if they went to peers, or came from them, in several."""
        common, own = self._source.unit(self._channel), self._source.units_of_links(self._channel)
        if not own or not self.count:
            return common
        found = {link: own.get(link, common) for link in np.unique(self.links).tolist()}
        if len(set(found.values())) > 1:
            units = ", ".join(f"{unit} with link {link}" for link, unit in found.items())
            raise ConfigError(
                f"{self.key}: found messages in {units}, expected those of one unit, as in "
                f"recording['{self.key}@{min(found)}']"
            )
        return found.popitem()[1]

    def __iter__(self) -> Iterator[RecordedMessage]:
        return self.messages()

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> npt.NDArray[Any]:
        raise TypeError(f"{self.key}: found a stream, expected its poses(), images(), points() or times for numpy")

    @property
    def _is_igtl(self) -> bool:
        return self._channel.kind in (Kind.IGTL_IN, Kind.IGTL_OUT)

    @property
    def _is_whole(self) -> bool:
        start_ns, end_ns = self._window
        return not self._link and start_ns <= self._source.start_ns and end_ns > self._source.end_ns

    @property
    def count(self) -> int:
        """Number of messages; of a whole stream it is known without reading them."""
        return self._channel.count if self._is_whole else len(self.times)

    @cached_property
    def _span(self) -> tuple[int, int]:
        if self._is_whole:
            self._source.check_open()
            return self._source.file.span(self._channel)
        return (int(self.times[0]), int(self.times[-1])) if len(self.times) else (0, 0)

    @property
    def first_time(self) -> int:
        """Gateway time of the first message, UTC ns; 0 without messages."""
        return self._span[0]

    @property
    def last_time(self) -> int:
        """Gateway time of the last message, UTC ns; 0 without messages."""
        return self._span[1]

    def blocks_until_end(self) -> Iterator[MessageBlock]:
        """The messages before the end of the part and those before its start, too: for messages that stay valid."""
        return self._of_link(self._source.blocks(self._channel, (0, self._window[1])))

    def blocks(self) -> Iterator[MessageBlock]:
        """Yield the messages in blocks of arrays, undecoded: for programs that decode themselves."""
        return self._of_link(self._source.blocks(self._channel, self._window))

    @property
    def is_indexed(self) -> bool:
        """Whether ``blocks_between`` reads a message without those before it."""
        return self._source.file.is_indexed

    def blocks_between(self, start_ns: int, end_ns: int) -> Iterator[MessageBlock]:
        """Yield its messages with gateway times from ``start_ns`` on and before ``end_ns``, as ``blocks``.

        Only their chunks are unpacked if ``is_indexed``, of which the last ones are kept: for programs that read single
        messages in any order.
        """
        window = max(self._window[0], start_ns), min(self._window[1], end_ns)
        return self._of_link(self._source.blocks(self._channel, window))

    def _of_link(self, blocks: Iterator[MessageBlock]) -> Iterator[MessageBlock]:
        return blocks if not self._link else (block.where(_links_of(block) == self._link) for block in blocks)

    @cached_property
    def _heads(self) -> tuple[Times, Times, Times, Times]:
        blocks = [(block.times, block.source_times, block.numbers, _links_of(block)) for block in self.blocks()]
        nothing = np.zeros(0, np.int64)
        times, sources, numbers, links = (
            np.concatenate([nothing, *(block[column] for block in blocks)]) for column in range(4)
        )
        for array in (times, sources, numbers, links):
            array.flags.writeable = False
        return times, sources, numbers, links

    @property
    def times(self) -> Times:
        """(N,) int64: gateway time of each message, UTC ns; strictly increasing, of other programs ascending."""
        return self._heads[0]

    @property
    def acceptance(self) -> Acceptance:
        """Which bytes the session accepted as messages of OpenIGTLink: ``acceptance.message(payload)`` decodes them."""
        return self._source.acceptance

    @property
    def source_times(self) -> Times:
        """(N,) int64: the sender's stamp of each message, UTC ns; 0 = unset."""
        return self._heads[1]

    @cached_property
    def stamps(self) -> Times:
        """(N,) int64: the time of each measurement, UTC ns; 0 = unset.

        It is ``header.stamp`` of ROS messages that begin with a header (of the first element of a list such as
        TFMessage), otherwise, or if none is set, ``source_times``.
        """
        place = None if self._is_igtl else self._source.stamp_place(self.type)
        if place is None:
            return self.source_times
        found = np.concatenate([np.zeros(0, np.int64), *(place.of(block) for block in self.blocks())])
        found.flags.writeable = False
        return found if np.any(found) else self.source_times

    @cached_property
    def stream_times(self) -> StreamTimes:
        """Its times, as ``one_clock`` joins them with those of other streams; a peer is one sender."""
        found = self._own_times
        correction = self._source.stamps.of(self._channel.stream, self.type)
        if correction is None or self.direction.endswith("_out"):
            return found
        # its clock is that of the stream that its lag was measured against
        for channel in self._source.file.channels:
            types = {correction.behind_type, channel.entry_type if not correction.behind_type else ""}
            if channel.kind.is_input and channel.stream == correction.behind_channel and channel.entry_type in types:
                behind = Stream(self._source, channel, correction.behind, _ALWAYS)
                return replace(found, behind=behind._own_times)
        return found

    @property
    def _own_times(self) -> StreamTimes:
        self._source.check_open()
        with limits_in_force(self._source.limits):
            links = (self._link,) if self._link else self._source.file.first_links(self._channel)
        return StreamTimes(self.key, self.times, self.stamps, f"link {links}" if links else "")

    @property
    def numbers(self) -> Times:
        """(N,) int64: entry number of each message; 0 in files of other programs."""
        return self._heads[2]

    @property
    def links(self) -> Times:
        """(N,) int64: number of the first link that each message came from or went to; 0 for ROS."""
        return self._heads[3]

    def between(self, start: Moment | None = None, end: Moment | None = None) -> Stream:
        """Return the part of the stream from ``start`` on and before ``end``.

        Args:
            start: seconds from the start of the recording (negative: from its end), UTC ns, a datetime, or text.
            end: likewise; None: to the end.

        Raises:
            ConfigError: a moment cannot be read, or the end is before the start.

        Examples:
            >>> last_second = recording["TRANSFORM/ToolToBase"].between(-1.0)
        """
        window = narrowed(self._source, self._window, start, end)
        return Stream(self._source, self._channel, self.key, window, self._link)

    def of_link(self, link: int) -> Stream:
        """Return the messages that came from one link, or went to it first; ``recording["NAME@LINK"]`` is the same."""
        return Stream(self._source, self._channel, f"{self.key}@{link}", self._window, link)

    def check_sender(self) -> None:
        """Raise SeveralSenders if several peers sent the messages in turn: together they are not one movement."""
        if self.direction.startswith("ros") and (stream := self._source.shared_topics().get(self.name)):
            _, part, its = stream.split("/", 2) if stream.startswith("/") else ("", "", stream)  # of a merged session
            place = f"igtl_gateway.open('{self._source.file.path}/{part}')" if part else "recording"
            raise SeveralSenders(
                f"{self.key}: found messages of several peers, expected those of one, as in {place}['{its}@LINK']"
            )
        if self.direction == "igtl_in" and is_mixed(self.links):
            links = " and ".join(map(str, np.unique(self.links)))
            raise SeveralSenders(
                f"{self.key}: found messages of links {links} in turn, expected those of one, as in "
                f"recording['{self.key}@{int(self.links.min())}']"
            )

    def messages(self) -> Iterator[RecordedMessage]:
        """Yield the decoded messages in order.

        Raises:
            WireError: an OpenIGTLink message is damaged.
            DamagedRecording: a ROS message is damaged, or the file has no definition of its type.
        """
        for block in self.blocks():
            for index in range(len(block)):
                yield self._message(block, index)

    def _message(self, block: MessageBlock, index: int) -> RecordedMessage:
        head = int(block.numbers[index]), int(block.times[index]), int(block.source_times[index])
        payload = block.payload(index)
        if self._is_igtl:
            message = self._source.acceptance.message(payload)
            return RecordedMessage(
                *head, message.type, message.content, {item.key: item.text for item in message.metadata}
            )
        return RecordedMessage(*head, self.type, self._source.decode(self.type, bytes(payload)))

    def poses(self, frame: str = "") -> Poses:
        """Return all messages as poses.

        Types: TRANSFORM, POSITION, QTRANS; of ROS TransformStamped, PoseStamped, Odometry and others with one pose.  Of
        types with several poses (TDATA, QTDATA, TFMessage), ``frame`` chooses one.

        Args:
            frame: name of the tool or child frame.

        Returns:
            The poses in the unit of the messages; ``Poses.in_unit`` converts them.

        Raises:
            ConfigError: the type has no pose, no message has one, ``frame`` is missing or unknown, or several peers
                sent the stream in turn (``of_link``).

        Examples:
            >>> poses = recording["TRANSFORM/ToolToBase"].poses()
            >>> poses.matrices.shape, poses.unit, poses.parent, poses.child
            ((1200, 4, 4), 'mm', 'Base', 'Tool')
        """
        self.check_sender()
        return read_poses(self._source, self._channel, self.unit, self.blocks(), frame)

    def poses_of(self, blocks: Iterable[MessageBlock], frame: str = "") -> Poses:
        """Return the poses in blocks of its messages, as ``poses`` does: for programs that read a file once."""
        return read_poses(self._source, self._channel, self.unit, blocks, frame)

    def images_of(self, blocks: Iterable[MessageBlock]) -> Images:
        """Return the images in blocks of its messages, as ``images`` does; of several peers, too."""
        return Images(self._source, self._channel, self.unit, list(blocks))

    def points_of(self, blocks: Iterable[MessageBlock]) -> Clouds:
        """Return the points in blocks of its messages, as ``points`` does."""
        return Clouds(self._source, self._channel, self.unit, list(blocks))

    def stamps_of(self, block: MessageBlock) -> Times:
        """Return the stamps (N,) in a block of its messages, as ``stamps`` has them, UTC ns; 0 = unset."""
        place = None if self._is_igtl else self._source.stamp_place(self.type)
        return block.source_times if place is None else place.of(block)

    def positions(self, unit: str = "", frame: str = "") -> npt.NDArray[Any]:
        """Return the positions of the poses, (N, 3) float64.

        Args:
            unit: ``"mm"``, ``"m"`` …; default: that of the messages.
            frame: as of ``poses``.

        Raises:
            ConfigError: as ``poses``, or the unit is unknown.
        """
        poses = self.poses(frame)
        return poses.in_unit(unit or poses.unit).positions

    def images(self) -> Images:
        """Return the images as a sequence that decodes each image when it is used.

        Types: IMAGE; of ROS ``sensor_msgs/Image`` (without geometry) and ``igtl_msgs/Volume``.

        Raises:
            ConfigError: the type has no images.
        """
        self.check_sender()
        return Images(self._source, self._channel, self.unit, list(self.blocks()))

    def points(self) -> Clouds:
        """Return the point clouds and point lists as a sequence that decodes each one when it is used.

        Types: POINT, POLYDATA; of ROS PointCloud2, ``igtl_msgs/PointList``, Marker and PointStamped.

        Raises:
            ConfigError: the type has no points.
        """
        self.check_sender()
        return Clouds(self._source, self._channel, self.unit, list(self.blocks()))

    def to_arrow(self) -> pyarrow.Table:
        """Return all messages as an Arrow table: a row per message.

        The columns ``entry``, ``time_ns`` and ``source_ns`` (null = unset) come first, then the fields of the message
        with the names that ``export --to csv`` has.  The metadata of header version 2 is the column ``metadata``, a
        map, if any message has some.  The metadata of a field has its ``unit``.  Messages that cannot be
        decoded have no row; ``schema.metadata[b"left_out"]`` has their number by reason, as JSON.

        Raises:
            Unavailable: pyarrow is not installed; the extra ``arrow`` installs it.
        """
        return self.arrow_and_rows()[0]

    def arrow_and_rows(self) -> tuple[pyarrow.Table, Times]:
        """Return the table of :meth:`to_arrow`, and for each of its rows the index of the message (N,), int64.

        Raises:
            Unavailable: pyarrow is not installed; the extra ``arrow`` installs it.
        """
        return self._source.table(self._channel, self.blocks(), self.unit)

    def to_pandas(self) -> pandas.DataFrame:
        """Return all messages as a data frame: the table of :meth:`to_arrow`, with the gateway time as index.

        ``frame.attrs["units"]`` has the units by column.

        Raises:
            Unavailable: pandas is not installed; the extra ``pandas`` installs it.
        """
        return to_frame(self.to_arrow())


def _links_of(block: MessageBlock) -> Times:
    return np.zeros(len(block), np.int64) if block.links is None else block.links


def to_frame(table: pyarrow.Table) -> pandas.DataFrame:
    """Return an Arrow table as a data frame.  Raises Unavailable without pandas."""
    try:
        import pandas
    except ImportError as error:
        raise Unavailable(missing("pandas", error)) from None
    frame = table.to_pandas()
    frame.index = pandas.DatetimeIndex(pandas.to_datetime(frame["time_ns"], unit="ns", utc=True), name="time")
    frame.attrs["units"] = {
        field.name: field.metadata[b"unit"].decode() for field in table.schema if b"unit" in (field.metadata or {})
    }
    return frame


def narrowed(source: Source, window: tuple[int, int], start: Moment | None, end: Moment | None) -> tuple[int, int]:
    """Return the part of a window of time from ``start`` on and before ``end``; UTC ns.  Raises ConfigError."""
    span = source.start_ns, source.end_ns
    first_ns = window[0] if start is None else to_ns(start, *span, "start", source.marks)
    last_ns = window[1] if end is None else to_ns(end, *span, "end", source.marks)
    if start is not None and end is not None and last_ns < first_ns:
        raise ConfigError(f"end: found {end!r}, which is before {start!r}, expected a moment after the start")
    first_ns = max(window[0], first_ns)
    return first_ns, max(min(window[1], last_ns), first_ns)
