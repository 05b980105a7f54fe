"""The Python API as its users have it: arrays of numpy, with the units and clocks that they state."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import igtl_gateway
from igtl_gateway.base.errors import ConfigError, GatewayError
from tools.truth import world
from tools.truth.judges.samples import Sample

Frames = Iterator[tuple[Sample, list[Sample]]]
_POSES = ("TRANSFORM", "PoseStamped", "TransformStamped")
_TO_MM = {"mm": 1.0, "m": 1000.0}


def key_of(keys: Sequence[str], stream: str) -> str:
    """The key of a stream of a world in a recording, in a merged one or a bag that of its ROS form; or ""."""
    device = re.escape(stream.partition("/")[2])
    forms = [
        rf"(in:)?{re.escape(stream)}",
        rf"/[ab]{re.escape(stream)}",
        rf"(/[ab])?/igtl/in/{device}/(transform|image)",
    ]
    return next((key for form in forms for key in keys if re.fullmatch(form, key)), "")


def of_streams(recording: Any) -> Iterator[Sample]:
    """Poses, pictures and clouds of all streams."""
    for key, stream in recording.items():
        kind = stream.type.rpartition("/")[2]
        if kind in ("TRANSFORM", "PoseStamped", "TransformStamped"):
            yield from of_poses(stream, key, stream.poses())
        elif kind in ("TDATA", "TFMessage"):
            for name in _frames_of(stream):
                poses = stream.poses(frame=name)
                yield from of_poses(stream, key, poses, name)
        elif kind in ("IMAGE", "Image"):
            for view in stream.images():
                yield from _picture(key, view)
        elif kind in ("PointCloud2", "POLYDATA"):
            for view in stream.points():
                if len(view.xyz) == world.POINTS:
                    points = np.asarray(view.xyz, float) * _TO_MM[view.unit]
                    yield Sample(key, "", "cloud", points, time_ns=int(view.time))


def _frames_of(stream: Any) -> list[str]:
    """The names of the tools or child frames of a stream, from its messages."""
    names: dict[str, None] = {}
    for message in stream:
        content = message.content
        for each in getattr(content, "transforms", None) or getattr(content, "tools", None) or ():
            names[getattr(each, "child_frame_id", "") or each.name] = None
        if hasattr(content, "elements"):
            names.update((bytes(each["name"]).decode().rstrip("\0"), None) for each in content.elements)
    return [name for name in names if name]


def of_poses(stream: Any, key: str, poses: Any, name: str | None = None) -> Iterator[Sample]:
    """Poses with their three clocks."""
    named = poses.child if name is None else name
    scale = _TO_MM[poses.unit]
    for matrix, time_ns, source_ns, stamp_ns in zip(
        poses.matrices, poses.times, poses.source_times, poses.stamps, strict=True
    ):
        found = np.array(matrix, float)
        found[:3, 3] *= scale
        times = {"source_ns": int(source_ns), "stamp_ns": int(stamp_ns), "time_ns": int(time_ns)}
        if named == "camera":
            yield Sample(key, named, "static", found[:3, 3], **times)
        else:
            yield Sample(key, named, "pose", found, **times)


def _picture(key: str, view: Any) -> Iterator[Sample]:
    pixels = np.asarray(view.plane)
    if pixels.dtype == np.uint16:
        yield Sample(key, "", "depth", pixels, time_ns=int(view.time))
        return
    pixels = np.squeeze(pixels)
    if key.rpartition(":")[2].startswith("IMAGE/"):
        found = np.asarray(view.matrix, float)
        found = found[:3] * _TO_MM[view.unit] if np.abs(found[:3, 3]).max() < 1 else found[:3]
        if np.abs(found - world.placement()).max() > 0.01:
            pixels = np.zeros_like(pixels)
    yield Sample(key, "", "picture", pixels, time_ns=int(view.time))


def aligned(recording: Any, on: Any, clock: Any, method: Any, tolerance_s: float) -> Frames:
    """Poses of all streams at the times of pictures.  Raises GatewayError."""
    streams = [
        stream
        for key, stream in recording.items()
        # the ROS form of a TRANSFORM is a second sample of it
        if not (
            stream.type.count("/") == 2
            and "/igtl/in/" in key
            and any(each.startswith("TRANSFORM/") for each in recording)
        )
        if stream.type.rpartition("/")[2] in _POSES and not key.startswith("out:")
    ]
    table = igtl_gateway.align([on, *streams], on=on, clock=clock, method=method, tolerance=tolerance_s)
    views = on.images()
    found = {stream.key: table.poses(stream.key) for stream in streams}
    for number in range(len(table)):
        row = int(table[on.key].rows[number])
        others = []
        for key, poses in found.items():
            matrix = np.array(poses.matrices[number], float)
            if np.isfinite(matrix).all():
                matrix[:3, 3] *= _TO_MM[poses.unit]
                others.append(Sample(key, "", "pose", matrix, frame=number))
        yield Sample(on.key, "", "picture", np.squeeze(np.asarray(views[row].plane)), frame=number), others


def looked_up(recording: Any, on: Any) -> Frames:
    """Frames of tf at pictures, as the docstring of ``lookup`` does it."""
    edges = [(edge.parent, edge.child) for edge in recording.tf.edges]
    found = {}
    for parent, child in edges:
        try:
            found[child] = recording.tf.lookup(parent, child, on, unit="mm", out_of_range="nan")
        except (ConfigError, GatewayError):
            continue
    for number, view in enumerate(on.images()):
        others = []
        for child, matrices in found.items():
            if np.isfinite(matrices[number]).all():
                value = matrices[number]
                static = child == "camera"
                kind = "static" if static else "pose"
                others.append(Sample("tf", child, kind, value[:3, 3] if static else value, frame=number))
        yield Sample(on.key, "", "picture", np.squeeze(np.asarray(view.plane)), frame=number), others
