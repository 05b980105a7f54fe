"""The files of a cohort: what the sources name, each with a mark that changes when the file does."""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.addon import ConfigError
from igtl_gateway.addon.reading import marks_files
from igtl_gateway.addon.writing import is_unfinished
from igtl_gateway.addons.cohort.objects import is_url, list_objects

_WILD = "*?["


@dataclass(frozen=True, slots=True)
class Located:
    """A file of the cohort.

    Attributes:
        name: absolute path, or URL.
        size: bytes.
        mark: changes when the file does: of a local file size, time of its last change and inode, of its marks file
            too; of an object the entity tag, which stands for the content, with the version and the size.
        e_tag: of an object that has one.
    """

    name: str
    size: int
    mark: str
    e_tag: str = ""

    @property
    def shown(self) -> str:
        """The name as it stands in the tables: bytes that are not UTF-8 are escaped."""
        return self.name.encode("utf-8", "backslashreplace").decode()


def locate(sources: Iterable[str]) -> list[Located]:
    """Return the sessions that the sources name, each once, by name.

    Args:
        sources: files; folders, with all ``*.mcap`` in and below them; globs (``**`` for any number of folders); URLs
            of objects, of folders of objects, or with wildcards.

    Raises ConfigError for a source that names nothing, Unavailable for a store that does not answer.
    """
    found: dict[str, Located] = {}
    for source in sources:
        count = 0
        for each in _of_url(source) if is_url(source) else _local(source):
            found[each.name] = each
            count += 1
        if not count:
            raise ConfigError(f"{source}: found no session, expected files, folders or globs with *.mcap")
    return [found[name] for name in sorted(found)]


def _of_url(url: str) -> Iterator[Located]:
    for name, facts in list_objects(url):
        size = int(facts["size"])
        tag = facts.get("e_tag") or f"modified {facts.get('last_modified')}"
        yield Located(name, size, f"{tag} {facts.get('version') or ''} {size}", str(facts.get("e_tag") or ""))


def _local(source: str) -> Iterator[Located]:
    path = Path(source)
    if path.is_dir():
        names = sorted(name for name in path.rglob("*.mcap") if not is_unfinished(name))
    elif path.exists() or not any(char in source for char in _WILD):
        names = [path]
    else:
        names = sorted(map(Path, glob.glob(source, recursive=True)))
    for name in names:
        try:
            size = name.stat().st_size
            changes = "" if name.is_dir() else " ".join(map(_changes, (name, *marks_files(name))))
        except (OSError, ValueError):  # a link to nothing, or no access: the job has the reason
            yield Located(str(name.absolute()), 0, "absent")
            continue
        if changes:
            yield Located(str(name.absolute()), size, changes)


def _changes(path: Path) -> str:
    """Return what changes with a file."""
    facts = path.stat()
    return f"{facts.st_size} {facts.st_mtime_ns} {facts.st_ino}"


def digest(*parts: str) -> str:
    """Return 32 characters that stand for these strings."""
    joined = "\0".join(parts).encode("utf-8", "surrogatepass")
    return hashlib.sha256(joined).hexdigest()[:32]
