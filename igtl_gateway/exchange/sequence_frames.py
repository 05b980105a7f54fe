"""The frames of a session: an IMAGE with every TRANSFORM as it was at that moment.

A transform is the last one before the image, and OK unless it is more than a second old, was said to be invalid, is not
finite, or has not come yet.  Without images a frame is a moment at which transforms came.  Times are the senders'
stamps, where set.  The account counts what is in a frame: a TRANSFORM that is in none is left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from igtl_gateway.buffers import Buffer
from igtl_gateway.errors import ConfigError, UnsupportedRecording
from igtl_gateway.exchange.account import ExportAccount, ExportedStream
from igtl_gateway.exchange.folder import failure_text
from igtl_gateway.exchange.recording import Recording, chosen_entries, matches_stream, time_of
from igtl_gateway.exchange.sequence import TRANSFORM_STATUS
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Note
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire import decode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.transform import Transform

#: A transform that is older than this when an image is taken is not valid any more.
MAX_AGE_NS = NS_PER_S
#: Types of a sequence; a note of the edge has none.
_TYPES = frozenset({"IMAGE", "TRANSFORM", ""})
#: What stands for a matrix that is not known.
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


@dataclass(slots=True)
class _Tracked:
    """The last word on a transform; ``why`` it is not in a frame, as long as it is in none."""

    time_ns: int = 0
    matrix: str = IDENTITY
    valid: bool = False
    row: ExportedStream | None = None
    why: str = ""
    held: bool = False

    def done(self) -> None:
        """Another one took its place, or the session ended."""
        if self.row and not self.held:
            self.row.leave_out(self.why)


@dataclass(frozen=True, slots=True)
class SequenceFrame:
    """One frame.

    Attributes:
        time_ns: UTC.
        transforms: name → (the 16 numbers in a row, whether they are valid).
        image: None in a session of transforms only.
    """

    time_ns: int
    transforms: dict[str, tuple[str, bool]]
    image: Image | None


@dataclass(slots=True)
class SequenceSurvey:
    """What going through all frames told.

    Attributes:
        frames: number of them.
        valid: frames in which each transform is OK, by name.
        matrices: of the images, with their coordinate system.
    """

    frames: int = 0
    valid: dict[str, int] = field(default_factory=dict)
    matrices: set[tuple[int, tuple[float, ...]]] = field(default_factory=set)


class SequenceFrames:
    """The frames of a session; each call of ``frames`` goes through all of it.

    Raises UnsupportedRecording without any IMAGE or TRANSFORM, ConfigError where there are several IMAGE streams.
    """

    def __init__(self, recording: Recording, globs: Sequence[str]) -> None:
        self._recording, self._globs = recording, globs
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
        # those that never were valid are in it, too
        for stream in sorted({*streams, *invalid}):
            if stream.startswith("TRANSFORM/"):
                name = re.sub(r"[^A-Za-z0-9]", "", stream.partition("/")[2]) or "Unnamed"
                while name in self.names.values():
                    name += "_"
                self.names[stream] = name
        self.first: Image | None = None

    def frames(self, account: ExportAccount) -> Iterator[SequenceFrame]:
        """All frames; ``account`` counts what is in them."""
        tracked = {stream: _Tracked() for stream in self.names}
        moment: int | None = None  # of the frame that is being put together, where there are no images
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
            except Exception as error:  # whatever decoding makes of a damaged message costs that message
                row.fail(failure_text(error))
                continue
            if isinstance(content, Transform):
                at = time_of(entry)
                if not self.images and moment is not None and at != moment:
                    yield self._frame(moment, tracked, None)
                moment = at
                tracked[entry.channel].done()
                tracked[entry.channel] = _tracked(content, at, row, "images" if self.images else "moments")
            elif isinstance(content, Image):
                if why := self._unlike(content):
                    row.fail(why)
                    continue
                row.taken += 1
                yield self._frame(time_of(entry), tracked, content)
            else:
                row.fail("not decoded")
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

    def found(self) -> SequenceSurvey:
        """Go through all frames once."""
        result = SequenceSurvey(valid=dict.fromkeys(self.names.values(), 0))
        for frame in self.frames(ExportAccount()):
            result.frames += 1
            for name, (_, valid) in frame.transforms.items():
                result.valid[name] += valid
            if frame.image:
                result.matrices.add((frame.image.coordinate, frame.image.wire_matrix))
        return result

    def _unlike(self, image: Image) -> str:
        """Why an image cannot be a frame of this sequence; ``""`` if it can."""
        if image.sub_size != image.dimensions or not math.prod(image.dimensions):
            return "part of an image, or empty"
        if self.first is None:
            self.first = image
        first = self.first
        mine, its = ((one.dimensions, one.scalar_type, one.num_components) for one in (first, image))
        return "" if mine == its else f"unlike the first image of {first.dimensions}"


def _tracked(content: Transform, at: int, row: ExportedStream, frames: str) -> _Tracked:
    """A transform that came; one with numbers that are not finite stands as the identity, INVALID."""
    if not all(map(math.isfinite, content.wire_matrix)):
        return _Tracked(at, row=row, why="not finite")
    text = " ".join(f"{value:.9g}" for matrix_row in content.rows for value in matrix_row)
    return _Tracked(at, text, True, row, f"between two {frames}: a frame has the last one before it")


def _invalid_stream(entry: Entry) -> str:
    """The stream that a note calls invalid; ``""`` for other notes."""
    payload: Buffer = entry.data()
    if TRANSFORM_STATUS.encode() not in bytes(payload):
        return ""
    note = Note.of(bytes(payload))
    return note.stream if note.code == TRANSFORM_STATUS else ""
