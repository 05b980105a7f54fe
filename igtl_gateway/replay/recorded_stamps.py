"""Stamps as readers see them: with the corrections that a recording states.

The bytes of a recording stay those of the record.  ``sync --apply`` records the lag of a stream, ``merge`` the offset
of the clock of a part.  Both move the source stamps of the entries; here they move ``header.stamp`` in ROS messages,
which is what most readers of ROS take.  Whatever shows, exports or joins messages reads them through `RecordedStamps`;
``verify`` and ``replay`` do not.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import DamagedRecording, GatewayError
from igtl_gateway.base.untrusted.definitions import parse_definition
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.gateway.log.corrections import CORRECTED, CORRECTIONS, StampCorrection
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.bulk import MessageBlock, block_of
from igtl_gateway.record.sessionfile.channels import ChannelSummary
from igtl_gateway.record.sessionfile.header_stamps import StampPlace, stamp_place
from igtl_gateway.record.sessionfile.merged import Merge, offset_of_part

Times = npt.NDArray[np.int64]
#: (stamps, gateway times, source stamps), (N,) each, UTC ns → corrected stamps.
Move = Callable[[Times, Times, Times], Times]

#: Sessions with corrections of an earlier version have them in notes alone.
_CORRECTED_BY = "corrected_by"
_NOTES = frozenset({Kind.EDGE_NOTE})


class RecordedFile(Protocol):
    """What it needs of a session file."""

    @property
    def session(self) -> Mapping[str, str]: ...
    @property
    def definitions(self) -> Mapping[str, str]: ...
    def entries(self) -> Iterator[Entry]: ...


@dataclass(frozen=True, slots=True)
class _Moved:
    """How the stamps in the messages of a stream move, where they are, and of which frame."""

    move: Move
    place: StampPlace | None
    is_tf: bool
    frame: str


class RecordedStamps:
    """The corrections of a recording.

    Attributes:
        corrections: (channel, type) of a stream → its correction.
        notes: sentences for the user, one for each correction.

    Raises DamagedRecording for corrections that cannot be read.
    """

    def __init__(self, file: RecordedFile) -> None:
        self._file = file
        self.corrections: dict[tuple[str, str], StampCorrection] = {}
        self._parts: dict[str, Callable[[Times], Times]] = {}
        merge: Merge | None = getattr(file, "merge", None)
        if merge is None:
            self._add(_recorded(file.session, file, "session"), "")
        else:
            for part in merge.facts["parts"]:
                self._add(_recorded(part["session"], None, f"part {part['name']}"), f"/{part['name']}")
                if (offset := offset_of_part(part)) is not None:
                    self._parts[part["name"]] = offset
        self.notes = tuple(f"sync: {each.text()}" for each in self.corrections.values())
        self._moved: dict[tuple[str, str], _Moved | None] = {}

    def __bool__(self) -> bool:
        return bool(self.corrections or self._parts)

    def of(self, channel: str, type_name: str) -> StampCorrection | None:
        """Return the correction of a stream by ``sync``."""
        return self.corrections.get((channel, type_name)) or self.corrections.get((channel, ""))

    def block(self, channel: ChannelSummary, block: MessageBlock) -> MessageBlock:
        """Return messages of a stream with corrected stamps."""
        if not self or channel.kind not in (Kind.ROS_IN, Kind.ROS_OUT):
            return block
        moved = self._of(channel.kind, channel.stream, channel.type)
        return block if moved is None else _with_moved(block, moved)

    def entry(self, entry: Entry) -> Entry:
        """Return an entry with the corrected stamps in its message."""
        if not self or entry.kind not in (Kind.ROS_IN, Kind.ROS_OUT):
            return entry
        moved = self._of(entry.kind, entry.channel, entry.type)
        if moved is None:
            return entry
        return replace(entry, payload=(bytes(_with_moved(block_of([entry]), moved).payload(0)),))

    def _add(self, corrections: Iterable[StampCorrection], prefix: str) -> None:
        for each in corrections:
            moved = replace(each, channel=prefix + each.channel, behind_channel=prefix + each.behind_channel)
            self.corrections[moved.channel, moved.type] = moved

    def _of(self, kind: Kind, channel: str, ros_type: str) -> _Moved | None:
        key = channel, ros_type
        if key not in self._moved:
            self._moved[key] = self._made(channel, ros_type)
        found = self._moved[key]
        # a correction is that of an input; what the gateway made of it is as it was
        return None if found and kind is not Kind.ROS_IN and self.of(*key) else found

    def _made(self, channel: str, ros_type: str) -> _Moved | None:
        moves: list[Move] = []
        correction = self.of(channel, ros_type)
        if correction is not None:
            moves.append(_correcting(correction))
        part = self._parts.get(channel.split("/")[1] if channel.startswith("/") else "")
        if part is not None:
            moves.append(_shifting(part))
        if not moves:
            return None
        text = self._file.definitions.get(ros_type, "")
        try:
            place = stamp_place(parse_definition(text, ros_type), ros_type) if text else None
        except GatewayError:
            place = None
        is_tf = ros_type == TFMessage.TYPE
        if place is None and not is_tf:
            return None

        def move(stamps: Times, times: Times, sources: Times) -> Times:
            for each in moves:
                stamps = each(stamps, times, sources)
            return stamps

        return _Moved(move, place, is_tf, correction.frame if correction else "")


def _correcting(correction: StampCorrection) -> Move:
    def move(stamps: Times, _: Times, sources: Times) -> Times:
        # of a lag of gateway times the source stamps are the corrected times
        return correction.corrected(stamps) if correction.is_stamped else sources

    return move


def _shifting(offset: Callable[[Times], Times]) -> Move:
    def move(stamps: Times, times: Times, _: Times) -> Times:
        return np.where(stamps == 0, 0, stamps - offset(times))

    return move


def _with_moved(block: MessageBlock, moved: _Moved) -> MessageBlock:
    if moved.is_tf:
        return _with_moved_frames(block, moved)
    assert moved.place is not None
    stamps = moved.move(moved.place.of(block), block.times, block.source_times)
    return moved.place.with_stamps(block, stamps)


def _with_moved_frames(block: MessageBlock, moved: _Moved) -> MessageBlock:
    """TFMessages with moved stamps of one frame, or of all."""
    payloads = []
    for row in range(len(block)):
        payload = bytes(block.payload(row))
        try:
            message = TFMessage.unpack(payload)
        except GatewayError:
            payloads.append(payload)
            continue
        transforms = []
        for each in message.transforms:
            if moved.frame not in ("", each.child_frame_id):
                transforms.append(each)
                continue
            stamps = np.array([each.header.stamp_ns], np.int64)
            (stamp_ns,) = moved.move(stamps, block.times[row : row + 1], block.source_times[row : row + 1]).tolist()
            transforms.append(replace(each, header=replace(each.header, stamp_ns=max(stamp_ns, 0))))
        payloads.append(TFMessage(tuple(transforms)).pack())
    ends = np.cumsum([len(each) for each in payloads], dtype=np.int64)
    begins = np.concatenate((np.zeros(1, np.int64), ends[:-1])) if payloads else ends
    data = np.frombuffer(b"".join(payloads), np.uint8)
    return MessageBlock(data, begins, ends, block.numbers, block.times, block.source_times)


def _recorded(session: Mapping[str, str], file: RecordedFile | None, place: str) -> Iterator[StampCorrection]:
    """The corrections that a session states; of an earlier version from the notes in its file."""
    if text := session.get(CORRECTIONS, ""):
        found: Any = parse_json(text, f"{place}: {CORRECTIONS}")
        if not isinstance(found, list):
            raise DamagedRecording(f"{place}: {CORRECTIONS}: found {json.dumps(found)[:40]}, expected an array")
        for number, each in enumerate(found):
            yield StampCorrection.of(each, f"{place}: {CORRECTIONS}[{number}]")
    elif _CORRECTED_BY in session and file is not None:
        entries: Iterator[Entry] = getattr(file, "entries_of_kinds", lambda _: file.entries())(_NOTES)
        for entry in entries:
            if entry.seq and entry.kind is Kind.EDGE_NOTE:
                note = Note.of(entry.data())
                if note.code == CORRECTED:
                    yield StampCorrection.of(note.data, f"{place}: note {entry.seq}")
