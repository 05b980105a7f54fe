"""Peer profiles: what the programs of peers can and cannot read, as rows of a table with sources.

The sources are code and documents of these programs, as collected in ``openigtlink-reference`` (§ names its sections),
and reports of their users.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.geometry import flip_lps_ras
from igtl_gateway.convert.plus_signs import frame_of_picture, is_any_plus, is_recent_plus
from igtl_gateway.convert.substitutes import (
    FOR_OPENIGTLINK4J,
    FOR_OPENIGTLINK_RUST,
    FOR_SLICER,
    SLICER_ASKS,
    SLICER_READS,
    Substitute,
    by_type,
)
from igtl_gateway.wire import Message, Raw
from igtl_gateway.wire.fields import decode_text
from igtl_gateway.wire.image import RAS, Image
from igtl_gateway.wire.polydata import (
    CELL,
    F4,
    NO_CELLS,
    NORMAL,
    RGBA,
    SCALAR,
    TCOORDS,
    TENSOR,
    VECTOR,
    Attribute,
    Cells,
    PolyData,
)
from igtl_gateway.wire.query import EmptyQuery, StartTracking, split_query
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.tracking import TrackingData
from igtl_gateway.wire.transform import Position, Transform

#: Metadata that a peer expects with a message: content → (key, value).
Expected = Callable[[Any], tuple[tuple[str, str], ...]]


def _pose_status(_content: Any) -> tuple[tuple[str, str], ...]:
    """PLUS reads the status of a pose from this key, without it with a warning."""
    return (("TransformStatus", "OK"),)


def _position_status(_content: Any) -> tuple[tuple[str, str], ...]:
    """PLUS writes ``TransformStatus``, and reads ``Status``."""
    return (("Status", "OK"), ("TransformStatus", "OK"))


def _tool_status(content: TrackingData) -> tuple[tuple[str, str], ...]:
    """PLUS has a status for each tool."""
    return tuple((f"{decode_text(name)}Status", "OK") for name in content.elements["name"].tolist())


#: Types that the factory of the C++ library 3.x knows; PLUS loses the stream at any other type.
CPP_FACTORY = frozenset(
    "CAPABILITY COMMAND GET_IMAGE GET_IMGMETA GET_LBMETA GET_POINT GET_POLYDATA GET_STATUS GET_TRAJ GET_TRANS IMAGE "
    "IMGMETA LBMETA POINT POLYDATA POSITION QTDATA RTS_COMMAND RTS_POLYDATA RTS_QTDATA RTS_TDATA STATUS STP_POLYDATA "
    "STP_QTDATA STP_TDATA STRING STT_POLYDATA STT_QTDATA STT_TDATA TDATA TRAJ TRANSFORM".split()
)

#: (content, warning or "") in place of a content that the peer would misread.
Adapted = tuple[Any, str]


def _readable_pixels(image: Image) -> Adapted:
    """Slicer reads 32-bit integers as C ``long`` and interprets all matrices as RAS."""
    warning = ""
    if image.number_type != image.scalar_type:
        image = replace(image, scalar_type=image.number_type)
    if image.scalar_type in (6, 7):
        values = image.array.astype("<f4")
        if (values.astype(np.float64) != image.array).any():
            warning = "32-bit pixels beyond 2^24 are rounded: 3D Slicer takes them as float32 only"
        image = replace(image, scalar_type=10, endian=2, pixels=values.reshape(-1).view(np.uint8).data)
    if image.is_lps:
        image = replace(image, coordinate=RAS, wire_matrix=flip_lps_ras(image.wire_matrix))
    return image, warning


#: Floats that the C++ reader takes of each tuple of an attribute, except point scalars, vectors and normals (§6.15).
_NINE = 9
#: Kind of attribute → the components that the C++ reader takes, whatever the head has; of scalars it reads the head.
_TAKEN = {VECTOR: 3, NORMAL: 3, TENSOR: 9, RGBA: 4, TCOORDS: 3}
#: Its largest number of components of scalars.
_MOST_SCALARS = 127


def _nine_components(content: PolyData) -> Adapted:
    """Return the attributes as the C++ reader takes them (§6.15); one that it would misread is left out."""
    if all(attribute.type == SCALAR and 0 < attribute.components <= _MOST_SCALARS for attribute in content.attributes):
        return content, ""
    readable, left_out = [], []
    for attribute in content.attributes:
        adapted = _for_cpp_reader(attribute)
        if adapted is None:
            found = f"type {attribute.type:#x}, {counted(attribute.values.shape[1], 'component')}"
            left_out.append(f"{attribute.name!r} ({found})")
        else:
            readable.append(adapted)
    if left_out:
        names = ", ".join(left_out[:3]) + (" …" if len(left_out) > 3 else "")
        return replace(content, attributes=tuple(readable)), (
            f"attributes that the C++ library would misread are left out: {names}"
        )
    if all(map(operator.is_, readable, content.attributes)):
        return content, ""
    return replace(content, attributes=tuple(readable)), ""


def _for_cpp_reader(attribute: Attribute) -> Attribute | None:
    """Return an attribute in the form of the C++ reader; None if it has none."""
    kind, count = attribute.type & ~CELL, attribute.tuples
    if not count or attribute.is_padded:
        return attribute
    if kind == SCALAR:
        return _scalars_for_cpp_reader(attribute)
    taken = _TAKEN.get(kind)
    if taken is None:
        return None
    values = attribute.values
    found = values.shape[1]
    if found != taken:
        if kind == TENSOR or found > taken or (kind == RGBA and found < taken - 1):
            return None
        # an unset alpha is 1, the third component of a plane is 0
        wider = np.full((count, taken), float(kind == RGBA), F4)
        wider[:, :found] = values
        attribute = Attribute.of(attribute.type, attribute.name, wider)
    if attribute.type <= NORMAL or attribute.components == _NINE:
        return attribute
    return replace(attribute, components=_NINE, data=_padded(attribute.values))


def _scalars_for_cpp_reader(attribute: Attribute) -> Attribute | None:
    if not attribute.type & CELL:
        return attribute if attribute.components <= _MOST_SCALARS else None
    if attribute.components == _NINE:
        return attribute
    # the reader takes nine floats a cell from the data, and their number of components from the head
    return None if attribute.components > _NINE else replace(attribute, data=_padded(attribute.values), is_padded=True)


def _padded(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the values one after the other, then zeros: nine floats for each row."""
    data = np.zeros(len(values) * _NINE, F4)
    data[: values.size] = values.reshape(-1)
    return data


def _surface_for_slicer(content: PolyData) -> Adapted:
    """Return attributes as the C++ reader takes them (§6.15), and each vertex as a line from its point to itself.

    The connector takes one point of each vertex cell, and writes beyond the end of an array from the second cell on.
    """
    content, warning = _nine_components(content)
    if not content.vertices.count:
        return content, warning
    cells = content.vertices
    points = (
        np.delete(cells.data, cells.starts("POLYDATA vertices")) if cells.table is None else cells.table.reshape(-1)
    )
    ends = Cells.of(np.stack([points, points], axis=1))
    lines = Cells(ends.count + content.lines.count, np.concatenate([ends.data, content.lines.data]))
    if cells.count != len(points) and any(attribute.type & CELL for attribute in content.attributes):
        kept = tuple(attribute for attribute in content.attributes if not attribute.type & CELL)
        warning = warning or "attributes of cells are left out: the vertices of the surface are cells of several points"
        content = replace(content, attributes=kept)
    return replace(content, vertices=NO_CELLS, lines=lines), warning


def _no_frame(_device: str, _keys: Iterable[str], _naming: int) -> str:
    return ""


@dataclass(frozen=True, slots=True)
class PeerProfile:
    """The known facts of one kind of peer.

    Attributes:
        name: name in options and configurations.
        facts: (fact, source); the reasons for the settings below.
        first_version: header version of the first message to the peer.
        max_version: highest header version of messages to the peer.
        least_version: lowest header version that the peer reads.
        reads: types that may be sent, without queries and their replies; None for all.
        queries: queries (GET_, STT_, STP_ types) that may be sent; None for all types in ``reads``.
        replies: RTS_ types that may be sent; None for all types in ``reads``.
        takes_empty: whether the peer accepts a version 1 message without content of a type that has content.
        ping_ns: time without a message after which a GET_STATUS is sent; 0 = never.
        asks_once: whether the peer ignores the refusal of a stream: it waits for the frame that it asks for.
        adapt: class of a content → function that adapts it to the peer.
        expects: class of a content → function that returns the metadata which the peer expects with it.
        shows: returns whether only such a peer can send a message; None if no message shows that.
        frame_of_picture: device name of a picture, the keys of its metadata and the version of the rules of names → the
            frame that it names; "" if it names none.
        instead: type → what the peer gets in place of it, if it does not read it; ``*``: of all other types.
        if_asked: types that it gets once it has asked for them (GET_, STT_).
        greeting: whether its first message may be a STATUS without a device, whose code it never sets.
        stamped: whether messages in header version 2 have a stamp in their metadata also if ROS has none.
        arm_unit: length unit of the devices of CRTK arms, in both directions; "": that of their row.
        milliseconds: whether its stamps have milliseconds in place of the fraction of a second.
    """

    name: str
    facts: tuple[tuple[str, str], ...]
    first_version: int = 1
    max_version: int = 2
    least_version: int = 1
    reads: frozenset[str] | None = None
    queries: frozenset[str] | None = None
    replies: frozenset[str] | None = None
    takes_empty: bool = False
    ping_ns: int = 0
    asks_once: bool = False
    adapt: Mapping[type, Callable[[Any], Adapted]] = field(default_factory=dict)
    expects: Mapping[type, Expected] = field(default_factory=dict)
    shows: Callable[[Message], bool] | None = None
    frame_of_picture: Callable[[str, Iterable[str], int], str] = _no_frame
    instead: Mapping[str, Substitute] = field(default_factory=dict)
    if_asked: frozenset[str] = frozenset()
    greeting: bool = False
    stamped: bool = False
    arm_unit: str = ""
    milliseconds: bool = False

    def may_send(self, igtl_type: str) -> bool:
        """Return whether messages of this type may be sent to the peer."""
        if self.reads is None and self.queries is None and self.replies is None:
            return True
        prefix = split_query(igtl_type)
        if prefix is None and igtl_type != "RTS_COMMAND":
            return self.reads is None or igtl_type in self.reads
        allowed = self.replies if igtl_type.startswith("RTS_") else self.queries
        if allowed is None:
            allowed = self.reads
        return allowed is None or igtl_type in allowed

    def takes_without_content(self, igtl_type: str, version: int) -> bool:
        """Return whether the peer accepts a message of this type without content."""
        # a program on the C++ library waits for the default size of an empty version 1 message
        body = BODIES.get(igtl_type, Raw)
        return version > 1 or self.takes_empty or getattr(body, "MAY_BE_EMPTY", body is Raw)


def _metadata(message: Message) -> dict[str, str]:
    return {item.key: item.text for item in message.metadata}


def is_nameless_status(message: Message) -> bool:
    """Return whether a message is a STATUS without a device."""
    return not message.device_name and isinstance(message.content, Status)


def is_hello(message: Message) -> bool:
    """Return whether a message is the greeting of 3D Slicer: a STATUS without a device, whose code it never sets."""
    return bool(message.metadata) and is_nameless_status(message) and _metadata(message).get("dummy") == "dummy"


def _is_slicer(message: Message) -> bool:
    if not message.metadata:
        return False
    return is_hello(message) or "MRMLNodeName" in _metadata(message)


def _is_openigtlink4j(message: Message) -> bool:
    """Return whether a query has an interval of the form that only OpenIGTLink4J writes."""
    content = message.content
    if isinstance(content, StartTracking):
        return content.is_long
    return isinstance(content, EmptyQuery) and content.is_long and message.type.startswith("STT_")


def _is_plus(message: Message) -> bool:
    return message.type in ("TRACKEDFRAME", "USMESSAGE") or "TransformValid" in _metadata(message)


#: PLUS of an unknown release that has sent header version 1 only, or must be sent no other.
PLUS_1 = PeerProfile(
    "plus-v1",
    facts=(
        ("loses the stream at a type that its factory does not know; as a client it crashes", "§10.4; PlusLib 112a7f3"),
        ("sends header version 1 until it has received version 2", "§10.4; PlusLib 112a7f3"),
        ("version 1 does not have TransformStatus: invalid poses look like valid ones", "PlusLib 112a7f3"),
        ("reads nine components for most POLYDATA attributes", "§6.15, reproduced"),
        ("names a picture Image_Tracker: its pose is in the frame Tracker", "§10.4; PlusLib 112a7f3"),
    ),
    reads=CPP_FACTORY | {"CLIENTINFO"},
    asks_once=True,
    adapt={PolyData: _nine_components},
    frame_of_picture=frame_of_picture,
)

#: A peer that no message has shown yet.  It cannot be set: with ``default`` a peer gets all types.
UNRECOGNISED = PeerProfile(
    "unrecognised",
    facts=(
        ("programs on the C++ library lose the stream at a type that its factory does not know", "§10.4, §6.14"),
        ("they read nine components for most POLYDATA attributes", "§6.15, reproduced"),
    ),
    reads=CPP_FACTORY,
    adapt={PolyData: _nine_components},
)

DEFAULT = PeerProfile(
    "default",
    facts=(
        ("old readers interpret the extended header as content: wrong poses without an error", "§5, reproduced"),
        ("programs on the C++ library wait for the content of a message without content", "reproduced with 1.11"),
    ),
)

PROFILES: tuple[PeerProfile, ...] = (
    DEFAULT,
    PeerProfile(
        "slicer",
        facts=(
            ("sends first a version 2 STATUS without name, metadata dummy=dummy", "§10.2; SlicerOpenIGTLink#110"),
            ("pushed nodes have the metadata MRMLNodeName", "§10.2"),
            ("crashes on GET_, STT_, STP_ and on RTS_ other than of TDATA and COMMAND", "§10.1; OpenIGTLinkIO#94"),
            ("ignores an empty body: its query then expires", "§10.1, reproduced"),
            ("ignores the LPS flag; reads 32-bit integer pixels as C long", "§6.5, §10.1"),
            ("reads nine components for most POLYDATA attributes", "§6.15, reproduced"),
            ("logs an error for each message of a type without a device", "OpenIGTLinkIO d7f6aef, reproduced"),
            ("reads one point of a vertex cell, and corrupts memory at a second cell", "OpenIGTLinkIO d7f6aef"),
            ("takes every length as millimetres", "§10.2"),
            ("shows no stamp of the header, and all metadata", "SlicerOpenIGTLink#129; d090ca4"),
        ),
        reads=SLICER_READS,
        queries=frozenset(),
        replies=frozenset({"RTS_TDATA", "RTS_COMMAND"}),
        takes_empty=True,
        adapt={Image: _readable_pixels, PolyData: _surface_for_slicer},
        shows=_is_slicer,
        instead=by_type(FOR_SLICER),
        if_asked=SLICER_ASKS,
        greeting=True,
        stamped=True,
        arm_unit="mm",
    ),
    PeerProfile(
        "plus",
        facts=(
            ("loses the stream at a type that its factory does not know", "§10.4"),
            ("disconnects a silent client; answers GET_STATUS immediately", "§10.4; PLUS documents"),
            ("answers in the highest header version received", "§10.4; PlusLib#374"),
            ("sends TRANSFORM with the metadata TransformValid, custom types TRACKEDFRAME, USMESSAGE", "§10.4"),
            ("takes a pose without the metadata TransformStatus as valid, with a warning", "PlusLib 112a7f3"),
            ("asks for tracking data at its start only, and ignores a refusal", "PlusLib 112a7f3, reproduced"),
            ("reads nine components for most POLYDATA attributes", "§6.15, reproduced"),
            ("names a picture Image_Tracker: its pose is in the frame Tracker", "§10.4; PlusLib 112a7f3"),
        ),
        first_version=2,
        reads=CPP_FACTORY | {"CLIENTINFO"},
        ping_ns=NS_PER_S // 4,
        asks_once=True,
        adapt={PolyData: _nine_components},
        expects={Transform: _pose_status, Position: _position_status, TrackingData: _tool_status},
        shows=_is_plus,
        frame_of_picture=frame_of_picture,
    ),
    PLUS_1,
    PeerProfile(
        "brainlab",
        facts=(
            ("the operator must approve every connection", "PLUS documents"),
            ('sends IMAGE with an empty body for "none"', "OpenIGTLink#268"),
            ("answers the end of a stream with RTS_TDATA", "PLUS documents"),
            ("protocol version 2", "PLUS documents"),
        ),
        max_version=1,
    ),
    PeerProfile(
        "holoscan",
        facts=(
            ("its receiver throws an exception on header version 1", "holohub, openigtlink operator"),
            ("reads IMAGE only, skips other types", "holohub, openigtlink operator"),
        ),
        first_version=2,
        least_version=2,
        reads=frozenset({"IMAGE", "STATUS"}),
        queries=frozenset(),
        replies=frozenset(),
    ),
    PeerProfile(
        "legacy-v1",
        facts=(
            ("libopenigtlink up to 2.x loses the stream at a version 2 header", "§5, §10.6, reproduced with 1.11"),
            ("does not know the short forms of POSITION, COMMAND, VIDEO and metadata", "§10.6"),
        ),
        max_version=1,
    ),
    PeerProfile(
        "openigtlink4j",
        facts=(
            ("writes milliseconds in place of the fraction of a second", "OpenIGTLink4J 4cbcb31, reproduced"),
            ("writes the interval of every STT_ as i64, milliseconds", "OpenIGTLink4J 4cbcb31, reproduced"),
            ("its reader ends at a quaternion (POSITION, QTDATA), and at NDARRAY", "OpenIGTLink4J 4cbcb31, reproduced"),
            ("its reader ends at metadata in UTF-8 (header version 2)", "OpenIGTLink4J 4cbcb31, reproduced"),
            ("skips types that it does not know", "OpenIGTLink4J 4cbcb31, reproduced"),
        ),
        max_version=1,
        reads=frozenset(BODIES) - {"POSITION", "QTRANS", "QTDATA", "NDARRAY"},
        instead=by_type(FOR_OPENIGTLINK4J),
        shows=_is_openigtlink4j,
        milliseconds=True,
    ),
    PeerProfile(
        "openigtlink-rust",
        facts=(
            ("takes the first two bytes of a body for the size of an extended header", "0.4.1, reproduced"),
            ("reads the matrices of TDATA by rows", "0.4.1, reproduced"),
            ("refuses IMAGE, and ends at CAPABILITY", "0.4.1, reproduced"),
        ),
        first_version=2,
        reads=frozenset(BODIES) - {"TDATA", "IMAGE", "CAPABILITY", "CAPABIL"},
        instead=by_type(FOR_OPENIGTLINK_RUST),
    ),
)

BY_NAME = {profile.name: profile for profile in PROFILES}

#: Profiles as they were in sessions without the rules ``fitting``: 3D Slicer got all types, and arms in their unit.
_BEFORE = {
    "slicer": replace(
        BY_NAME["slicer"],
        reads=None,
        adapt={Image: _readable_pixels, PolyData: _nine_components},
        instead={},
        if_asked=frozenset(),
        stamped=False,
        arm_unit="",
    )
}


def by_rules(profile: PeerProfile, fitting: int) -> PeerProfile:
    """Return a profile by the rules of a session, see ``Config.fitting``."""
    return profile if fitting else _BEFORE.get(profile.name, profile)


_SHOWING = tuple((profile, profile.shows) for profile in PROFILES if profile.shows)


def profile_shown_by(message: Message, *, all_signs: bool = False) -> PeerProfile | None:
    """Return the profile of the only kind of peer that can send such a message; None if several can.

    Args:
        all_signs: also look for the signs of PLUS in header version 1, see ``plus_signs``.
    """
    if found := next((profile for profile, shows in _SHOWING if shows(message)), None):
        return found
    if not all_signs:
        return None
    if is_recent_plus(message):
        return BY_NAME["plus"]
    return PLUS_1 if is_any_plus(message) else None
