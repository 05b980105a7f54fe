"""The observations of a session: counts and measurements of each stream and link, and of notes.

``observer`` fills them, and the rules read them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.doctor.content import ContentMeasures
from igtl_gateway.doctor.fractions import FractionUnits
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.log.timing import StampTiming

#: The smallest plausible pixel spacing: that of a microscope.
FINE_MM = 0.001


@dataclass(slots=True)
class LengthStats:
    """Lengths in the messages of one stream, in millimetres if the configured unit of the stream is correct.

    Attributes:
        messages: number of messages with positions.
        positions: number of positions.
        poses: whether they are positions of poses.
        largest: largest distance from the origin, mm.
        moved: whether not all positions are equal.
        changed: of poses: whether the positions or orientations of a message differ from those of the first one.
        steps, path, span: of poses: number of steps from one message to the next, the sum of their lengths, and the
            largest distance from the first position, all in the unit of the messages.
        smallest_spacing: of images, mm; 0 = an image without spacing, None = no image.
        fine: number of images with a spacing below ``FINE_MM``.
    """

    messages: int = 0
    positions: int = 0
    poses: bool = True
    largest: float = 0.0
    moved: bool = False
    changed: bool = False
    steps: int = 0
    path: float = 0.0
    span: float = 0.0
    smallest_spacing: float | None = None
    fine: int = 0
    _first: Any = None
    _last: Any = None
    _content: Any = None

    def add(self, measured: ContentMeasures, millimetres: float) -> None:
        """Add the lengths of a message, which are finite; ``millimetres`` is the size of their unit."""
        if measured.spacing:
            spacing = min(measured.spacing) * millimetres
            # 0 is a spacing, too
            self.smallest_spacing = spacing if self.smallest_spacing is None else min(spacing, self.smallest_spacing)
            self.fine += spacing < FINE_MM
        positions = measured.positions
        if not len(positions):
            return
        self.messages += 1
        self.positions += len(positions)
        self.poses = measured.pose
        self.largest = max(self.largest, float(np.linalg.norm(positions, axis=1).max()) * millimetres)
        if self._first is None:
            self._first = positions[0].copy()
        self.moved = self.moved or bool((positions != self._first).any())
        if measured.pose and not self.changed:
            content = tuple(part.tobytes() for part in (positions, measured.rotations, measured.quaternions))
            if self._content is None:
                self._content = content
            self.changed = content != self._content
        if measured.pose:
            if self._last is not None:
                self.steps += 1
                self.path += float(np.linalg.norm(positions[0] - self._last))
            self.span = max(self.span, float(np.linalg.norm(positions[0] - self._first)))
            self._last = positions[0].copy()


@dataclass(slots=True)
class ObservedStream:
    """The messages of one peer with one type and device name.

    Attributes:
        link, type, device: the stream; the names are printable.
        raw_type, raw_device: the names as on the wire.
        messages, bytes: number and size of the complete messages.
        first_ns, last_ns: gateway times of the first and the last message, UTC.
        longest_pause_ns: longest time between two messages.
        good: number of messages that were decoded, with the right CRC.
        bad_crc, no_crc: number of wrong CRCs, and number of those that are 0.
        versions: number of messages for each header version.
        wrong_versions: of those, the refused ones whose version does not exist.
        misfits: number of messages whose body has the format of the other header version.
        deviations: deviation (a key of ``wire.deviations.READ``) → number of messages that were read in spite of it.
        milliseconds: number of stamps whose fraction the session has read as milliseconds.
        malformed: number of other messages that cannot be decoded; ``error`` is the first reason.
        unknown: whether the type has no codec.
        millimetres: unit of length by the configuration, mm.
        full_names: names in the metadata of messages whose device name was truncated.
        element_names: names in the body that fill their field.
        not_finite: number of messages with NaN or infinity.
        not_orthonormal, mirrored: number of messages with an invalid rotation, or a reflection.
        by_rows: of the invalid rotations, number of those that are valid if the matrix is read row by row.
        not_unit: number of messages with a quaternion whose length is not 1.
        shortest, longest: the smallest and the largest length.
        denormal, denormal_value: number of messages with a denormal number, and the first one.
        timing, fractions, lengths: statistics of stamps and lengths.
    """

    link: int
    type: str
    device: str
    raw_type: str
    raw_device: str
    messages: int = 0
    bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_pause_ns: int = 0
    good: int = 0
    bad_crc: int = 0
    no_crc: int = 0
    versions: Counter[int] = field(default_factory=Counter)
    wrong_versions: Counter[int] = field(default_factory=Counter)
    misfits: int = 0
    deviations: Counter[str] = field(default_factory=Counter)
    milliseconds: int = 0
    malformed: int = 0
    error: str = ""
    unknown: bool = False
    millimetres: float = 1.0
    full_names: set[str] = field(default_factory=set)
    element_names: set[str] = field(default_factory=set)
    not_finite: int = 0
    not_orthonormal: int = 0
    mirrored: int = 0
    by_rows: int = 0
    not_unit: int = 0
    shortest: float = 1.0
    longest: float = 1.0
    denormal: int = 0
    denormal_value: float = 0.0
    timing: StampTiming = field(default_factory=StampTiming)
    fractions: FractionUnits = field(default_factory=FractionUnits)
    lengths: LengthStats = field(default_factory=LengthStats)

    @property
    def name(self) -> str:
        """``TYPE/device``."""
        return f"{self.type}/{self.device}"

    @property
    def rate_hz(self) -> float:
        """Mean rate between the first and the last message; 0 for a single message."""
        span_ns = self.last_ns - self.first_ns
        return (self.messages - 1) * NS_PER_S / span_ns if span_ns > 0 else 0.0


@dataclass(slots=True)
class ObservedPeer:
    """One link with a peer.

    Attributes:
        number: of the link.
        address: of the peer.
        local: address of this side.
        asked: address of the peer as the configuration has it; "" if it is ``address``.
        role: of this program: ``"server"`` if the peer has connected to it.
        up_ns, down_ns: gateway times of begin and end, UTC; 0 = unknown.
        reason: why the link ended.
        messages: number of messages from the peer.
        received_bytes: bytes from the peer; known at the end of the link.
        received_versions: number of messages from the peer, for each header version.
        version: header version of the last message from the peer; 0 before the first one.
        follows: whether it has sent one version, or a newer one after it had received that, as PLUS does.
        first_sent_ns: header version → gateway time of the first message to the peer with it, UTC.
        head: first bytes from the peer that are not a complete message.
        head_code: code of the note that reported ``head``.
        head_text: and its text.
        is_gateway: whether the peer has replied to the probe of `doctor` as a gateway.
        is_replay: whether it has replied as a replay that waits for its peers.
    """

    number: int
    address: str = ""
    local: str = ""
    asked: str = ""
    role: str = ""
    up_ns: int = 0
    down_ns: int = 0
    reason: str = ""
    messages: int = 0
    received_bytes: int = 0
    received_versions: Counter[int] = field(default_factory=Counter)
    version: int = 0
    follows: bool = True
    first_sent_ns: dict[int, int] = field(default_factory=dict)
    head: bytes = b""
    head_code: str = ""
    head_text: str = ""
    is_gateway: bool = False
    is_replay: bool = False

    @property
    def name(self) -> str:
        """The address, or the number of the link if the address is unknown."""
        return self.address or f"link {self.number}"


@dataclass(slots=True)
class ObservedTopic:
    """The messages of a topic of ROS, as far as they were looked at.

    Attributes:
        type: the type of the first message.
        messages: number of messages.
        denormal: number of messages with a denormal number; ``field`` and ``value`` are those of the first one.
    """

    type: str
    messages: int = 0
    denormal: int = 0
    field: str = ""
    value: float = 0.0


@dataclass(slots=True)
class NoteCount:
    """Number of notes with one code, and the first of them."""

    count: int
    first: Note
