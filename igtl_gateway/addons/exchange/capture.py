"""Raw OpenIGTLink bytes of one direction (``.igtl``): ``NAME.c2s.igtl`` from client to server, ``NAME.s2c.igtl`` back.

A message has the time of its header's stamp if that is set and later than the previous message; otherwise it is placed
1 ms after the previous message.  Messages are imported unchanged, damaged ones too.  The account is in bytes: an
incomplete message at the end of the file is missing in it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from igtl_gateway.addon import NS_PER_MS, DamagedRecording, MessageTooLarge, UnsupportedRecording
from igtl_gateway.addon.igtl import DEVICE_NAME_AT, HEADER_SIZE, HEADER_VERSIONS, Framer, Header
from igtl_gateway.addon.reading import Buffer
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files
from igtl_gateway.addons.exchange.sequence import DEFAULT_EPOCH_NS
from igtl_gateway.addons.exchange.source import (
    BYTES,
    ImportedItem,
    ImportedStream,
    NonRosSource,
    library_errors_as_damage,
    link_down_item,
    link_up_item,
    peer_item,
)

#: Number of streams with a row of their own.
MAX_STREAMS = 10_000
_LINK = 1
_READ = 1 << 16
_TYPE_NAME = re.compile("[!-~]+")


class Capture(NonRosSource):
    """An open capture.  Raises UnsupportedRecording for bytes that are not OpenIGTLink."""

    def __init__(self, path: Path, epoch_ns: int | None = None) -> None:
        super().__init__(f"OpenIGTLink bytes {path.name}", {"imported_format": "igtl"})
        self._path = path
        self._epoch_ns = DEFAULT_EPOCH_NS if epoch_ns is None else epoch_ns
        with library_errors_as_damage(path):
            self._stream = files.open_file(path)
            start = self._stream.read(HEADER_SIZE)
            self._stream.seek(0)
        if not looks_like_igtl(start):
            self._stream.close()
            found = start[:DEVICE_NAME_AT]
            raise UnsupportedRecording(f"{path}: found {found!r}, expected the header of an OpenIGTLink message")
        self._row = ImportedStream("(all)", files.size_of(path), unit=BYTES)
        self.rows = [self._row]

    def items(self) -> Iterator[ImportedItem]:
        role = "client" if ".s2c" in self._path.name else "server"
        peer = {"peer": f"file {self._path.name}", "local": "import", "role": role}
        time_ns = self._epoch_ns
        first = True
        streams: dict[str, ImportedStream] = {}
        for message in self._messages():
            item = peer_item(time_ns, _LINK, message)
            if item.source_ns and (first or item.source_ns > time_ns):
                time_ns = item.source_ns
            elif not first:
                time_ns += NS_PER_MS
            if first:
                yield link_up_item(time_ns, _LINK, peer)
                first = False
            self._row.taken += len(message)
            count_message(streams, self.rows, item)
            yield ImportedItem(time_ns, item.kind, message, item.channel, item.type, item.links, item.source_ns)
        if not first:
            yield link_down_item(time_ns, _LINK, peer, "the end of the file")

    def _messages(self) -> Iterator[Buffer]:
        framer, deadline = Framer(), files.deadline_of(self._path)
        try:
            while data := self._stream.read(_READ):
                deadline.check(str(self._path))
                yield from framer.feed(data)
            yield from framer.received(0)  # raises if the last bytes begin a message that is too large
        except MessageTooLarge as error:
            raise DamagedRecording(f"{self._path}: after {counted(self._row.taken, 'byte')}: {error}") from None
        if framer.pending:
            self._row.why = f"ends inside a message, after {counted(framer.pending, 'byte')} of it"

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def looks_like_igtl(start: bytes) -> bool:
    """Return whether the bytes can begin an OpenIGTLink message: they have a known version and a type name."""
    if len(start) < HEADER_SIZE:
        return False
    header = Header.unpack(start)
    return header.version in HEADER_VERSIONS and _TYPE_NAME.fullmatch(header.type) is not None


def count_message(streams: dict[str, ImportedStream], rows: list[ImportedStream], item: ImportedItem) -> None:
    """Count a message in the row of its stream; the first one creates the row.  The file declares no numbers."""
    row = streams.get(item.channel)
    if row is None and len(streams) >= MAX_STREAMS:
        row = streams.get("")
        if row is None:
            row = streams[""] = ImportedStream("(further streams)", 0, why=f"more than {MAX_STREAMS} streams")
            rows.append(row)
    if row is None:
        row = streams[item.channel] = ImportedStream(item.channel.partition("/")[2], 0, item.type)
        rows.append(row)
    row.declared += 1
    row.taken += 1
