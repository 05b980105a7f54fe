"""What ``info`` reads besides recordings: a folder of rosbag2, and the standard input."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from igtl_gateway.base.addons import part_of
from igtl_gateway.base.errors import ConfigError, RecordingError, UnsupportedRecording
from igtl_gateway.record.sessionfile.index import not_mcap
from igtl_gateway.record.sessionfile.new_file import open_new
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.records import MAGIC
from igtl_gateway.record.sessionfile.side_file import SIDE_FILE

STANDARD_INPUT = Path("-")


@dataclass(frozen=True)
class Recording:
    """A recording to read.

    Attributes:
        place: its file or folder, or a temporary file with the content of another source.
        bag: facts of the bag whose content a temporary session has, instead of those of that session; empty for others.
    """

    place: Path
    bag: Mapping[str, Any] = field(default_factory=dict)


@contextmanager
def recording_of(path: Path) -> Iterator[Recording]:
    """Context manager: the recording at a path, or a temporary one with the content of a bag or the standard input.

    Raises UnsupportedRecording, DamagedRecording; ConfigError without standard input.
    """
    if path != STANDARD_INPUT and not _is_bag(path):
        yield Recording(path)
        return
    bag: dict[str, Any] = {}
    with TemporaryDirectory(prefix="igtl-gateway-") as folder:
        place = Path(folder) / "session.mcap"
        if path == STANDARD_INPUT:
            if sys.stdin is None or sys.stdin.isatty():
                raise ConfigError(
                    "-: found no file at the standard input, expected one: igtl-gateway info - < out.mcap"
                )
            start = sys.stdin.buffer.read(len(MAGIC))
            if start and start != MAGIC:  # what has no end would fill the disk
                raise not_mcap(path, start)
            with open_new(place) as file:
                file.write(start)
                shutil.copyfileobj(sys.stdin.buffer, file)
        else:
            part_of("exchange", "as_session:write_session")(path, place)
            bag = {"foreign": True, "bytes": _size(path), "session": {}, "ledger": None}
        try:
            yield Recording(place, bag)
        except RecordingError as error:  # it names the temporary file
            raise type(error)(str(error).replace(str(place), str(path))) from None


def _is_bag(path: Path) -> bool:
    """Return whether a folder is one of rosbag2, and not one of a split recording, which has the same side file."""
    if not path.is_dir() or not ((path / SIDE_FILE).is_file() or any(path.glob("*.db3"))):
        return False
    try:
        with SessionFile.open(path, incomplete=True):
            return False
    except UnsupportedRecording:
        return True


def _size(bag: Path) -> int:
    return sum(file.stat().st_size for file in bag.iterdir() if file.is_file())
