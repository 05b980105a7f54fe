"""The side file of a split recording after parts of it were deleted: it names the parts that are left."""

from __future__ import annotations

import os
from contextlib import closing, suppress
from pathlib import Path

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.record.retention.stored import open_unlinked
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.contents import Index
from igtl_gateway.record.sessionfile.index import stated_index
from igtl_gateway.record.sessionfile.records import Malformed
from igtl_gateway.record.sessionfile.side_file import SIDE_FILE, RecordingPart, TopicCount, files_of, write_side_file

_MOST_SUMMARY = 256 << 20
_HEADING = b"rosbag2_bagfile_information:"


def update_side_file(folder: Path) -> None:
    """Write the side file of a folder again, or remove it and the folder after the last part.

    A folder with a part that is open is left to its recorder.  What cannot be written stays as it is.
    """
    side = folder / SIDE_FILE
    with suppress(OSError, GatewayError, Malformed, ValueError):
        paths = [path for path in files_of(folder) if path != side]
        if not paths:
            if _is_ours(side):
                side.unlink()
            folder.rmdir()  # refused if anything else is in it
            return
        parts = [closed_part(path) for path in paths]
        closed = [part for part in parts if part]
        if len(closed) == len(parts) and _is_ours(side):
            closed.sort(key=lambda part: (len(part.path.name), part.path.name))
            write_side_file(folder, closed)


def _is_ours(side: Path) -> bool:
    """Return whether there is a side file that a recorder wrote."""
    try:
        with closing(open_unlinked(side)) as stream:
            return stream.read(len(_HEADING)) == _HEADING
    except OSError:
        return False


def closed_part(path: Path) -> RecordingPart | None:
    """Return the row of a part; None if it is not closed.  Raises GatewayError, OSError, ValueError."""
    with closing(open_unlinked(path)) as stream:
        size = os.fstat(stream.fileno()).st_size
        index = stated_index(path, stream, size, _MOST_SUMMARY)
    if index is None:
        return None
    return RecordingPart(path, index.start_ns, index.end_ns, sum(index.counts.values()), _topics(index), size)


def _topics(index: Index) -> tuple[TopicCount, ...]:
    found: dict[tuple[str, str], TopicCount] = {}
    for channel in index.channels.values():
        schema = index.schemas.get(channel.schema_id)
        key = channel.topic, schema.name if schema else ""
        qos = layout.parse_qos_yaml(channel.metadata.get(layout.QOS_KEY, ""))
        type_hash = channel.metadata.get(layout.TYPE_HASH_KEY, "")
        before = found[key].count if key in found else 0
        count = before + index.counts.get(channel.id, 0)
        found[key] = TopicCount(*key, layout.qos_yaml(qos) if qos else "", type_hash, count)
    return tuple(found.values())
