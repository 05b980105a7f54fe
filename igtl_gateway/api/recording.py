"""A recording as an object: its streams, notes, ledger, configuration and frames."""

from __future__ import annotations

import io
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from igtl_gateway.api.display import html_table
from igtl_gateway.api.keywords import texts
from igtl_gateway.api.moments import Moment
from igtl_gateway.api.source import Source
from igtl_gateway.api.stream import STREAM_HEAD, Stream, narrowed
from igtl_gateway.api.transforms import TransformTree
from igtl_gateway.base.errors import BeingRecorded, ConfigError, DamagedRecording, UnsupportedRecording
from igtl_gateway.base.near import did_you_mean, near_names, one_of
from igtl_gateway.base.quantities import by_count, count_text, counted
from igtl_gateway.base.untrusted import files
from igtl_gateway.base.untrusted import limits as file_limits
from igtl_gateway.base.untrusted.limits import FileLimits
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import MESSAGES, Kind
from igtl_gateway.gateway.log.marks import Mark
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.added_marks import marks_files
from igtl_gateway.record.sessionfile.new_file import make_folder, write_bytes
from igtl_gateway.record.sessionfile.only import only_of_kinds
from igtl_gateway.record.sessionfile.ranges import named
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.remote import RemoteFile, is_url
from igtl_gateway.record.sessionfile.side_file import part_files
from igtl_gateway.replay.state_before import with_state, without_state

if TYPE_CHECKING:
    import pandas
    import pyarrow

_NOTES = frozenset({Kind.NOTE, Kind.EDGE_NOTE, Kind.LINK})
_ALWAYS = (0, (1 << 63) - 1)


@dataclass(frozen=True, slots=True)
class RecordedNote:
    """A note of the session.

    Attributes:
        number: entry number.
        time: gateway time, UTC ns.
        kind: ``"note"`` of the gateway, ``"edge_note"`` of an edge, ``"link"`` for a peer that connects or disconnects.
        level: ``"INFO"``, ``"WARN"`` or ``"ERROR"``.
        code: stable name for programs, such as ``"bad_crc"``.
        text: one sentence for people.
        stream: the stream concerned, or ``""``.
        links: numbers of the links concerned.
        data: further facts.
    """

    number: int
    time: int
    kind: str
    level: str
    code: str
    text: str
    stream: str
    links: tuple[int, ...]
    data: dict[str, Any]


class Recording(Mapping[str, Stream]):
    """An open recording; a context manager.  ``open`` returns it.

    It is a mapping of its streams: ``recording["TRANSFORM/ToolToBase"]``, ``recording["/star/tool"]``.  A stream that
    exists in both directions has the keys ``"in:NAME"`` and ``"out:NAME"``; these forms are valid for all streams.

    Attributes:
        path: the file, the folder of parts, or the URL.
        warnings: facts about the file: what is missing, which channels cannot be read.
    """

    def __init__(self, source: Source, path: str, warnings: tuple[str, ...], resources: ExitStack) -> None:
        self.path, self.warnings = path, warnings
        self._source, self._resources = source, resources
        self._window = _ALWAYS

    def __enter__(self) -> Recording:
        self._source.check_open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file.  Arrays that were read stay valid; everything else raises ClosedRecording."""
        self._source.state.closed = True
        self._resources.close()

    def forget_chunks(self) -> None:
        """Free the unpacked chunks that are kept, up to 64 MiB; what is used again is read again."""
        self._source.file.forget_chunks()

    def __repr__(self) -> str:
        if self._source.state.closed:
            return f"<Recording {self.path!r}: closed>"
        part = "" if self.is_whole else f" from {self._seconds(self.start_time)} s to {self._seconds(self.end_time)} s"
        return (
            f"<Recording {self.path!r}{part}: {count_text(self.entry_count, 'entry', 'entries')}, "
            f"{counted(len(self.streams), 'stream')}>"
        )

    def _repr_html_(self) -> str:
        if self._source.state.closed:
            return html_table(repr(self), (), ())
        return html_table(repr(self), STREAM_HEAD, (stream.html_row() for stream in self.streams.values()))

    def _seconds(self, time_ns: int) -> str:
        return f"{(time_ns - self._source.start_ns) / 1e9:.3f}"

    @property
    def is_whole(self) -> bool:
        """Whether it is the whole recording, not a part that ``between`` returned."""
        return self._window == _ALWAYS

    @property
    def start_time(self) -> int:
        """Gateway time of the first entry, of a part that of its start; UTC ns, 0 in an empty recording."""
        return min(max(self._source.start_ns, self._window[0]), self._source.end_ns)

    @property
    def end_time(self) -> int:
        """Gateway time of the last entry, of a part that of its end; UTC ns, 0 in an empty recording."""
        return max(min(self._source.end_ns, self._window[1]), self.start_time)

    @cached_property
    def entry_count(self) -> int:
        """Number of entries: messages, notes and links; those of a part are counted when they are asked for."""
        if self.is_whole:
            return self._source.file.entry_count
        return sum(stream.count for stream in self.streams.values()) + len(self.notes)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last entry, of a part from its start to its end."""
        return (self.end_time - self.start_time) / 1e9

    @cached_property
    def streams(self) -> Mapping[str, Stream]:
        """All streams by key, in the order of the file; see ``Recording`` for the keys."""
        channels = [channel for channel in self._source.file.channels if channel.kind in MESSAGES and channel.count]
        names = Counter(channel.stream or channel.topic for channel in channels)
        streams: dict[str, Stream] = {}
        for channel in channels:
            name = channel.stream or channel.topic
            key = name if names[name] == 1 else f"{'in' if channel.kind.is_input else 'out'}:{name}"
            if key in streams:  # one topic with two types
                key = f"{key} ({channel.entry_type})"
            streams[key] = Stream(self._source, channel, key, self._window)
        return streams

    def __getitem__(self, key: str) -> Stream:
        if not isinstance(key, str):
            raise TypeError(f"found {key!r}, expected the name of a stream, such as 'TRANSFORM/Probe'")
        streams = self.streams
        if key in streams:
            return streams[key]
        side, colon, name = key.partition(":")
        if colon and side in ("in", "out"):
            for stream in streams.values():
                if stream.name == name and stream.direction.endswith(f"_{side}"):
                    return stream
        both = [each for each in streams if streams[each].name == key]
        if both:
            raise KeyError(f"{self.path}: found stream {key!r} {len(both)} times, expected one of {both}")
        name, at, link = key.rpartition("@")
        if at and (number := whole_number(link)) is not None:
            return self[name].of_link(number)
        near = did_you_mean(near_names(key, streams, 0.5))
        raise KeyError(f"{self.path}: found no stream {key!r}; {near and f'{near} '}recording.streams has the names")

    def __iter__(self) -> Iterator[str]:
        return iter(self.streams)

    def __len__(self) -> int:
        return len(self.streams)

    def between(self, start: Moment | None = None, end: Moment | None = None) -> Recording:
        """Return the part from ``start`` on and before ``end``, as a view of the same open file.

        Args:
            start: seconds from the start of the recording (negative: from its end), UTC ns, a datetime, or text.
            end: likewise; None: to the end.

        Raises:
            ConfigError: a moment cannot be read, or the end is before the start.

        Examples:
            >>> with igtl_gateway.open("session.mcap") as recording:
            ...     poses = recording.between(10.0, 20.0)["TRANSFORM/ToolToBase"].poses()
        """
        part = Recording(self._source, self.path, self.warnings, self._resources)
        part._window = narrowed(self._source, self._window, start, end)
        return part

    @cached_property
    def notes(self) -> tuple[RecordedNote, ...]:
        """The notes of the session, in order: problems, drops, links."""
        first, last = self._window
        found = []
        for entry in self._source.limited(lambda: only_of_kinds(self._source.file, _NOTES)):
            if first <= entry.stamp_ns < last:
                note = Note.of(entry.data())
                found.append(
                    RecordedNote(
                        entry.seq,
                        entry.stamp_ns,
                        entry.kind.value,
                        note.level.name,
                        note.code,
                        note.text,
                        note.stream,
                        entry.links,
                        note.data,
                    )
                )
        return tuple(found)

    @cached_property
    def marks(self) -> tuple[Mark, ...]:
        """The marks of the recording, in the order of their times; of a part those that it has a share of."""
        first, last = self._window
        return tuple(mark for mark in self._source.marks() if mark.time_ns < last and first <= mark.last_ns)

    @property
    def ledger(self) -> Mapping[str, Any] | None:
        """The fate of every message, as docs/reference/session-log.md describes it; None if the recording has none."""
        return self._source.file.ledger

    @property
    def config(self) -> Config | None:
        """The recorded configuration; None for files of other programs."""
        return self._source.config

    @property
    def session(self) -> Mapping[str, str]:
        """The session metadata: versions, host, scenario; empty for files of other programs."""
        return self._source.file.session

    def to_arrow(self, streams: str | Iterable[str] | None = None) -> dict[str, pyarrow.Table]:
        """Return streams as Arrow tables by key; see ``Stream.to_arrow``.

        Args:
            streams: keys, or one key; default: all.

        Raises:
            ConfigError: ``streams`` are no strings.
            Unavailable: pyarrow is not installed; the extra ``arrow`` installs it.
        """
        return {key: self[key].to_arrow() for key in self._keys(streams)}

    def to_pandas(self, streams: str | Iterable[str] | None = None) -> dict[str, pandas.DataFrame]:
        """Return streams as data frames by key; see ``Stream.to_pandas``.

        Args:
            streams: keys, or one key; default: all.

        Raises:
            ConfigError: ``streams`` are no strings.
            Unavailable: pandas is not installed; the extra ``pandas`` installs it.
        """
        return {key: self[key].to_pandas() for key in self._keys(streams)}

    def _keys(self, streams: str | Iterable[str] | None) -> Iterable[str]:
        return self.streams if streams is None else texts("streams", streams)

    @cached_property
    def tf(self) -> TransformTree:
        """The frames of the recording; see ``TransformTree``."""
        return TransformTree.of(self._source, self.streams.values())


def open(path: str | Path, *, limits: FileLimits | Mapping[str, int] | None = None) -> Recording:
    """Open a recording.

    Only the summary of the file is read, and later what is used: an MCAP file has an index.

    Args:
        path: an MCAP file, a folder with the parts of a split recording, or an ``http://`` or ``https://`` URL, which
            is read by ranges.  MCAP files of other programs, such as rosbag2, have their ROS topics only.
        limits: bounds for untrusted files, such as ``{"memory": 1 << 30}``, with the names of ``--limit``.

    Returns:
        The recording.  Close it, or use it in a ``with`` statement.  A file that was cut off by a crash is read as far
        as it is whole, and ``warnings`` states what is missing.

    Raises:
        NoSuchRecording: there is no such file; it is a FileNotFoundError, too.
        UnsupportedRecording: it is not MCAP.
        DamagedRecording: the file is damaged; ``igtl-gateway recover`` repairs it.
        LimitExceeded: the file needs more than the limits allow.
        ConfigError: a limit is unknown.

    Examples:
        >>> import igtl_gateway
        >>> with igtl_gateway.open("fixtures/star.mcap") as recording:
        ...     poses = recording["TRANSFORM/ToolToBase"].poses()
        >>> poses.matrices.shape, poses.unit
        ((1200, 4, 4), 'mm')
    """
    bounds = _limits(limits)
    resources = ExitStack()
    warnings: list[str] = []
    try:
        with file_limits.limits_in_force(bounds):
            file = _open_file(path, resources, warnings)
    except BaseException:
        resources.close()
        raise
    whole = with_state(file)
    if count := _messages(whole) - _messages(file):
        warnings.append(
            f"{path}: begins midway; its first {count_text(count, 'message')} {by_count(count, 'was', 'were')} "
            "latched before"
        )
    file = whole
    if file.merge:
        warnings += [f"{path}: reported by {each}" for each in file.merge.reported]
    warnings += [f"{each.topic} ({count_text(each.count, 'message')}) is not read: {each.why}" for each in file.skipped]
    return Recording(Source(file, bounds, file.start_ns, file.end_ns), str(path), tuple(warnings), resources)


def of_session(file: SessionFile) -> Recording:
    """Return the recording of an open session file, which the caller closes."""
    file = with_state(file)
    source = Source(file, file_limits.current_limits(), file.start_ns, file.end_ns)
    return Recording(source, str(file.path), (), ExitStack())


@contextmanager
def session_of(recording: Recording | str | PathLike[str]) -> Iterator[SessionFile]:
    """Context manager: the session file of an open recording, or of a path, which is closed at the end.

    Raises ClosedRecording, ConfigError for a part of a recording, and as ``SessionFile.open``.
    """
    if not isinstance(recording, Recording):
        with SessionFile.open(Path(recording)) as file:
            yield file
        return
    recording._source.check_open()
    if not recording.is_whole:
        raise ConfigError(f"{recording!r}: found a part of a recording, expected the whole one")
    with file_limits.limits_in_force(recording._source.limits):
        yield without_state(recording._source.file)


def _messages(file: SessionFile) -> int:
    return sum(each.count for each in file.channels if each.kind in MESSAGES)


def _limits(given: FileLimits | Mapping[str, int] | None) -> FileLimits:
    if given is None:
        return file_limits.current_limits()
    if isinstance(given, FileLimits):
        return given
    known = {each.name for each in fields(FileLimits)}
    for name, value in given.items():
        if name not in known or not isinstance(value, int) or value < 1:
            raise ConfigError(
                f"limits: found {name!r}: {value!r}, expected numbers for {one_of(str(name), sorted(known))}"
            )
    return replace(file_limits.current_limits(), **given)


def _open_file(path: str | Path, resources: ExitStack, warnings: list[str]) -> SessionFile:
    if isinstance(path, str) and is_url(path):
        raw = resources.enter_context(RemoteFile(path))
        shown = Path(path.partition("?")[0])
        with named(shown, path):
            return SessionFile(shown, io.BufferedReader(raw, raw.block))
    try:
        return resources.enter_context(SessionFile.open(path))
    except BeingRecorded:
        raise
    except DamagedRecording as error:
        if "was cut off" not in str(error):
            raise
        return _salvaged(Path(path), resources, warnings)


def _salvaged(path: Path, resources: ExitStack, warnings: list[str]) -> SessionFile:
    """Copy what is whole in a file that was cut off to a temporary file, and open that."""
    from igtl_gateway.record.sessionfile.recovery import copy_readable  # its readers take half a second to load

    folder = Path(resources.enter_context(tempfile.TemporaryDirectory(prefix="igtl-gateway-")))
    copy = folder / path.name
    if path.is_dir():
        return _salvaged_parts(path, copy, resources, warnings)
    report = copy_readable(path, copy)
    for side in marks_files(path):
        write_bytes(folder / side.name, files.read_bytes(side))
    warnings.append(
        f"{path}: was cut off after {count_text(report.size, 'byte')}; {count_text(report.messages, 'message')} "
        f"{by_count(report.messages, 'is', 'are')} read, and it has no ledger "
        "of a finished session"
    )
    return resources.enter_context(SessionFile.open(copy))


def _salvaged_parts(path: Path, copy: Path, resources: ExitStack, warnings: list[str]) -> SessionFile:
    """As `_salvaged`, for the folder of a split recording: parts that are whole are not copied."""
    from igtl_gateway.record.sessionfile.recovery import copy_readable

    make_folder(copy)
    for part in part_files(path):
        place = copy / part.name
        try:
            SessionFile.open(part).close()
        except DamagedRecording as error:
            if "was cut off" not in str(error):
                raise
            report = copy_readable(part, place)
            warnings.append(
                f"{part}: was cut off after {count_text(report.size, 'byte')}; "
                f"{count_text(report.messages, 'message')} {by_count(report.messages, 'is', 'are')} read, and there is "
                "no ledger of a finished session"
            )
            with SessionFile.open(place) as file:
                is_part = layout.PART_KEY in file.session
            if not is_part:  # it was cut off in its first records
                place.unlink()
        except UnsupportedRecording as error:
            warnings.append(str(error))
        else:
            try:
                place.symlink_to(part.absolute())
            except OSError:  # Windows permits links to few
                shutil.copyfile(part, place)
    for side in marks_files(path):
        write_bytes((copy if side.parent == path else copy.parent) / side.name, files.read_bytes(side))
    return resources.enter_context(SessionFile.open(copy))
