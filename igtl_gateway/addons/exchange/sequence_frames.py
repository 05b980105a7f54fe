"""The frames of a session for the export of a sequence: an IMAGE, with every TRANSFORM at its time.

The value of a transform is its pose at the time of the image, between the two poses around it (``log.joining``), on one
clock (``log.one_clock``): the order of receipt does not matter.  It is INVALID where it is not known: before its first
and after its last pose, between poses that are further apart than the largest gap, next to one that was marked as
invalid or is not finite.  Without images, a frame is each time of a transform.  The account counts a TRANSFORM as
written if a frame uses it, otherwise as left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, UnsupportedRecording, distinct_names, failure_text
from igtl_gateway.addon.igtl import Image, Message, Transform
from igtl_gateway.addon.messages import millimetres
from igtl_gateway.addon.reading import (
    Buffer,
    Entry,
    Kind,
    Note,
    RecordedStamps,
    check_time,
    recorded_acceptance,
    recorded_units,
)
from igtl_gateway.addon.streams import (
    END_NS,
    GAP_NS,
    Interleaving,
    OneClock,
    StreamTimes,
    between_poses,
    one_clock,
    pick,
)
from igtl_gateway.addon.untrusted import limits
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, Recording, chosen_entries, matches_stream
from igtl_gateway.addons.exchange.sequence import OK, TRANSFORM_STATUS
from igtl_gateway.addons.exchange.sequence_names import StreamSource, another_name, name_in_file
from igtl_gateway.addons.exchange.volume_out import in_millimetres

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

#: Message types in a sequence; a note of the edge has no type.
_TYPES = frozenset({"IMAGE", "TRANSFORM", ""})
#: Matrix of a transform without a valid value.
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
#: Metadata of a TRANSFORM with its status, as PLUS and 3D Slicer write it.
_STATUS = "TransformStatus"


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


@dataclass(frozen=True, slots=True, eq=False)
class SequenceSurvey:
    """Facts about all frames, from one pass.

    Attributes:
        times: (N,) int64, time of each frame, UTC ns: the stamp of its image, or gateway time if that is unset.
        poses: name of a transform → its pose in each frame, (N, 4, 4), and in which frames it is OK, (N,).
        matrices: coordinate system and matrix of the images.
        clock: the clock on which images and transforms are joined.
    """

    times: Times
    poses: dict[str, tuple[Array, npt.NDArray[np.bool_]]]
    matrices: set[tuple[int, tuple[float, ...]]]
    clock: OneClock


@dataclass(slots=True)
class _Samples:
    """The messages of one stream that can be used.

    Attributes:
        times, stamps: gateway times and source stamps, UTC ns.
        rows: of a TRANSFORM the 16 numbers, row by row, in mm.
        segments: of a TRANSFORM how often it was marked as invalid before.
        sender: the link that they came from.
        row: row of the stream in the account.
        breaks: how often it was marked as invalid so far.
    """

    times: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    segments: list[int] = field(default_factory=list)
    sender: str = ""
    row: ExportedStream | None = None
    breaks: int = 0

    def add(self, entry: Entry, row: ExportedStream) -> None:
        check_time(max(entry.stamp_ns, entry.source_ns), f"entry {entry.seq}")
        self.times.append(entry.stamp_ns)
        self.stamps.append(entry.source_ns)
        self.sender, self.row = f"link {entry.links}" if entry.kind is Kind.IGTL_IN else "", row

    def stream(self, name: str) -> StreamTimes:
        return StreamTimes(name, np.array(self.times, np.int64), np.array(self.stamps, np.int64), self.sender)


class SequenceFrames:
    """The frames of a session; ``survey`` and each call of ``frames`` read the complete session.

    Args:
        recording: the session.
        globs: select streams.
        gap_ns: largest time between the two poses of a transform that a frame lies between.

    Attributes:
        account: the account of the export, which ``survey`` fills.
        images: the IMAGE streams: the one that the file has, or none.
        names: TRANSFORM stream → name of the transform in the file; all of them differ, also by case.
        first: the first image, which determines the format of all; None before ``survey``.

    Raises UnsupportedRecording without any IMAGE or TRANSFORM, ConfigError for several IMAGE streams,
    LimitExceeded for more transforms than a sequence that is read back.
    """

    def __init__(self, recording: Recording, globs: Sequence[str], gap_ns: int = GAP_NS) -> None:
        self._gap_ns = gap_ns
        self._recording, self._globs = recording, globs
        self._units, self._acceptance = recorded_units(recording), recorded_acceptance(recording)
        self.account = ExportAccount()
        links: dict[tuple[Kind, str], Interleaving] = {}
        # includes transforms that were never valid
        for entry in chosen_entries(recording, (*IGTL_KINDS, Kind.EDGE_NOTE), globs):
            if entry.kind is Kind.EDGE_NOTE:
                stream = _invalid_stream(entry)
                if stream.startswith("TRANSFORM/") and matches_stream(stream, Kind.IGTL_IN, globs):
                    links.setdefault((Kind.IGTL_IN, stream), Interleaving())
            elif entry.type in ("IMAGE", "TRANSFORM"):
                links.setdefault((entry.kind, entry.channel), Interleaving()).add(entry.links)
        if not links:
            raise UnsupportedRecording("found no IMAGE and no TRANSFORM of OpenIGTLink, expected at least one")
        self._mixed = {key for key, one in links.items() if key[0] is Kind.IGTL_IN and one.is_mixed}
        sources = [
            StreamSource(kind, stream, link)
            for (kind, stream), one in sorted(links.items(), key=lambda item: (item[0][1], item[0][0].value))
            for link in (sorted(one.links) if (kind, stream) in self._mixed else (0,))
        ]
        images = [source for source in sources if source.stream.startswith("IMAGE/")]
        received = [source for source in images if source.kind is Kind.IGTL_IN]
        self.images = received or images  # pictures of ROS are often those that a peer has sent
        if len(self.images) > 1:
            names = ", ".join(source.stream + (f"@{source.link}" if source.link else "") for source in self.images)
            raise ConfigError(f"--streams: found {names}, expected one IMAGE and its TRANSFORMs")
        transforms = [source for source in sources if source.stream.startswith("TRANSFORM/")]
        own = {source.stream for source in transforms if source.kind is Kind.IGTL_IN}
        #: Why the messages of a stream are not in the file.
        self._left: dict[StreamSource, str] = {
            source: f"{self.images[0]} has the pictures; --streams {source} selects these" for source in images
        }
        for source in transforms:
            if source.kind is Kind.IGTL_OUT and source.stream in own:
                self._left[source] = f"a peer sends one of this name, too; --streams {source} selects this one"
        for image in self.images:
            del self._left[image]
        self.names: dict[StreamSource, str] = distinct_names(
            {source: source.name for source in transforms if source not in self._left}, name_in_file, other=another_name
        )
        limits.check_limit("fields", len(self.names), "transforms of one sequence, each of them in each frame")
        self.first: Image | None = None

    def survey(self) -> SequenceSurvey:
        """Read the session, and return where each transform is in each frame."""
        images = _Samples()
        tracked = {source: _Samples() for source in self.names}
        matrices: set[tuple[int, tuple[float, ...]]] = set()
        kinds = (*IGTL_KINDS, Kind.EDGE_NOTE)
        for entry in chosen_entries(self._recording, kinds, self._globs, self.account, _TYPES):
            if entry.kind is Kind.EDGE_NOTE:
                stream = _invalid_stream(entry)
                for known, samples in tracked.items():
                    samples.breaks += known.kind is Kind.IGTL_IN and known.stream == stream
                continue
            source = self._source(entry)
            row = self.account.row(entry)
            if source in self._left:
                row.leave_out(self._left[source])
                continue
            try:
                message = self._acceptance.message(entry.data())
                unit = self._units.of(entry.kind, entry.channel, entry.type, entry.links)
            except Exception as error:  # decoding raises many types of errors; only this message is left out
                row.fail(failure_text(error))
                continue
            match message.content:
                case Transform():
                    _take(tracked[source], entry, message, message.content, unit, row)
                case Image():
                    image = in_millimetres(message.content, unit)
                    if why := self._mismatch(image):
                        row.fail(why)
                        continue
                    row.taken += 1
                    images.add(entry, row)
                    matrices.add((image.coordinate, image.wire_matrix))
                case _:
                    row.fail("its content is not decoded")
        self._survey = self._joined(images, tracked, matrices)
        return self._survey

    def _joined(
        self, images: _Samples, tracked: dict[StreamSource, _Samples], matrices: set[tuple[int, tuple[float, ...]]]
    ) -> SequenceSurvey:
        """Where each transform is at the time of each image, or of each transform without images."""
        known = {**tracked, **dict.fromkeys(self.images, images)}
        stamps = RecordedStamps(self._recording)

        def stream_of(source: StreamSource) -> StreamTimes:
            found = known[source].stream(str(source))
            lag = stamps.of(source.stream, source.stream.partition("/")[0]) if source.kind is Kind.IGTL_IN else None
            behind = StreamSource(Kind.IGTL_IN, lag.behind_channel, source.link) if lag else None
            return replace(found, behind=known[behind].stream(str(behind))) if behind in known else found

        streams = [stream_of(source) for source in tracked]
        own = [stream_of(self.images[0])] if self.images else []
        clock = one_clock([*own, *streams])
        moments = [clock.times(each, number) for number, each in enumerate([*own, *streams])]
        wanted = moments[0] if own else np.unique(np.concatenate(moments))
        # a frame has the time that its image states, whatever the clock of the others is
        times = np.where(own[0].stamps > 0, own[0].stamps, own[0].times) if own else wanted
        what = "images" if own else "moments"
        poses = {
            self.names[source]: _poses(samples, at, wanted, self._gap_ns, what)
            for (source, samples), at in zip(tracked.items(), moments[len(own) :], strict=True)
        }
        return SequenceSurvey(times, poses, matrices, clock)

    def frames(self) -> Iterator[SequenceFrame]:
        """Yield all frames, after ``survey``."""
        survey = self._survey
        names = list(survey.poses)
        images = self._images() if self.images else None
        for number, time_ns in enumerate(survey.times.tolist()):
            transforms = {}
            for name in names:
                matrices, good = survey.poses[name]
                valid = bool(good[number])
                text = " ".join(f"{value:.9g}" for value in matrices[number].ravel().tolist()) if valid else IDENTITY
                transforms[name] = (text, valid)
            yield SequenceFrame(time_ns, transforms, next(images) if images else None)

    def _images(self) -> Iterator[Image]:
        """Yield the images that ``survey`` has taken."""
        for entry in chosen_entries(self._recording, IGTL_KINDS, self._globs, types={"IMAGE"}):
            if self._source(entry) not in self.images:
                continue
            try:
                content = self._acceptance.message(entry.data()).content
                unit = self._units.of(entry.kind, entry.channel, entry.type, entry.links)
            except Exception:  # counted by the survey
                continue
            if isinstance(content, Image) and not self._mismatch(image := in_millimetres(content, unit)):
                yield image

    def _source(self, entry: Entry) -> StreamSource:
        """Return the stream of an IMAGE or a TRANSFORM; that of its link if several peers send it in turn."""
        mixed = (entry.kind, entry.channel) in self._mixed
        return StreamSource(entry.kind, entry.channel, entry.links[0] if mixed else 0)

    def _mismatch(self, image: Image) -> str:
        """Return why an image cannot be a frame of this sequence; ``""`` if it can."""
        if image.sub_size != image.dimensions or not math.prod(image.dimensions):
            return "part of an image, or empty"
        if self.first is None:
            self.first = image
        first = self.first
        mine, its = ((one.dimensions, one.scalar_type, one.num_components) for one in (first, image))
        return "" if mine == its else f"size or pixel type differs from the first image of {first.dimensions}"


def _take(
    samples: _Samples, entry: Entry, message: Message, content: Transform, unit: str, row: ExportedStream
) -> None:
    """Add a TRANSFORM; one that is not finite or not valid by its metadata is left out, and breaks its series."""
    samples.row = row
    status = next((item.text for item in message.metadata if item.key == _STATUS), OK)
    if not all(map(math.isfinite, content.wire_matrix)) or status.upper() != OK:
        row.leave_out("not finite" if status.upper() == OK else f"status {status[:20]}")
        samples.breaks += 1
        return
    lengths = millimetres(unit)
    rows = [[*matrix_row[:3], lengths.to_ros(matrix_row[3])] for matrix_row in content.rows[:3]]
    samples.add(entry, row)
    samples.rows.append([value for matrix_row in (*rows, content.rows[3]) for value in matrix_row])
    samples.segments.append(samples.breaks)


def _poses(samples: _Samples, at: Times, wanted: Times, gap_ns: int, what: str) -> tuple[Array, npt.NDArray[np.bool_]]:
    """The poses of a transform at the wanted times (N,), and which are OK; counts what is in no frame as left out."""
    order = np.argsort(at, kind="stable")
    at = at[order]
    last = np.append(at[1:] > at[:-1], True)[: len(at)]  # of equal times the last one received
    order, at = order[last], at[last]
    matrices = np.array(samples.rows, np.float64).reshape(-1, 4, 4)[order]
    segments = np.array(samples.segments, np.int64)[order]
    picks = pick(at, wanted, "interpolate", gap_ns=gap_ns, segments=segments, end_ns=END_NS)
    found = np.broadcast_to(np.eye(4), (len(wanted), 4, 4)).copy()
    good = picks.good
    before, after, share = picks.before[good], picks.after[good], picks.share[good]
    if len(at):
        found[good] = between_poses(matrices[before], matrices[after], share)
    used = np.zeros(len(at), np.bool_)
    used[before[share < 1]] = used[after[share > 0]] = True
    near = np.zeros(len(at), np.bool_)
    if len(at):
        inside = ~good & (wanted > at[0]) & (wanted < at[-1])
        near[picks.before[inside]] = near[picks.after[inside]] = True
    if row := samples.row:
        row.taken += int(used.sum())
        reasons = {
            "another one has its time": len(last) - len(at),
            f"next to a gap of more than {gap_ns / NS_PER_S:g} s, or to one that is invalid": int((near & ~used).sum()),
            f"between two {what}, before the first or after the last one": int((~near & ~used).sum()),
        }
        for why, number in reasons.items():
            if number:
                row.leave_out(why, number)
    return found, good


def _invalid_stream(entry: Entry) -> str:
    """Return the stream that a note marks as invalid; ``""`` for other notes."""
    payload: Buffer = entry.data()
    if TRANSFORM_STATUS.encode() not in bytes(payload):
        return ""
    note = Note.of(bytes(payload))
    return note.stream if note.code == TRANSFORM_STATUS else ""
