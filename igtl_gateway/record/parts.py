"""A split recording: a folder of session files, each readable alone, with the side file that ``ros2 bag`` needs.

``name.mcap`` becomes ``name/name_0.mcap``, ``name/name_1.mcap`` …  A part ends only before an input, so outputs lie in
the part of their cause.  ``metadata.yaml`` names the parts that are complete; after a crash the last one is missing
there, and everything else opens as it is.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from igtl_gateway.errors import RecordingError
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.session.entry import Entry
from igtl_gateway.sessionfile import layout
from igtl_gateway.sessionfile.writer import SessionWriter, TopicCount, cannot_begin
from igtl_gateway.stamp import NS_PER_S

SIDE_FILE = "metadata.yaml"

#: (path, further session facts, prologue) → the writer of a part.
Open = Callable[[Path, dict[str, str], Sequence[Entry]], SessionWriter]


@dataclass(frozen=True, slots=True)
class RecordingPart:
    """A complete part: first and last stamp in UTC ns (0: no entries), entries, and bytes of the file."""

    path: Path
    start_ns: int
    end_ns: int
    entries: int
    topics: tuple[TopicCount, ...]
    size: int


class PartsWriter:
    """Writes a split recording; as SessionWriter.

    Args:
        path: ``name.mcap``, which names the folder.
        open_part: makes the writer of a part.
        prologue: has to be fresh.
        max_bytes, max_s: a part ends when it has this size, or lasted so long; 0: never.
        overwrite: replace an existing split recording.
        counters: of the recorder so far, for the ledger of a part that is not the last.

    Raises RecordingError when the folder or the first part cannot be created.
    """

    def __init__(
        self,
        path: Path,
        open_part: Open,
        prologue: Prologue,
        *,
        max_bytes: int,
        max_s: float,
        overwrite: bool,
        counters: Callable[[], dict[str, Any]],
    ) -> None:
        self.path = parts_folder(path)
        self._open_part = open_part
        self._prologue = prologue
        self._max_bytes, self._max_ns = max_bytes, int(max_s * NS_PER_S)
        self._counters = counters
        self._parts: list[RecordingPart] = []
        _make_folder(self.path, overwrite)
        try:
            self._part = self._open()
        except RecordingError:
            with contextlib.suppress(OSError):  # it holds something
                self.path.rmdir()
            raise
        self._ended = False  # the part is one of the complete ones

    @property
    def entries(self) -> int:
        return sum(part.entries for part in self._parts) + (0 if self._ended else self._part.entries)

    @property
    def undefined(self) -> list[str]:
        return self._part.undefined

    @property
    def files(self) -> list[Path]:
        """All that was written."""
        known = [part.path for part in self._parts]
        return [*known, *([] if self._ended else [self._part.path]), self.path / SIDE_FILE]

    def write(self, entry: Entry) -> None:
        """Add an entry, in the next part if this one is full.  Raises as SessionWriter.write."""
        if entry.kind.is_input and self._part.entries and self._full(entry):
            self._end({"recorder": self._counters()})
            self._part = self._open()
            self._ended = False
        self._part.write(entry)
        self._prologue.observe(entry)

    def flush(self) -> None:
        """As SessionWriter.flush."""
        self._part.flush()

    def close(self, ledger: dict[str, Any]) -> None:
        """End the last part.  Raises RecordingError; what was flushed stays readable."""
        self._end(ledger)

    def _full(self, entry: Entry) -> bool:
        lasted_ns = entry.stamp_ns - self._part.start_ns
        return bool(
            (self._max_bytes and self._part.size >= self._max_bytes) or (self._max_ns and lasted_ns >= self._max_ns)
        )

    def _open(self) -> SessionWriter:
        number = len(self._parts)
        facts = {layout.PART_KEY: str(number)}
        if self._parts:
            facts[layout.PREVIOUS_KEY] = self._parts[-1].path.name
        path = self.path / f"{self.path.name}_{number}.mcap"
        return self._open_part(path, facts, self._prologue.entries())

    def _end(self, ledger: dict[str, Any]) -> None:
        part = self._part
        part.close(ledger)
        try:
            size = part.path.stat().st_size
            if not self._ended:
                self._ended = True
                self._parts.append(
                    RecordingPart(part.path, part.start_ns, part.end_ns, part.entries, tuple(part.topics()), size)
                )
            write_side_file(self.path, self._parts)
        except OSError as error:
            raise RecordingError(f"recording to {self.path} failed: {error.strerror or error}") from error


def parts_folder(path: Path) -> Path:
    """The folder of the parts of ``name.mcap``."""
    return path.with_suffix("") if path.suffix == ".mcap" else path


def write_side_file(folder: Path, parts: Sequence[RecordingPart]) -> None:
    """Write ``metadata.yaml``, so that at any moment there is the old one or the new one.  Raises OSError."""
    _replace(folder / SIDE_FILE, _side_file(parts))


def _side_file(parts: Sequence[RecordingPart]) -> str:
    """``metadata.yaml`` as rosbag2 (Jazzy, version 9) writes it."""
    full = [part for part in parts if part.entries]
    start_ns = min((part.start_ns for part in full), default=0)
    end_ns = max((part.end_ns for part in full), default=0)
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 9",
        "  storage_identifier: mcap",
        *_span("  ", start_ns, end_ns - start_ns, sum(part.entries for part in parts)),
        "  topics_with_message_count:" + ("" if full else " []"),
    ]
    for topic in _merged(parts):
        profiles = [f"          {line}" for line in topic.qos.splitlines()]
        lines += [
            "    - topic_metadata:",
            f"        name: {json.dumps(topic.topic)}",
            f"        type: {json.dumps(topic.type)}",
            f"        serialization_format: {layout.MESSAGE_ENCODING}",
            "        offered_qos_profiles:" + ("" if profiles else " []"),
            *profiles,
            f"        type_description_hash: {json.dumps(topic.type_hash)}",
            f"      message_count: {topic.count}",
        ]
    none = "" if parts else " []"
    lines += ['  compression_format: ""', '  compression_mode: ""', f"  relative_file_paths:{none}"]
    lines += [f"    - {json.dumps(part.path.name)}" for part in parts]
    lines.append(f"  files:{none}")
    for part in parts:
        lines.append(f"    - path: {json.dumps(part.path.name)}")
        lines += _span("      ", part.start_ns, part.end_ns - part.start_ns, part.entries)
    return "\n".join([*lines, "  custom_data: ~", "  ros_distro: jazzy", ""])


def _span(indent: str, start_ns: int, duration_ns: int, messages: int) -> list[str]:
    return [
        f"{indent}starting_time:",
        f"{indent}  nanoseconds_since_epoch: {start_ns}",
        f"{indent}duration:",
        f"{indent}  nanoseconds: {duration_ns}",
        f"{indent}message_count: {messages}",
    ]


def _merged(parts: Sequence[RecordingPart]) -> list[TopicCount]:
    topics: dict[tuple[str, str], TopicCount] = {}
    for topic in (topic for part in parts for topic in part.topics):
        before = topics.get((topic.topic, topic.type))
        topics[topic.topic, topic.type] = replace(topic, count=topic.count + (before.count if before else 0))
    return list(topics.values())


def _make_folder(folder: Path, overwrite: bool) -> None:
    """The folder, without what an earlier recording left there.  Raises RecordingError with what is in the way."""
    try:
        folder.mkdir()
    except FileExistsError:
        if not folder.is_dir():
            raise RecordingError(f"cannot record to {folder}: it is not a folder") from None
        ours = [folder / SIDE_FILE, *folder.glob(f"{folder.name}_*.mcap")]
        ours = [path for path in ours if path.exists()]
        if not ours:
            return
        if not overwrite:
            raise RecordingError(
                f"cannot record to {folder}: it holds a recording already, which is not replaced without --overwrite"
            ) from None
        for path in ours:
            path.unlink()
    except (OSError, ValueError) as error:
        raise cannot_begin(folder, error) from None


def _replace(path: Path, text: str) -> None:
    """Write a file so that at any moment there is the old one or the new one."""
    new = path.with_name(f".{path.name}")
    try:
        new.write_text(text, "utf-8")
        os.replace(new, path)
    except OSError:
        with contextlib.suppress(OSError):
            new.unlink()
        raise
