"""The frames of a session for the export of a sequence: an IMAGE, with the state of every TRANSFORM at its time.

The value of a transform is the latest one before the image.  It is OK unless it is older than a second, was marked
invalid, is not finite, or was not received yet.  Without images, a frame is a time at which transforms were received.
Times are source stamps if set.  The account counts a TRANSFORM as written if it is in a frame, otherwise as left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from igtl_gateway.addon import (
    NS_PER_S,
    Buffer,
    ConfigError,
    Entry,
    Kind,
    Note,
    UnsupportedRecording,
    failure_text,
    limits,
    millimetres,
    recorded_units,
)
from igtl_gateway.addon.igtl import Image, Transform, decode
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream
from igtl_gateway.addons.exchange.selection import Recording, chosen_entries, matches_stream, message_time_ns
from igtl_gateway.addons.exchange.sequence import TRANSFORM_STATUS
from igtl_gateway.addons.exchange.volume_out import in_millimetres

#: Largest age of a valid transform at the time of the image.
MAX_AGE_NS = NS_PER_S
#: Message types in a sequence; a note of the edge has no type.
_TYPES = frozenset({"IMAGE", "TRANSFORM", ""})
#: Matrix of a transform without a valid value.
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


@dataclass(slots=True)
class _Tracked:
    """The latest value of a transform.

    Attributes:
        time_ns: UTC.
        matrix: the 16 numbers, row by row.
        valid: whether the value can be used.
        row: row of its stream in the account; None before the first message.
        why: reason if the message is in no frame.
        held: whether the message is in a frame.
    """

    time_ns: int = 0
    matrix: str = IDENTITY
    valid: bool = False
    row: ExportedStream | None = None
    why: str = ""
    held: bool = False

    def done(self) -> None:
        """Count the message as left out if it is in no frame; called for a newer message and at the end."""
        if self.row and not self.held:
            self.row.leave_out(self.why)


@dataclass(frozen=True, slots=True)
class SequenceFrame:
    """One frame.

    Attributes:
        time_ns: UTC.
        transforms: name → (the 16 numbers in a row, whether they are valid).
        image: None in a session without images.
    """

    time_ns: int
    transforms: dict[str, tuple[str, bool]]
    image: Image | None


@dataclass(slots=True)
class SequenceSurvey:
    """Facts about all frames, from one pass.

    Attributes:
        frames: number of frames.
        valid: name of a transform → number of frames in which it is OK.
        matrices: coordinate system and matrix of the images.
    """

    frames: int = 0
    valid: dict[str, int] = field(default_factory=dict)
    matrices: set[tuple[int, tuple[float, ...]]] = field(default_factory=set)


class SequenceFrames:
    """The frames of a session; each call of ``frames`` reads the complete session.

    Attributes:
        account: the account of the export.
        kind: kind of the exported entries: messages from peers, or those to peers if there are no others.
        images: the IMAGE stream, or empty.
        names: TRANSFORM stream → name of the transform in the file.
        first: the first image, which determines the format of all; None before the first pass.

    Raises UnsupportedRecording without any IMAGE or TRANSFORM, ConfigError for several IMAGE streams,
    LimitExceeded for more transforms than a sequence that is read back.
    """

    def __init__(self, recording: Recording, globs: Sequence[str]) -> None:
        self._recording, self._globs = recording, globs
        self._units = recorded_units(recording)
        self.account = ExportAccount()
        kinds: dict[Kind, set[str]] = {Kind.IGTL_IN: set(), Kind.IGTL_OUT: set()}
        invalid: set[str] = set()
        for entry in chosen_entries(recording, (*kinds, Kind.EDGE_NOTE), globs):
            if entry.kind is Kind.EDGE_NOTE:
                stream = _invalid_stream(entry)
                invalid |= {stream} if stream and matches_stream(stream, Kind.IGTL_IN, globs) else set()
            elif entry.type in ("IMAGE", "TRANSFORM"):
                kinds[entry.kind].add(entry.channel)
        self.kind = next((kind for kind, streams in kinds.items() if streams), Kind.IGTL_IN)
        streams = sorted(kinds[self.kind])
        self.images = [stream for stream in streams if stream.startswith("IMAGE/")]
        if not streams:
            raise UnsupportedRecording("found no IMAGE and no TRANSFORM of OpenIGTLink, expected at least one")
        if len(self.images) > 1:
            raise ConfigError(f"--streams: found {', '.join(self.images)}, expected one IMAGE and its TRANSFORMs")
        self.names: dict[str, str] = {}
        # includes transforms that were never valid
        for stream in sorted({*streams, *invalid}):
            if stream.startswith("TRANSFORM/"):
                name = re.sub(r"[^A-Za-z0-9]", "", stream.partition("/")[2]) or "Unnamed"
                while name in self.names.values():
                    name += "_"
                self.names[stream] = name
        limits.check_limit("fields", len(self.names), "transforms of one sequence, each of them in each frame")
        self.first: Image | None = None

    def frames(self, account: ExportAccount) -> Iterator[SequenceFrame]:
        """Yield all frames; ``account`` counts the messages in them."""
        tracked = {stream: _Tracked() for stream in self.names}
        moment: int | None = None  # time of the incomplete frame, if there are no images
        for entry in chosen_entries(self._recording, (self.kind, Kind.EDGE_NOTE), self._globs, account, _TYPES):
            if entry.kind is Kind.EDGE_NOTE:
                if (stream := _invalid_stream(entry)) in tracked:
                    tracked[stream].valid = False
                    tracked[stream].why = "marked as invalid before the next frame"
                continue
            if entry.channel not in self.names and entry.channel not in self.images:
                continue
            row = account.row(entry)
            try:
                content = decode(entry.data()).content
                unit = self._units.of(entry.kind, entry.channel, entry.type)
            except Exception as error:  # decoding raises many types of errors; only this message is left out
                row.fail(failure_text(error))
                continue
            if isinstance(content, Transform):
                at = message_time_ns(entry)
                if not self.images and moment is not None and at != moment:
                    yield self._frame(moment, tracked, None)
                moment = at
                tracked[entry.channel].done()
                tracked[entry.channel] = _tracked(content, unit, at, row, "images" if self.images else "moments")
            elif isinstance(content, Image):
                content = in_millimetres(content, unit)
                if why := self._mismatch(content):
                    row.fail(why)
                    continue
                row.taken += 1
                yield self._frame(message_time_ns(entry), tracked, content)
            else:
                row.fail("its content is not decoded")
        if not self.images and moment is not None:
            yield self._frame(moment, tracked, None)
        for one in tracked.values():
            one.done()

    def _frame(self, time_ns: int, tracked: dict[str, _Tracked], image: Image | None) -> SequenceFrame:
        result = {}
        for stream, one in tracked.items():
            valid = one.valid and time_ns - one.time_ns <= MAX_AGE_NS
            result[self.names[stream]] = (one.matrix, valid)
            if valid and one.row and not one.held:
                one.row.taken += 1
                one.held = True
            elif one.valid and not valid:
                one.why = f"older than {MAX_AGE_NS // NS_PER_S} s at the next image"
        return SequenceFrame(time_ns, result, image)

    def survey(self) -> SequenceSurvey:
        """Read all frames once and return facts about them."""
        result = SequenceSurvey(valid=dict.fromkeys(self.names.values(), 0))
        for frame in self.frames(ExportAccount()):
            result.frames += 1
            for name, (_, valid) in frame.transforms.items():
                result.valid[name] += valid
            if frame.image:
                result.matrices.add((frame.image.coordinate, frame.image.wire_matrix))
        return result

    def _mismatch(self, image: Image) -> str:
        """Return why an image cannot be a frame of this sequence; ``""`` if it can."""
        if image.sub_size != image.dimensions or not math.prod(image.dimensions):
            return "part of an image, or empty"
        if self.first is None:
            self.first = image
        first = self.first
        mine, its = ((one.dimensions, one.scalar_type, one.num_components) for one in (first, image))
        return "" if mine == its else f"size or pixel type differs from the first image of {first.dimensions}"


def _tracked(content: Transform, unit: str, at: int, row: ExportedStream, frames: str) -> _Tracked:
    """Return the state after a TRANSFORM; if its numbers are not finite, the identity, which is not valid."""
    if not all(map(math.isfinite, content.wire_matrix)):
        return _Tracked(at, row=row, why="not finite")
    lengths = millimetres(unit)
    rows = [[*matrix_row[:3], lengths.to_ros(matrix_row[3])] for matrix_row in content.rows[:3]]
    text = " ".join(f"{value:.9g}" for matrix_row in (*rows, content.rows[3]) for value in matrix_row)
    return _Tracked(at, text, True, row, f"between two {frames}: a frame contains the latest transform before it")


def _invalid_stream(entry: Entry) -> str:
    """Return the stream that a note marks as invalid; ``""`` for other notes."""
    payload: Buffer = entry.data()
    if TRANSFORM_STATUS.encode() not in bytes(payload):
        return ""
    note = Note.of(bytes(payload))
    return note.stream if note.code == TRANSFORM_STATUS else ""
