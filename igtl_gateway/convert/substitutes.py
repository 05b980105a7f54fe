"""What 3D Slicer gets in place of a type that its connector does not read, as rows of a table with reasons.

The connector has no device for such a type and writes an error into Slicer's log for each message of it
(OpenIGTLinkIO d7f6aef, its device factory).  A row names what shows the same there, or why nothing does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from igtl_gateway.convert.poses import rotation_matrix, unit_quaternion
from igtl_gateway.wire import Raw
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.fields import decode_text, visible
from igtl_gateway.wire.polydata import F4, SCALAR, Attribute, Cells, PolyData
from igtl_gateway.wire.registry import read_child
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.trajectory import ENTRY_ONLY, TARGET_ONLY, Trajectories
from igtl_gateway.wire.transform import Position, Transform


class Shown(NamedTuple):
    """A message in place of another one: its type, its full device name, its content."""

    igtl_type: str
    name: str
    content: Body


#: Device name and content → what is shown in its place.  Raises ConversionError and WireError.
Show = Callable[[str, Any], Iterable[Shown]]


@dataclass(frozen=True, slots=True)
class Substitute:
    """A row of the table.

    Attributes:
        types: OpenIGTLink types; ``*``: all that have no row.
        shown_as: what is sent, for people; "": nothing.
        why: the reason, for people.
        show: makes the messages; None: there are none.
    """

    types: tuple[str, ...]
    shown_as: str
    why: str
    show: Show | None = None

    def instead(self, name: str, content: Body) -> list[Shown]:
        """Return what is sent in place of a message; nothing for one without content.

        Raises:
            ConversionError: a quaternion without a length.
            WireError: a child of a BIND that cannot be decoded.
        """
        return [] if self.show is None or isinstance(content, Raw) else list(self.show(name, content))


def _pose(name: str, content: Position) -> Iterator[Shown]:
    yield Shown("TRANSFORM", name, _transform(content.position, content.quaternion))


def _tools(_name: str, content: TrackingData | QuaternionTrackingData) -> Iterator[Shown]:
    """Yield the pose of each tool with its name; of tools of one name the first, as for TDATA in Slicer."""
    elements = content.elements
    seen: set[str] = set()
    for element in elements:
        tool = visible(decode_text(bytes(element["name"])))
        if tool and tool not in seen:
            seen.add(tool)
            if isinstance(content, TrackingData):
                yield Shown("TRANSFORM", tool, Transform(tuple(element["matrix"].tolist())))
            else:
                position, quaternion = element["position"].tolist(), element["quaternion"].tolist()
                yield Shown("TRANSFORM", tool, _transform(position, quaternion))


def _transform(position: Iterable[float], quaternion: Any) -> Transform:
    rows = rotation_matrix(unit_quaternion(quaternion))
    return Transform((*(rows[row][column] for column in range(3) for row in range(3)), *position))


def _lines(name: str, content: Trajectories) -> Iterator[Shown]:
    """Yield one model: a line from each entry to its target; what has one of the two is a line to itself."""
    elements = content.elements
    ends = np.stack([elements["entry"], elements["target"]], axis=1).astype(F4)  # (n, 2, 3)
    for end, other in ((ENTRY_ONLY, 0), (TARGET_ONLY, 1)):
        single = elements["type"] == end
        ends[single, 1 - other] = ends[single, other]
    drawn = np.isfinite(ends).all(axis=(1, 2))
    points = ends[drawn].reshape(-1, 3)
    rgba = elements["rgba"][drawn] / 255.0
    rgba[~rgba.any(axis=1)] = _GREY
    # of the points, as scalars: the reader of the C++ library takes no other colours as they are
    colours = Attribute.of(SCALAR, "RGBA", np.repeat(rgba, 2, axis=0))
    lines = Cells.of(np.arange(len(points)).reshape(-1, 2))
    yield Shown("POLYDATA", name, PolyData(points, lines=lines, attributes=(colours,) if len(points) else ()))


#: Colour of a trajectory without one: all 0 does not mean that it is invisible.
_GREY = (0.7, 0.7, 0.7, 1.0)


def _children(name: str, content: Bind) -> Iterator[Shown]:
    for child in content.children:
        yield Shown(visible(child.type), visible(child.name) or name, read_child(child))


#: The types that the connector of 3D Slicer reads, and those that it is sent if it has asked for them.
SLICER_READS = frozenset("COMMAND IMAGE IMGMETA LBMETA POINT POLYDATA STATUS STRING TRANSFORM".split())
SLICER_ASKS = frozenset({"TDATA"})

#: What 3D Slicer gets of all other types.
FOR_SLICER: tuple[Substitute, ...] = (
    Substitute(("POSITION", "QTRANS"), "TRANSFORM", "a pose is a linear transform there", _pose),
    Substitute(
        ("TDATA",),
        "TRANSFORM of each tool",
        "a tool of TDATA is the identity there until a second message names it; TDATA if it has asked for it",
        _tools,
    ),
    Substitute(
        ("QTDATA",),
        "TRANSFORM of each tool",
        "a tool is a linear transform there; as TDATA it could crash connectors before July 2025",
        _tools,
    ),
    Substitute(
        ("TRAJ",),
        "POLYDATA with a line from each entry to its target",
        "a plan is a model there; OpenIGTLink has no line markups",
        _lines,
    ),
    Substitute(("BIND",), "each child, as if it were sent alone", "the connector does not open a BIND", _children),
    Substitute(
        ("NDARRAY", "SENSOR"),
        "",
        "a node of Slicer for numbers does not exist; as text, joint states would be hundreds of nodes a second "
        "to draw, without units or names; what moves comes as TRANSFORM",
    ),
    Substitute(("COLORT", "COLORTABLE"), "", "the connector has no node for colour tables"),
    Substitute(
        ("VIDEO", "VIDEOMETA"),
        "",
        "the published extension is built without decoders (SlicerOpenIGTLink_USE_VP9 is off); send the IMAGE",
    ),
    Substitute(("*",), "", "it has no device for this type"),
)

#: What OpenIGTLink4J gets of the types whose text form ends its reader.
FOR_OPENIGTLINK4J: tuple[Substitute, ...] = (
    Substitute(("POSITION", "QTRANS"), "TRANSFORM", "its reader ends at a POSITION", _pose),
    Substitute(("QTDATA",), "TRANSFORM of each tool", "its reader ends at a quaternion", _tools),
    Substitute(("NDARRAY",), "", "its reader ends at an NDARRAY"),
)

#: What openigtlink-rust gets of the types that it reads otherwise.
FOR_OPENIGTLINK_RUST: tuple[Substitute, ...] = (
    Substitute(("TDATA",), "TRANSFORM of each tool", "it reads the matrices by rows", _tools),
    Substitute(("IMAGE",), "", "it takes the fields of the sub-volume for pixels"),
    Substitute(("CAPABILITY", "CAPABIL"), "", "it ends at the list"),
)


def by_type(rows: Iterable[Substitute]) -> Mapping[str, Substitute]:
    """Return type → row."""
    return {igtl_type: row for row in rows for igtl_type in row.types}


def row_for(rows: Mapping[str, Substitute], igtl_type: str) -> Substitute | None:
    """Return the row of a type; None in an empty table."""
    return rows.get(igtl_type) or rows.get("*")
