"""A file written from the messages of another one, as they are: schemas, channels, bytes, times and numbers.

For what must not depend on what is known here and today, such as definitions of message types.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import Writer

from igtl_gateway import __version__
from igtl_gateway.errors import RecordingError
from igtl_gateway.sessionfile import layout
from igtl_gateway.sessionfile.stream import Compression
from igtl_gateway.sessionfile.writer import COMPRESSIONS, TopicCount, create_file, os_error_text


class CopyWriter:
    """Writes one file; a context manager, which closes it, or removes it when an error leaves it.

    Args:
        path: the file to create.
        profile, library: of the file that is copied.
        session: its session metadata; empty for foreign files.
        compression: of the chunks.
        overwrite: replace an existing file instead of refusing it.

    Every call raises RecordingError when the disk refuses.
    """

    def __init__(
        self,
        path: Path,
        profile: str,
        library: str,
        session: dict[str, str],
        *,
        compression: Compression,
        overwrite: bool = False,
    ) -> None:
        self.path = path
        #: Messages written so far, and the first and the last of their times, 0 before there is one.
        self.messages = self.start_ns = self.end_ns = 0
        self._topics: dict[tuple[str, str], TopicCount] = {}
        self._keys: dict[int, tuple[str, str]] = {}  # number here → topic and type
        self._file = create_file(path, overwrite)
        self._schemas: dict[int, int] = {}  # number there → number here
        self._channels: dict[int, int] = {}
        with self._disk_errors():
            self._mcap = Writer(self._file, compression=COMPRESSIONS[compression])
            self._mcap.start(profile, f"{library}; copied by igtl-gateway {__version__}".removeprefix("; "))
            if session:
                # twice, like all that a whole file depends on (see writer)
                self._mcap.add_metadata(layout.SESSION_METADATA, layout.seal(session))
                self._mcap.add_metadata(layout.SESSION_COPY_METADATA, layout.seal(session))

    def __enter__(self) -> CopyWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error:
            self._abandon()

    def add_metadata(self, metadata: Metadata) -> None:
        """A metadata record, as it is."""
        with self._disk_errors():
            self._mcap.add_metadata(metadata.name, metadata.metadata)

    def add_attachment(self, attachment: Attachment) -> None:
        """An attachment, as it is."""
        with self._disk_errors():
            self._mcap.add_attachment(
                attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
            )

    def write(self, schema: Schema | None, channel: Channel, message: Message) -> None:
        """A message of a channel."""
        with self._disk_errors():
            here = self._channels.get(channel.id)
            if here is None:
                here = self._channels[channel.id] = self._open_channel(schema, channel)
            self._mcap.add_message(here, message.log_time, message.data, message.publish_time, message.sequence)
        key = self._keys[here]
        self._topics[key] = replace(self._topics[key], count=self._topics[key].count + 1)
        self.start_ns = min(self.start_ns, message.log_time) if self.messages else message.log_time
        self.end_ns = max(self.end_ns, message.log_time)
        self.messages += 1

    def topics(self) -> list[TopicCount]:
        """What is in it, by topic and type."""
        return list(self._topics.values())

    def close(self, ledger: dict[str, Any]) -> int:
        """Write the ledger and the index.  Gives the size of the file in bytes."""
        with self._disk_errors():
            self._mcap.flush()  # type: ignore[no-untyped-call]
            facts = {layout.LEDGER_KEY: json.dumps(ledger, sort_keys=True)}
            self._mcap.add_metadata(layout.LEDGER_METADATA, layout.seal(facts))
            self._mcap.finish()  # type: ignore[no-untyped-call]
            size = self._file.tell()
            self._file.close()
        return size

    def _open_channel(self, schema: Schema | None, channel: Channel) -> int:
        number = 0
        if schema:
            if schema.id not in self._schemas:
                self._schemas[schema.id] = self._mcap.register_schema(schema.name, schema.encoding, schema.data)
                self._repeat(Schema(self._schemas[schema.id], schema.data, schema.encoding, schema.name))
            number = self._schemas[schema.id]
        here = self._mcap.register_channel(channel.topic, channel.message_encoding, number, channel.metadata)
        self._repeat(Channel(here, channel.topic, channel.message_encoding, channel.metadata, number))
        key = self._keys[here] = (channel.topic, schema.name if schema else "")
        if key not in self._topics:
            qos = layout.parse_qos_yaml(channel.metadata.get(layout.QOS_KEY, ""))
            profile = layout.qos_yaml(qos) if qos else ""
            self._topics[key] = TopicCount(*key, profile, channel.metadata.get(layout.TYPE_HASH_KEY, ""), 0)
        return here

    def _repeat(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._file.write(builder.end())  # type: ignore[no-untyped-call]

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._abandon()
            raise RecordingError(f"cannot write {self.path}: {os_error_text(error)}") from error

    def _abandon(self) -> None:
        """Half a copy is of no use."""
        if not self._file.closed:
            self._file.raw.close()
            self.path.unlink(missing_ok=True)
