"""SHA-256 of each file of a data set, in the format of ``sha256sum``: a changed byte is found without the recording."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from igtl_gateway.addon import DamagedRecording, GatewayError, LimitExceeded
from igtl_gateway.addon.terminal import by_count
from igtl_gateway.addon.untrusted import Deadline, check_limit, open_file, printable, read_bytes
from igtl_gateway.addon.writing import write_text

CHECKSUMS = "SHA256SUMS"
_LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")
#: Folders whose files are all listed; a user may add others.
_FOLDERS = ("data", "meta", "videos")
#: Bytes that are read at once.
_BYTES = 1 << 20
#: Findings that are listed.
_MOST = 5


def write_checksums(root: Path, known: Mapping[str, str] | None = None) -> None:
    """Write ``meta/SHA256SUMS``, for ``sha256sum -c meta/SHA256SUMS`` in the directory of the set.

    ``known`` has the sums of files that are not read again.
    """
    named = ((path, path.relative_to(root).as_posix()) for path in data_files(root))
    lines = (f"{(known or {}).get(name) or _digest(path)}  {name}\n" for path, name in named)
    (root / "meta" / CHECKSUMS).unlink(missing_ok=True)
    write_text(root / "meta" / CHECKSUMS, "".join(lines))


def read_checksums(root: Path) -> dict[str, str]:
    """Return file of a whole data set → SHA-256.  Raises DamagedRecording if a file is missing.

    So it does for one of data that is not listed.
    """
    place = root / "meta" / CHECKSUMS
    lines = read_bytes(place).decode("utf-8", "replace").splitlines()
    check_limit("count", len(lines), str(place))
    rows = [_LINE.fullmatch(line) for line in lines]
    found = {row[2]: row[1] for row in rows if row}
    names = {path.relative_to(root).as_posix() for path in data_files(root)}
    more = {name for name in names - found.keys() if not name.startswith("meta/")}
    for what, those in (("found no", found.keys() - names), ("found", more)):
        if those:
            has = "has" if what == "found no" else "lacks"
            raise DamagedRecording(
                f"{root}: {what} {printable(min(those))}, which {place.name} {has}, expected a whole set: see --check"
            )
    return found


def check_checksums(root: Path, deadline: Deadline) -> Iterator[str]:
    """Yield the files that are missing, changed or not listed.  Raises LimitExceeded after the deadline."""
    place = f"meta/{CHECKSUMS}"
    try:
        text = read_bytes(root / place).decode("utf-8", "replace")
        lines = text.splitlines()
        check_limit("count", len(lines), place)
    except GatewayError as error:
        yield str(error)
        return
    listed, wrong = set(), list[str]()
    for number, line in enumerate(lines, 1):
        found = _LINE.fullmatch(line)
        path = PurePosixPath(found[2]) if found else None
        if found is None or path is None or path.is_absolute() or ".." in path.parts:
            wrong.append(f"{place}:{number}: found {printable(line[:80])!r}, expected a SHA-256 and a file of the set")
            continue
        listed.add(path.as_posix())
        if not (root / path).exists():
            wrong.append(f"{printable(str(path))}: found no such file, expected that of {place}")
            continue
        try:
            if _digest(root / path, deadline) != found[1]:
                wrong.append(f"{path}: found another SHA-256, expected {found[1][:12]}… of {place}: it was changed")
        except LimitExceeded:
            raise
        except GatewayError as error:
            wrong.append(str(error))
    for file in data_files(root):
        name = file.relative_to(root).as_posix()
        if name not in listed:
            wrong.append(f"{printable(name)}: found a file that {place} does not list, expected none")
    yield from wrong[:_MOST]
    if len(wrong) > _MOST:
        more = by_count(len(wrong) - _MOST, "file that is", "files that are")
        yield f"{place}: {len(wrong) - _MOST:,} more {more} missing, changed or not listed"


def data_files(root: Path) -> list[Path]:
    """The files of a set, except the list itself, in order."""
    found = (path for folder in _FOLDERS for path in (root / folder).rglob("*"))
    return sorted(path for path in found if path.is_file() and path != root / "meta" / CHECKSUMS)


def _digest(path: Path, deadline: Deadline | None = None) -> str:
    digest = hashlib.sha256()
    with open_file(path) as stream:
        while data := stream.read(_BYTES):
            if deadline is not None:
                deadline.check(str(path))
            digest.update(data)
    return digest.hexdigest()
