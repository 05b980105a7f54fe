"""Synthetic sessions for the tests of the review: messages as entries, and clouds of known surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from igtl_gateway.addons.review.model import Array
from igtl_gateway.addons.review.scene import DepthCloud
from igtl_gateway.convert.rosmsg import Header, Marker, PointCloud2, PointField, RosMessage, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind

CAMERA = "camera"
SECOND = 1_000_000_000
_XYZ = tuple(PointField(name, 4 * i, 7) for i, name in enumerate("xyz"))


def entry(topic: str, message: RosMessage, stamp_ns: int, kind: Kind = Kind.ROS_IN) -> Entry:
    return Entry(stamp_ns, stamp_ns, kind, topic, message.TYPE, (message.pack(),))


def cloud_message(points: Array, stamp_ns: int, frame: str = CAMERA) -> PointCloud2:
    height, width, _ = points.shape
    data = points.astype("<f4").tobytes()
    return PointCloud2(Header(stamp_ns, frame), height, width, _XYZ, False, 12, 12 * width, data, False)


def plan_message(first: Array, last: Array, stamp_ns: int, frame: str = CAMERA) -> Marker:
    points = np.stack([first, last], 1).reshape(-1, 3)
    return Marker(Header(stamp_ns, frame), "plan", 0, Marker.LINE_LIST, points=points)


def pose_message(parent: str, child: str, position: Sequence[float], stamp_ns: int) -> TransformStamped:
    x, y, z = position
    return TransformStamped(Header(stamp_ns, parent), child, (x, y, z), (0.0, 0.0, 0.0, 1.0))


def xyz(point: Array) -> tuple[float, float, float]:
    x, y, z = point.tolist()
    return x, y, z


def rays(height: int = 60, width: int = 80, focal_px: float = 700.0) -> Array:
    """Return (height, width, 3) rays of a pinhole camera, z = 1."""
    u, v = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    return np.stack([u / focal_px, v / focal_px, np.ones_like(u)], -1)


def dome(directions: Array, radius: float = 0.02, top: float = 0.25) -> Array:
    """Return the true depth of a sphere of tissue in front of the camera, on rays."""
    centre = top + radius
    square = (directions**2).sum(axis=-1)
    return np.asarray((centre - np.sqrt(centre**2 - square * (centre**2 - radius**2))) / square)


def on_dome(x_mm: float, y_mm: float, radius: float = 0.02, top: float = 0.25) -> Array:
    """Return the point of the sphere at these x and y."""
    x, y = x_mm / 1000, y_mm / 1000
    return np.array([x, y, top + radius - np.sqrt(radius**2 - x**2 - y**2)])


def dome_clouds(number: int, sigma: float = 0.0002, seed: int = 1) -> list[DepthCloud]:
    """Return clouds of the sphere with white depth noise."""
    noise = np.random.default_rng(seed)
    directions = rays()
    clouds = []
    for count in range(number):
        depth = dome(directions) + sigma * noise.standard_normal(directions.shape[:2])
        stamp_ns = (count + 1) * SECOND
        clouds.append(DepthCloud("/cloud", CAMERA, stamp_ns, stamp_ns, directions * depth[..., None]))
    return clouds
