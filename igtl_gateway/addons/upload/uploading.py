"""Uploads closed recordings of a folder: file by file, in parts, so that an interrupted upload continues.

A file counts as uploaded when the store states its size, our SHA-256 of it, and a tag or checksum that follows from its
bytes.  An object is only ever created, never replaced.  The local file is never changed or deleted.
"""

from __future__ import annotations

import base64
import hashlib
import math
import os
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from igtl_gateway.addon import NS_PER_S, Clock
from igtl_gateway.addon.reading import (
    FileState,
    Level,
    Note,
    RecordingFolder,
    StoredRecording,
    UploadState,
    UploadStates,
    file_identity,
    is_of_recording,
    open_unlinked,
    recording_name,
)
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.writing import os_error_text
from igtl_gateway.addons.upload.place import UploadPlace
from igtl_gateway.addons.upload.s3 import RateLimit, S3Store, StoredObject, StoreError

#: Codes of its notes.
CONFIRMED, WAITS, REACHED, DIFFERS = "upload_confirmed", "upload_waits", "upload_reached", "upload_differs"

#: Size of a part; S3 has 5 MiB at least, except of the last one.
PART_BYTES = 8 << 20
#: S3 has 10,000 parts at most.
_MOST_PARTS = 9_000
#: Waits between attempts, seconds: doubled from the first to the last.
_FIRST_WAIT_S, _LAST_WAIT_S = 1.0, 60.0
#: Bytes that are read at once.
_BLOCK = 1 << 20


class ContentDiffers(Exception):
    """The file is not as it was when it was closed, or the store has something else under its key."""


class UploadStopped(Exception):
    """The uploader is to end now."""


@dataclass(slots=True)
class UploadCounts:
    """What an uploader has done: files and bytes that wait, bytes sent, files confirmed, UTC ns of the last one."""

    waiting: int = 0
    waiting_bytes: int = 0
    sent_bytes: int = 0
    confirmed: int = 0
    last_confirmed_ns: int = 0
    problem: str = ""


class Uploader:
    """Uploads what waits in a folder.

    Args:
        folder: the folder.
        base: the recording of which all files are uploaded; None: all recordings of the folder.
        place: where to.
        rate: bytes per second; 0: no limit.
        clock: stamps confirmations.
        on_note: called with notes, when a state begins or changes.
        stops: whether to end now.

    Raises ConfigError for a wrong endpoint.
    """

    def __init__(
        self,
        folder: Path,
        base: str | None,
        place: UploadPlace,
        rate: float,
        clock: Clock,
        on_note: Callable[[Note], None],
        stops: Callable[[], bool] = lambda: False,
    ) -> None:
        self.counts = UploadCounts()
        self._base = base
        self._place = place
        self._clock = clock
        self._on_note = on_note
        self._stops = stops
        self._folder = RecordingFolder(folder)
        self._stored = UploadStates(folder)
        self._states: dict[str, UploadState] = {}  # those with our lock
        self._store = S3Store(place, RateLimit(rate, clock), clock, self._on_sent)
        self._noted: dict[str, str] = {}  # file → text of its last note
        self._wait_s = 0.0
        self._next_ns = 0  # on the monotonic clock

    def begin(self) -> None:
        """State that the recording is to be uploaded, before it has a file.  Raises OSError."""
        if self._base is not None and (state := self._state(self._base)):
            state.begin(str(self._place))

    def close(self) -> None:
        """Close connection and states."""
        self._store.close()
        for state in self._states.values():
            state.close()

    def step(self) -> bool:
        """Upload what waits, up to the first problem with the store; return whether nothing waits any more."""
        self._find()
        if self._clock.monotonic_ns() < self._next_ns:
            return not self.counts.waiting
        for recording, state in list(self._waiting()):
            if self._stops():
                return False
            if not self._upload(recording, state):
                return False
            self._find()
        return not self.counts.waiting

    def waiting(self) -> list[StoredRecording]:
        """Return the files that are not confirmed."""
        return [recording for recording, _ in self._waiting()]

    # -- what waits ----------------------------------------------------------------------------------------------

    def _find(self) -> None:
        waiting = self.waiting()
        self.counts.waiting, self.counts.waiting_bytes = len(waiting), sum(each.size for each in waiting)

    def _waiting(self) -> Iterator[tuple[StoredRecording, UploadState]]:
        try:
            found = self._folder.search().closed
        except OSError as error:
            self._tell("", Level.ERROR, WAITS, f"upload: {os_error_text(error)}")
            return
        bases = {state.base for state in self._stored.now() if state.place == str(self._place)}
        if self._base is not None:
            bases.add(self._base)
        for recording in sorted(found, key=lambda each: (each.modified_ns, each.part, each.name)):
            base = next((each for each in bases if is_of_recording(recording.name, each)), None)
            if base is None and self._base is None:
                base = recording_name(recording.name)
            if base is None or (state := self._state(base)) is None:
                continue
            known = state.files.get(recording.name, FileState())
            if not (known.confirmed and known.is_of(recording)):
                yield recording, state

    def _state(self, base: str) -> UploadState | None:
        """Return the state of a recording, with its lock; None if another process has it, or another place."""
        state = self._states.get(base) or UploadState(self._folder.path, base)
        try:
            if not state.lock():
                if self._base in (None, base):
                    self._tell(base, Level.WARN, WAITS, f"upload of {base} waits: another process uploads it")
                return None
            if not state.place:
                state.begin(str(self._place))
        except OSError as error:
            self._tell(base, Level.ERROR, WAITS, f"upload of {base} waits: {state.path}: {os_error_text(error)}")
            return None
        self._states[base] = state
        if state.place != str(self._place):
            text = f"upload of {base} waits: its files go to {state.place}, not to {self._place}"
            self._tell(base, Level.WARN, WAITS, text)
            return None
        return state

    # -- one file ------------------------------------------------------------------------------------------------

    def _upload(self, recording: StoredRecording, state: UploadState) -> bool:
        """Upload a file; False: the store has a problem, and the others wait as well."""
        name = recording.name
        try:
            self._send(recording, state)
        except ContentDiffers as error:
            self._tell(name, Level.ERROR, DIFFERS, f"upload of {name}: {error}")
            return True
        except UploadStopped:
            return False
        except (OSError, StoreError) as error:
            why = str(error) if isinstance(error, StoreError) else os_error_text(error)
            self._wait_s = min(_LAST_WAIT_S, max(_FIRST_WAIT_S, 2 * self._wait_s))
            self._next_ns = self._clock.monotonic_ns() + int(self._wait_s * NS_PER_S)
            self.counts.problem = why
            self._tell("", Level.WARN, WAITS, f"upload waits: {why}; the files stay here")
            return False
        self._wait_s, self.counts.problem = 0.0, ""
        if self._noted.pop("", ""):
            self._on_note(Note(Level.INFO, REACHED, "upload: the store answers again"))
        self._noted.pop(name, None)
        self.counts.confirmed += 1
        self.counts.last_confirmed_ns = self._clock.utc_ns()
        data = {"file": name, "bytes": recording.size, "sha256": state.files[name].sha256}
        self._on_note(
            Note(
                Level.INFO, CONFIRMED, f"upload: the store has {name} ({count_text(recording.size, 'byte')})", data=data
            )
        )
        return True

    def _send(self, recording: StoredRecording, state: UploadState) -> None:
        """Upload a file and confirm it.  Raises ContentDiffers, UploadStopped, StoreError, OSError."""
        if not recording.name.isascii() and recording.name != recording.name.encode(errors="replace").decode():
            raise ContentDiffers(
                "found a name that is invalid UTF-8, expected one that an object can have; rename the file"
            )
        known = state.files.get(recording.name, FileState())
        if known.sha256 and not known.is_of(recording):
            raise ContentDiffers(
                f"found {count_text(recording.size, 'byte')} that changed after it was closed, expected no change"
            )
        with closing(open_unlinked(recording.path)) as stream:
            if file_identity(os.fstat(stream.fileno())) != recording.identity:
                raise ContentDiffers("found another file than a moment ago")
            part_bytes = max(PART_BYTES, math.ceil(recording.size / _MOST_PARTS / PART_BYTES) * PART_BYTES)
            if not known.sha256 or known.part_bytes != part_bytes:
                digests = self._digests(stream, part_bytes)
                known = state.set(
                    recording.name,
                    size=recording.size,
                    modified_ns=recording.modified_ns,
                    sha256=digests.sha256,
                    etag=digests.etag,
                    checksum=digests.checksum,
                    part_bytes=part_bytes,
                    upload="",
                )
            key = self._store.key(recording.name)
            found = self._store.find(key)
            if found is None:
                try:
                    if recording.size <= known.part_bytes:
                        self._put(stream, key, known)
                    else:
                        self._put_parts(stream, key, known, recording, state)
                except StoreError as error:
                    if not error.exists:
                        raise
                found = self._store.find(key)
        self._check(found, known)
        state.confirm(recording.name, self._clock.utc_ns())

    def _check(self, found: StoredObject | None, known: FileState) -> None:
        """Raise StoreError or ContentDiffers if the store does not have the file."""
        if found is None:
            raise StoreError("the store accepted the file, and does not have it")
        if (found.size, found.sha256) != (known.size, known.sha256):
            raise ContentDiffers(
                f"the store has another object with this key: found {count_text(found.size, 'byte')} with SHA-256 "
                f"{found.sha256[:16] or 'unknown'}, expected {known.size:,} with {known.sha256[:16]}"
            )
        if known.etag != found.etag and known.checksum != found.checksum:
            raise ContentDiffers(
                f"the store has other bytes: found the tag {found.etag[:40]!r}, expected {known.etag!r}"
            )

    def _put(self, stream: IO[bytes], key: str, known: FileState) -> None:
        stream.seek(0)
        data = stream.read(known.part_bytes + 1)
        if hashlib.sha256(data).hexdigest() != known.sha256:
            raise ContentDiffers("found other bytes than when it was closed (SHA-256)")
        self._store.put(key, data, known.sha256)

    def _put_parts(
        self, stream: IO[bytes], key: str, known: FileState, recording: StoredRecording, state: UploadState
    ) -> None:
        """Send the parts that the store does not have, and have it make the object."""
        upload, there = known.upload, {}
        if upload:
            try:
                there = self._store.parts(key, upload)
            except StoreError as error:
                if error.status != 404:
                    raise
                upload = ""  # the store has forgotten it
        if not upload:
            upload = self._store.begin(key, known.sha256)
            state.set(recording.name, upload=upload)
        whole, parts, number = hashlib.sha256(), [], 0
        stream.seek(0)
        while data := stream.read(known.part_bytes):
            if self._stops():
                raise UploadStopped
            number += 1
            whole.update(data)
            tag, has = hashlib.md5(data, usedforsecurity=False).hexdigest(), there.get(number)
            if has is None or has[1] != len(data) or (has[0] != tag and _is_md5(has[0])):
                tag = self._store.put_part(key, upload, number, data) or tag
            else:
                tag = has[0]
            parts.append((tag, hashlib.sha256(data).digest()))
        if whole.hexdigest() != known.sha256:
            with suppress(StoreError):
                self._store.abort(key, upload)
            raise ContentDiffers("found other bytes than when it was closed (SHA-256)")
        try:
            self._store.complete(key, upload, parts)
        except StoreError as error:
            if error.status == 404 or error.exists:  # it was made before, or another one was: that is looked at next
                with suppress(StoreError):
                    self._store.abort(key, upload)
                state.set(recording.name, upload="")
                if error.status == 404:
                    return
            raise

    def _digests(self, stream: IO[bytes], part_bytes: int) -> _Digests:
        whole, tags, sums, count = hashlib.sha256(), [], [], 0
        while True:
            md5, sha, left = hashlib.md5(usedforsecurity=False), hashlib.sha256(), part_bytes
            while left and (data := stream.read(min(_BLOCK, left))):
                if self._stops():
                    raise UploadStopped
                for each in (whole, md5, sha):
                    each.update(data)
                left -= len(data)
            if left == part_bytes and count:
                break
            count += 1
            tags.append(md5)
            sums.append(sha)
            if left:
                break
        etag, checksum = tags[0].hexdigest(), sums[0].digest()
        suffix = ""
        if count > 1:
            suffix = f"-{count}"
            etag = hashlib.md5(b"".join(each.digest() for each in tags), usedforsecurity=False).hexdigest() + suffix
            checksum = hashlib.sha256(b"".join(each.digest() for each in sums)).digest()
        return _Digests(whole.hexdigest(), etag, base64.b64encode(checksum).decode() + suffix)

    def _on_sent(self, count: int) -> None:
        self.counts.sent_bytes += count

    def _tell(self, about: str, level: Level, code: str, text: str) -> None:
        """Report a state when it begins or changes."""
        if self._noted.get(about) != text:
            self._noted[about] = text
            self._on_note(Note(level, code, text))


@dataclass(frozen=True, slots=True)
class _Digests:
    """Of a file: SHA-256, and what a store states about its parts."""

    sha256: str
    etag: str
    checksum: str


def _is_md5(tag: str) -> bool:
    return len(tag) == 32 and all(sign in "0123456789abcdef" for sign in tag)
