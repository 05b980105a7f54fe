"""Import of what 3D Slicer stores beside volumes: a linear transform becomes a TRANSFORM, markups POINT and TRAJ.

The device has the name of the file.  A transform is that of Slicer's node, from the child to its parent in RAS.  Points
keep order and labels; lines become paths from their first point to their second; curves, angles, planes and boxes are
points too, and a plane or a box with a size is also a surface (POLYDATA).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.igtl import (
    ENTRY_AND_TARGET,
    Body,
    Cells,
    Message,
    Points,
    PolyData,
    Trajectories,
    Transform,
    cut_text,
    encode,
    ns_to_ticks,
)
from igtl_gateway.addon.reading import join
from igtl_gateway.addon.terminal import by_count, counted
from igtl_gateway.addons.exchange.itk_transform import read_transform, to_parent
from igtl_gateway.addons.exchange.markups import LINE, PLANE, ROI, Markup, read_markups
from igtl_gateway.addons.exchange.sequence import DEFAULT_EPOCH_NS, no_pose
from igtl_gateway.addons.exchange.source import (
    ImportedItem,
    ImportedStream,
    NonRosSource,
    file_begin_items,
    file_end_item,
    library_errors_as_damage,
    peer_item,
)

_LINK, _DEVICE_BYTES = 1, 20
#: Most bytes of a name in POINT and TRAJ.
_NAME_BYTES = 64
#: Suffixes of files of 3D Slicer.
_SUFFIXES = (".mrk.json", ".json", ".fcsv", ".tfm", ".txt", ".mat", ".h5", ".hdf5")
_BOX = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))

Content = tuple[str, str, Body]


class SlicerFile(NonRosSource):
    """An open file; ``read`` returns its messages (type, device, content) and adds rows and notes."""

    def __init__(
        self, path: Path, epoch_ns: int | None, name: str, read: Callable[[Path, SlicerFile], list[Content]]
    ) -> None:
        super().__init__(f"{name} {path.name}", {"imported_format": name})
        self._path = path
        self._epoch_ns = DEFAULT_EPOCH_NS if epoch_ns is None else epoch_ns
        with library_errors_as_damage(path):
            self._contents = read(path, self)

    def items(self) -> Iterator[ImportedItem]:
        at_ns = self._epoch_ns
        yield from file_begin_items(self._path, at_ns, _LINK)
        for kind, device, content in self._contents:
            yield peer_item(at_ns, _LINK, join(encode(Message(kind, device, content, ns_to_ticks(at_ns)))))
        yield file_end_item(self._path, at_ns, _LINK)

    def close(self) -> None:
        """Do nothing: no file is open outside of the constructor."""


def open_transform(path: Path, epoch_ns: int | None = None) -> SlicerFile:
    """Open a file of a linear transform.  Raises DamagedRecording, UnsupportedRecording or LimitExceeded."""
    return SlicerFile(path, epoch_ns, "transform", _transform)


def open_markups(path: Path, epoch_ns: int | None = None) -> SlicerFile:
    """Open a file of markups.  Raises DamagedRecording, UnsupportedRecording or LimitExceeded."""
    return SlicerFile(path, epoch_ns, "markups", _markups)


def _transform(path: Path, source: SlicerFile) -> list[Content]:
    kind, from_parent = read_transform(path)
    rows = [*to_parent(from_parent, str(path)), [0.0, 0.0, 0.0, 1.0]]
    if why := no_pose(rows):
        raise DamagedRecording(f"{path}: found a matrix ({why}), expected that of a pose")
    device = _device(path, source)
    source.rows.append(ImportedStream(device, 1, "TRANSFORM", taken=1))
    source.notes.append(f"{kind}: the transform from the node to its parent in RAS, which 3D Slicer shows")
    return [("TRANSFORM", device, Transform.from_rows(rows))]


def _markups(path: Path, source: SlicerFile) -> list[Content]:
    markups, contents = read_markups(path), []
    name = _device(path, source)
    for number, markup in enumerate(markups, 1):
        device = name if len(markups) == 1 else f"{cut_text(name, _DEVICE_BYTES - len(str(number)))}{number}"
        if long := sum(len(label.encode()) > _NAME_BYTES for label in markup.labels):
            source.notes.append(
                f"{device}: {counted(long, 'label')} {by_count(long, 'is', 'are')} cut to {_NAME_BYTES} bytes, "
                "which is the most that POINT has"
            )
        if not markup.has_space:
            source.notes.append(f"{device}: the file states no coordinate system: LPS, as in 3D Slicer")
        kind, content = content_of(markup)
        row = ImportedStream(device, 1, kind, taken=1)
        if markup.undefined:
            points = counted(markup.undefined, "control point")
            row.why = f"without {points} that {by_count(markup.undefined, 'has', 'have')} no position"
        source.rows.append(row)
        contents.append((kind, device, content))
        if markup.corners:
            source.rows.append(ImportedStream(device, 1, "POLYDATA", taken=1))
            contents.append(("POLYDATA", device, _surface(markup)))
        elif markup.kind in (PLANE, ROI):
            source.notes.append(
                f"{device}: the {markup.kind} has no size around its centre: only its points are imported"
            )
    if not markups:
        raise UnsupportedRecording(f"{path}: found no markups, expected some")
    return contents


def content_of(markup: Markup) -> tuple[str, Body]:
    """Return markups as type and content of a message."""
    positions = np.array(markup.points, float).reshape(-1, 3)
    if markup.kind == LINE and len(positions) == 2:
        path = np.zeros(1, Trajectories.DTYPE)
        path["name"], path["group"] = _named(markup.labels[:1])[0], markup.kind.encode()
        path["type"], path["rgba"] = ENTRY_AND_TARGET, markup.rgba
        path["entry"], path["target"] = positions
        return "TRAJ", Trajectories(path)
    points = Points.of(positions, np.tile(np.array(markup.rgba, np.uint8), (len(positions), 1)))
    points.elements["name"] = _named(markup.labels)
    points.elements["group"] = markup.kind.encode()
    return "POINT", points


def _named(labels: list[str]) -> list[bytes]:
    return [cut_text(label, _NAME_BYTES).encode("utf-8", "surrogateescape") for label in labels]


def _surface(markup: Markup) -> PolyData:
    points = np.array(markup.corners, np.float32)
    faces = Cells.of(np.array(_BOX if markup.kind == ROI else [(0, 1, 2, 3)]))
    return PolyData(points, polygons=faces)


def _device(path: Path, source: SlicerFile) -> str:
    name = next((path.name[: -len(end)] for end in _SUFFIXES if path.name.lower().endswith(end)), path.stem)
    device = cut_text(name, _DEVICE_BYTES)
    if device != name:
        source.notes.append(f"{name}: shortened to {device}, because a device name has at most 20 bytes")
    return device
