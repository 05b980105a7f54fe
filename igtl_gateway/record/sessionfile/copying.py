"""Writing the messages of another file as they are: schemas, channels, bytes, times and numbers.

For output that must not depend on what this program and machine know, such as definitions of message types.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.records import Attachment, Channel, Message, Metadata, Schema

from igtl_gateway.base.errors import RecordingError
from igtl_gateway.base.version import __version__
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.chunks import PackedChunk
from igtl_gateway.record.sessionfile.compression import Compression
from igtl_gateway.record.sessionfile.new_file import create_file, os_error_text
from igtl_gateway.record.sessionfile.side_file import RecordingPart, topic_counts
from igtl_gateway.record.sessionfile.stream import McapStream


class CopyWriter:
    """Writes one file; a context manager, which closes the file.

    Args:
        path: the file to create.
        profile, library: of the file that is copied.
        session: its session metadata; empty for foreign files.
        compression: of the chunks.

    Every method raises RecordingError when the disk refuses.
    """

    def __init__(
        self,
        path: Path,
        profile: str,
        library: str,
        session: dict[str, str],
        *,
        compression: Compression,
    ) -> None:
        self.path = path
        self._file = create_file(path)
        self._mcap = McapStream(self._file, compression=compression)
        self._schemas: set[int] = set()  # numbers in both files
        self._channels: set[int] = set()
        with self._disk_errors():
            self._mcap.start(profile, f"{library}; copied by igtl-gateway {__version__}".removeprefix("; "))
            for name in layout.SESSION_RECORDS if session else ():
                self._mcap.add_metadata(name, layout.seal(session))

    def __enter__(self) -> CopyWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with suppress(OSError):
            self._file.raw.close()  # closed already, or without what a full disk did not take

    def add_metadata(self, metadata: Metadata) -> None:
        """A metadata record, as it is."""
        with self._disk_errors():
            self._mcap.add_metadata(metadata.name, metadata.metadata)

    def add_attachment(self, attachment: Attachment) -> None:
        """An attachment, as it is."""
        given = attachment
        with self._disk_errors():
            self._mcap.add_attachment(given.name, given.media_type, given.data, given.log_time, given.create_time)

    def write(self, schema: Schema | None, channel: Channel, message: Message) -> None:
        """A message of a channel."""
        with self._disk_errors():
            self._define(schema, channel)
            self._mcap.add_message(
                channel.id, message.log_time, b"", message.data, message.publish_time, message.sequence
            )

    def write_chunk(
        self, definitions: Iterable[tuple[Schema | None, Channel]], chunk: PackedChunk, data: bytes
    ) -> None:
        """All messages of a chunk, as it is; ``data`` are its records, ``definitions`` those of its messages."""
        with self._disk_errors():
            for schema, channel in definitions:
                self._define(schema, channel)
            self._mcap.copy_chunk(data, chunk.crc, chunk.compression, chunk.data)

    def close(self, ledger: dict[str, Any]) -> RecordingPart:
        """Write the ledger and the index; return what the side file of a split recording needs of this file."""
        with self._disk_errors():
            self._mcap.flush()
            self._mcap.add_metadata(layout.LEDGER_METADATA, layout.seal_ledger(ledger))
            self._mcap.finish()
            self._file.close()
        found = self._mcap.statistics()
        return RecordingPart(
            self.path,
            found.message_start_time,
            found.message_end_time,
            found.message_count,
            tuple(topic_counts(self._mcap)),
            self._mcap.size,
        )

    def _define(self, schema: Schema | None, channel: Channel) -> None:
        """Register what is new, under the numbers of the other file."""
        if channel.id in self._channels:
            return
        self._channels.add(channel.id)
        if schema and schema.id not in self._schemas:
            self._schemas.add(schema.id)
            self._mcap.register_schema(schema.name, schema.encoding, schema.data, schema.id)
        self._mcap.register_channel(
            channel.topic, channel.message_encoding, schema.id if schema else 0, channel.metadata, channel.id
        )

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RecordingError(f"cannot write {self.path}: {os_error_text(error)}") from error
