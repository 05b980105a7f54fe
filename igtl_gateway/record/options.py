"""How to record: the recorder's options."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.notations import RetentionRule
from igtl_gateway.config.triggers import Trigger
from igtl_gateway.record.selection import Selection
from igtl_gateway.record.sessionfile.layout import CHUNK_BYTES

if TYPE_CHECKING:
    from igtl_gateway.record.sessionfile.compression import Compression
    from igtl_gateway.record.sessionfile.large_outputs import Outputs
    from igtl_gateway.record.sessionfile.writer import Fsync

#: Bounds of the queue: a second of Full HD video at 40 Hz, and ten seconds of small messages at 20 kHz.
QUEUE_BYTES = 256 << 20
QUEUE_ENTRIES = 200_000
#: The largest entry that finds a place in an empty queue: four times the largest body that is received by default.
LARGEST_BYTES = 1 << 30
#: Bound of what is kept in memory for a snapshot.
SNAPSHOT_BYTES = 512 << 20
#: Interval at which the file is flushed: what a kill −9 of bridge and recorder may cost.
FLUSH_S = 0.5
#: In the path of a recording: the time of its start, so that each start has a file of its own.
TIME = "{time}"


def path_at(path: Path, utc_ns: int) -> Path:
    """Return the path of a recording that starts at this time: ``{time}`` in it is replaced."""
    time = datetime.fromtimestamp(utc_ns // NS_PER_S, timezone.utc)
    return Path(str(path).replace(TIME, f"{time:%Y%m%dT%H%M%SZ}"))


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """See the command line.

    Attributes:
        compression: of the chunks; ``auto`` chooses by stream; see ``sessionfile.stream``.
        chunk_bytes: size of a chunk before compression.
        outputs: how large outputs are written: all bytes, the digest, or nothing.
        flush_s: interval between flushes: what SIGKILL of the recorder loses beside what waits in the queue.
        fsync: when written data are forced to the disk.
        split_bytes, split_s: a part ends when it has this size or duration; 0: never.
        snapshot_s: keep the last seconds in memory, and write them on request; 0: write everything immediately.
        snapshot_bytes: bound of what is kept in memory.
        triggers: rules that write them without a request.
        selection: which streams are recorded.
        queue_bytes, queue_entries: bounds of the queue.
        overwrite: replace an existing recording instead of refusing it.
        stop_on_failure: the bridge stops when the recording fails.
        waits: the first file is begun on request.
        named: path with ``{time}``, of the files that are begun on request; None: they are numbered.
        custom: keys and values of the user for the metadata of the recording.
        file_mode: mode of the files; directories may also be entered by those who may read files.
        seal: file of the private key that seals the recording; None: it is not sealed.
        uploaded: the retention keeps recordings that no store has confirmed.
        retention: which recordings in the folder of this one are deleted; None: none.
    """

    compression: Compression = "lz4"
    chunk_bytes: int = CHUNK_BYTES
    outputs: Outputs = "full"
    flush_s: float = FLUSH_S
    fsync: Fsync = "never"
    split_bytes: int = 0
    split_s: float = 0.0
    snapshot_s: float = 0.0
    snapshot_bytes: int = SNAPSHOT_BYTES
    triggers: tuple[Trigger, ...] = ()
    selection: Selection = field(default_factory=Selection)
    queue_bytes: int = QUEUE_BYTES
    queue_entries: int = QUEUE_ENTRIES
    overwrite: bool = False
    stop_on_failure: bool = False
    waits: bool = False
    named: Path | None = None
    custom: tuple[tuple[str, str], ...] = ()
    file_mode: int = 0o600
    seal: Path | None = None
    retention: RetentionRule | None = None
    uploaded: bool = False

    @property
    def has_parts(self) -> bool:
        """Whether the recording is split."""
        return bool(self.split_bytes or self.split_s)
