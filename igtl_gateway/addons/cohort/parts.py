"""Which parts of a folder of tables count: the list in ``cohort.json``, and the names of files."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import files, parse_json
from igtl_gateway.addons.cohort.columns import SCHEMA_VERSION

MANIFEST = "cohort.json"
#: Folder of the parts.
PARTS = "parts"
_NAME = re.compile(r"[0-9]{6,20}")
#: A run joins its parts at its end: these are of one that made 20,000, each with the files of some seconds.
_MOST = 20_000


@dataclass(frozen=True, slots=True)
class Parts:
    """The parts that count.

    Attributes:
        names: of their folders, in order.
        joined: there is one, all of its rows count, and those of each table are ordered by file and task.
    """

    names: list[str] = field(default_factory=list)
    joined: bool = False

    def count_in(self, folder: Path) -> bool:
        """Return whether they still count.  Raises ConfigError, GatewayError."""
        return set(self.names) <= set(parts_of(folder).names)


def parts_of(folder: Path) -> Parts:
    """Return the parts that count.  Raises ConfigError, GatewayError."""
    manifest = folder / MANIFEST
    found = parse_json(files.read_bytes(manifest).decode("utf-8", "replace"), str(manifest))
    version = found.get("schema_version") if isinstance(found, dict) else None
    if version != SCHEMA_VERSION:
        raise ConfigError(
            f"{manifest}: found tables of version {version!r}, expected {SCHEMA_VERSION}; use another folder"
        )
    names = found.get("parts")
    if not isinstance(names, list) or not all(isinstance(each, str) and _NAME.fullmatch(each) for each in names):
        raise ConfigError(f"{manifest}: found parts {names!r}, expected a list of numbers")
    if len(names) > _MOST:
        raise ConfigError(f"{manifest}: found {count_text(len(names), 'part')}, expected at most {_MOST:,}")
    return Parts(names, joined=found.get("joined") is True and len(names) == 1)


def files_of(folder: Path, parts: Iterable[str], table: str) -> list[Path]:
    """Return the Parquet files of a table, in the order of the parts; a part has no file for a table without rows."""
    paths = (folder / PARTS / part / f"{table}.parquet" for part in parts)
    return [path for path in paths if path.is_file()]


def unreadable(path: Path, reason: str) -> GatewayError:
    """What to raise for a file that is not a table of this version."""
    return GatewayError(f"{path}: found no table of this version ({reason}); remove the folder and run again")
