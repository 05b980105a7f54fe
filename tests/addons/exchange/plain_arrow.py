"""Export to Parquet and Arrow message by message, for tests of ``arrow_out``, which has to write the same."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from igtl_gateway.addon.reading import Entry, Kind, block_of, recorded_acceptance, recorded_units
from igtl_gateway.addon.streams import TableMaker
from igtl_gateway.addon.untrusted import MessageDecoder
from igtl_gateway.addons.exchange import arrow_out
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream
from igtl_gateway.addons.exchange.arrow_names import Pictures
from igtl_gateway.addons.exchange.folder import FileNames, new_folder
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, ROS_KINDS, Recording, chosen_entries


def export(recording: Recording, out: Path, globs: Sequence[str], form: Any) -> ExportAccount:
    """Write the directory ``out``."""
    account, names = ExportAccount(), FileNames(recording.channels)
    decoder = MessageDecoder(lambda ros_type: recording.definitions.get(ros_type, ""))
    streams: dict[tuple[Kind, str, str, str], _Stream] = {}
    units, accepted, waiting = recorded_units(recording), recorded_acceptance(recording), 0
    pictures = Pictures()
    with new_folder(out, account) as folder, ExitStack() as stack:
        for entry in chosen_entries(recording, (*IGTL_KINDS, *ROS_KINDS), globs, account):
            row = account.row(entry)
            unit = units.of(entry.kind, entry.channel, entry.type, entry.links)
            key = (entry.kind, entry.channel, entry.type, unit)
            stream = streams.get(key)
            if stream is None:
                if len(streams) >= arrow_out._MAX_FILES:
                    row.fail(f"more than {arrow_out._MAX_FILES} streams")
                    continue
                maker = TableMaker(
                    entry.kind, entry.type, entry.channel, recording.definitions, decoder, unit, accepted
                )
                other = any(known[:3] == key[:3] for known in streams)
                columns = arrow_out.columns_of(entry.kind, entry.type, recording, decoder)
                name = f"{names.of(entry)}{f'.{unit}' * other}.{form.suffix}"
                file = arrow_out._File(folder, name, form, columns, pictures, is_output=not entry.kind.is_input)
                stack.callback(file.close)
                stream = streams[key] = _Stream(row, maker, file)
            stream.entries.append(entry)
            waiting += entry.size
            if waiting >= arrow_out._BYTES:
                _flush(streams.values(), pictures)
                waiting = 0
            elif len(stream.entries) >= arrow_out._ROWS:
                waiting -= sum(each.size for each in stream.entries)
                stream.flush()
        _flush(streams.values(), pictures)
    account.files = sum(stream.file.is_open for stream in streams.values())
    files = [stream.file for stream in streams.values()]
    account.notes += [*names.notes(f".{form.suffix}"), *arrow_out.notes_of(files)]
    return account


def _flush(streams: Iterable[_Stream], pictures: Pictures) -> None:
    for each in sorted(streams, key=lambda stream: stream.file.order):
        each.flush()
    pictures.turn()


class _Stream:
    def __init__(self, row: ExportedStream, maker: TableMaker, file: arrow_out._File) -> None:
        self.row, self.maker, self.file = row, maker, file
        self.entries: list[Entry] = []

    def flush(self) -> None:
        if not self.entries:
            return
        table, reasons = self.maker.table(block_of(self.entries))
        for why in reasons:
            self.row.fail(why)
        if table.num_rows:
            self.file.write(table)
        self.row.taken += table.num_rows
        self.entries = []
