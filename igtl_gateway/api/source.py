"""What the streams of one recording share: the open file, the decoder of ROS types, and the configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ClosedRecording, ConfigError, DamagedRecording
from igtl_gateway.base.untrusted import definitions
from igtl_gateway.base.untrusted.decoding import MessageDecoder
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.marks import Mark
from igtl_gateway.gateway.stream_units import StreamUnits
from igtl_gateway.record.sessionfile import facts
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.record.sessionfile.channels import ChannelSummary
from igtl_gateway.record.sessionfile.header_stamps import StampPlace, stamp_place
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_config import units_of
from igtl_gateway.replay.recorded_marks import marks_of
from igtl_gateway.replay.recorded_stamps import RecordedStamps
from igtl_gateway.replay.shared_names import shared_names

if TYPE_CHECKING:
    import pyarrow

Item = TypeVar("Item")
Times = npt.NDArray[np.int64]


@dataclass(slots=True)
class SourceState:
    """Whether a recording was closed."""

    closed: bool = False


@dataclass(frozen=True)
class Source:
    """An open recording.

    Attributes:
        file: the file, or the folder of parts.
        limits: bounds for everything that is read from it.
        start_ns, end_ns: UTC ns of the first and the last entry.
        state: what changes.
    """

    file: SessionFile
    limits: FileLimits
    start_ns: int
    end_ns: int
    state: SourceState = field(default_factory=SourceState)

    def check_open(self) -> None:
        """Raise ClosedRecording if the recording was closed."""
        if self.state.closed:
            raise ClosedRecording(
                f"{self.file.path}: found a closed recording, expected an open one; read it in its `with` statement"
            )

    @cached_property
    def config(self) -> Config | None:
        """The recorded configuration; None for files of other programs, and if this version cannot read it."""
        if self.file.foreign or not self.file.session:
            return None
        try:
            return Config.from_dict(facts.configuration(self.file.session))
        except (ConfigError, DamagedRecording):
            return None

    @cached_property
    def acceptance(self) -> Acceptance:
        """Which bytes the session accepted as messages of OpenIGTLink."""
        return Acceptance.of(self.config or Config())

    @cached_property
    def _marks(self) -> tuple[Mark, ...]:
        self.check_open()
        with limits_in_force(self.limits):
            return marks_of(self.file)

    def marks(self) -> tuple[Mark, ...]:
        """Return the marks of the whole recording."""
        return self._marks

    @cached_property
    def stamps(self) -> RecordedStamps:
        """The corrections of stamps that the recording states."""
        self.check_open()
        with limits_in_force(self.limits):
            return RecordedStamps(self.file)

    def blocks(self, channel: ChannelSummary, window: tuple[int, int]) -> Iterator[MessageBlock]:
        """Yield the messages of a stream in a window (UTC ns), with the corrections of their stamps."""
        stamps = self.stamps
        found = self.limited(lambda: self.file.blocks(channel, *window))
        return (stamps.block(channel, block) for block in found) if stamps else found

    @cached_property
    def decoder(self) -> MessageDecoder:
        """Decodes messages of the ROS types that the file defines."""
        return MessageDecoder(lambda ros_type: self.file.definitions.get(ros_type, ""))

    def limited(self, items: Callable[[], Iterator[Item]]) -> Iterator[Item]:
        """Yield items that are read with the limits of the recording; between them the caller has its own."""
        self.check_open()
        with limits_in_force(self.limits):
            each = items()
        while True:
            self.check_open()
            with limits_in_force(self.limits):
                item = next(each, None)
            if item is None:
                return
            yield item

    def shared_topics(self) -> Mapping[str, str]:
        """Return topic → stream of the topics that the gateway made of a stream that several peers sent at one time."""
        return self._shared_topics

    def shared_streams(self) -> list[tuple[str, str]]:
        """Return the streams that several peers sent at one time, and the base frame of the session of each."""
        found = []
        for stream in dict.fromkeys(self.shared_topics().values()):
            config, name = self.config, stream
            if self.file.merge:
                part, _, name = stream.removeprefix("/").partition("/")
                parts = {each["name"]: each["session"] for each in self.file.merge.facts["parts"]}
                try:
                    config = Config.from_dict(facts.configuration(parts.get(part, {})))
                except (ConfigError, DamagedRecording):
                    config = None
            found.append((name, (config or Config()).base_frame))
        return found

    @cached_property
    def _shared_topics(self) -> dict[str, str]:
        found: dict[str, str] = self.file.merge.shared_topics if self.file.merge else {}
        for note in self.limited(lambda: shared_names(self.file)):
            found |= {topic: note.stream for topic in note.data.get("topics", ()) if isinstance(topic, str)}
        return found

    def decode(self, ros_type: str, data: bytes) -> Any:
        """Decode a ROS message.  Raises DamagedRecording."""
        try:
            with limits_in_force(self.limits):
                return self.decoder.decode(ros_type, data)
        except (DamagedRecording, MemoryError):
            raise
        except Exception as error:  # rosbags raises many types of errors for untrusted bytes
            raise DamagedRecording(f"{ros_type}: cannot be decoded: {type(error).__name__}: {error}") from None

    @cached_property
    def _types(self) -> dict[str, Mapping[str, Any]]:
        return {}

    def types(self, ros_type: str) -> Mapping[str, Any]:
        """Return the definition of a ROS type with its dependencies.  Raises DamagedRecording."""
        if ros_type not in self._types:
            text = self.file.definitions.get(ros_type, "")
            if not text:
                raise DamagedRecording(f"{self.file.path}: found no definition of {ros_type}")
            self._types[ros_type] = definitions.parse_definition(text, ros_type)
        return self._types[ros_type]

    def stamp_place(self, ros_type: str) -> StampPlace | None:
        """Return where the messages of a ROS type have their stamp; None without one, or without a definition."""
        try:
            return stamp_place(self.types(ros_type), ros_type)
        except DamagedRecording:
            return None

    def table(self, channel: ChannelSummary, blocks: Iterable[MessageBlock], unit: str) -> tuple[pyarrow.Table, Times]:
        """Return the messages of a stream, with lengths in ``unit``, as an Arrow table, and the message of each row.

        Raises Unavailable without pyarrow.
        """
        from igtl_gateway.api import arrow_tables  # pyarrow is an extra

        name = channel.stream or channel.topic
        definitions = self.file.definitions
        maker = arrow_tables.TableMaker(
            channel.kind, channel.entry_type, name, definitions, self.decoder, unit, self.acceptance
        )
        with limits_in_force(self.limits):
            found, rows, count = [], [np.zeros(0, np.int64)], 0
            for block in blocks:
                table, reasons, own = maker.table_and_rows(block)
                found.append((table, reasons))
                rows.append(own + count)
                count += len(block)
            return arrow_tables.joined(found), np.concatenate(rows)

    def unit(self, channel: ChannelSummary) -> str:
        """Return the unit of lengths in the messages of a stream, but of the links in ``units_of_links``."""
        return self._units.of(channel.kind, channel.stream, channel.entry_type)

    def units_of_links(self, channel: ChannelSummary) -> Mapping[int, str]:
        """Return the links whose messages of a stream have a unit of their own, with that unit."""
        return self._units.of_links(channel.kind, channel.stream, channel.entry_type)

    @cached_property
    def _units(self) -> StreamUnits:
        return units_of(self.config or Config(), self.file)
