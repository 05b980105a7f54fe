"""The load of a soak: the mixed one of the bench, with content that compresses."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from igtl_gateway.convert import rosmsg
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway_lab.bench import cases, payloads
from igtl_gateway_lab.bench.cases import CASES, BenchStream

PICTURE, _CLOUD = "scan-vga", "grid-30k"


def _scan(width: int, height: int) -> payloads.Payload:
    """A picture of rings, as an ultrasonic phantom shows them: of the size of noise, but it compresses."""
    y, x = np.mgrid[:height, :width]
    rings = (np.hypot(x - width / 2, y) // 24 * 16).astype(np.uint8)
    data = np.repeat(rings.ravel(), 3).tobytes()
    return replace(
        payloads.image(width, height),
        ros=lambda header: rosmsg.Image(header, height, width, "rgb8", 0, 3 * width, data),
        content=lambda _number: Image((width, height, 1), 3, data, 3),
    )


def _grid(count: int) -> payloads.Payload:
    """A cloud of the same six hundred points, again and again."""
    index = np.arange(count) % 600
    xyz = np.column_stack([index % 30, index // 30, np.full(count, 500)]).astype(np.float64)
    fields = tuple(rosmsg.PointField(name, 4 * axis, 7, 1) for axis, name in enumerate("xyz"))
    data = (xyz / 1000).astype("<f4").tobytes()
    vertices = Cells(1, np.array([count, *range(count)], ">u4"))
    return replace(
        payloads.cloud(count),
        ros=lambda header: rosmsg.PointCloud2(header, 1, count, fields, False, 12, len(data), data, True),
        content=lambda _number: PolyData(xyz.astype(">f4"), vertices),
    )


def know_payloads() -> None:
    """Have the programs of the measurement know them, too; in this process."""
    cases.PAYLOADS |= {PICTURE: partial(_scan, 640, 480), _CLOUD: partial(_grid, 30_000)}


def streams(scale: float) -> tuple[BenchStream, ...]:
    """The mixed load, at ``scale`` times its rates."""
    kinds = {"image-vga": PICTURE, "cloud-30k": _CLOUD}
    return tuple(
        replace(stream, kind=kinds.get(stream.kind, stream.kind), rate_hz=scale * stream.rate_hz)
        for stream in CASES["mixed"].streams
    )
