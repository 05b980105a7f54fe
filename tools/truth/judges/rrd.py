"""Recordings of rerun by its own reader: the rows of every entity, in metres."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tools.truth import world
from tools.truth.judges.samples import Sample, posed, ros_picture

_LEFT_OUT = ("/plots/", "/session", "/places/")


def by_rerun(path: Path) -> Iterator[Sample]:
    """All samples of a file; the time lines are ``sender_time`` and ``gateway_time``."""
    from rerun.chunk import RrdReader

    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    curves: dict[str, list[str]] = {}
    for chunk in RrdReader(str(path)).store().stream():
        entity = chunk.entity_path
        if entity.startswith(_LEFT_OUT) or entity.endswith("/trail"):
            continue
        for row in chunk.to_record_batch().to_pylist():
            if row.get("SeriesLines:names"):
                curves[entity] = row["SeriesLines:names"]
            rows[entity].append(row)
    for entity, found in rows.items():
        for row in found:
            yield from _of_row(entity, row, curves.get(entity, []))


def stated_in(path: Path) -> str:
    """The lines of the log that a viewer shows beside the views."""
    from rerun.chunk import RrdReader

    lines = []
    for chunk in RrdReader(str(path)).store().stream():
        batch = chunk.to_record_batch()
        if "TextLog:text" in batch.schema.names:
            lines += [
                f"{chunk.entity_path} {row['TextLog:text'][0]}" for row in batch.to_pylist() if row["TextLog:text"]
            ]
    return "\n".join(lines)


def _ns(value: Any) -> int:
    return 0 if value is None else int(getattr(value, "value", value))


def _of_row(entity: str, row: dict[str, Any], curves: list[str]) -> Iterator[Sample]:
    times = {"source_ns": _ns(row.get("sender_time")), "time_ns": _ns(row.get("gateway_time"))}

    def sample(kind: str, value: Any, name: str | None = "") -> Sample:
        return Sample(entity, name, kind, value, **times)

    if place := row.get("Transform3D:translation"):
        place_mm = np.array(place[0], float) * 1000
        if entity.endswith("/camera"):
            yield sample("static", place_mm)
        elif turn := row.get("Transform3D:quaternion"):
            yield sample("pose", posed(place_mm, turn[0]), None if re.search(r"/poses/\d+$", entity) else "")
    elif points := row.get("Points3D:positions"):
        labels = row.get("Points3D:labels")
        if labels:
            for label, point in zip(labels, points, strict=True):
                yield sample("plan", np.array(point) * 1000, label)
        elif len(points) == world.POINTS:
            yield sample("cloud", np.array(points, float) * 1000)
    elif points := row.get("Mesh3D:vertex_positions"):
        if len(points) == world.POINTS:
            yield sample("cloud", np.array(points, float) * 1000)
    elif buffer := row.get("Image:buffer") or row.get("DepthImage:buffer"):
        data = bytes(bytearray(buffer[0]))
        depth = len(data) != world.WIDTH * world.HEIGHT
        size = (world.DEPTH_HEIGHT, world.DEPTH_WIDTH) if depth else (world.HEIGHT, world.WIDTH)
        found = ros_picture("16UC1" if depth else "mono8", *size, data)
        if found:
            yield sample(*found)
    elif (values := row.get("Scalars:scalars")) and curves:
        for number, value in enumerate(values):
            # a curve without a name, or with that of another one, is what is judged here
            name = curves[number].split(" ")[0] if number < len(curves) else ""
            if value is not None and np.isfinite(value):
                yield sample("joint", value, name)
    elif text := row.get("TextDocument:text"):
        if text[0].startswith("at "):
            yield sample("text", text[0])
