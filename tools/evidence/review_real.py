"""How `review` judges points with planted errors on clouds of real cameras: the table of docs/evidence/review.md.

    python tools/evidence/review_real.py --pcd frame1.pcd frame2.pcd frame3.pcd
    python tools/evidence/review_real.py --bag jsk_watercan.bag --camera left_camera_optical_frame

Several files are successive frames of one camera.  In each of the flattest areas of a cloud, a plane is fitted to the
readings within --reference-mm.  One point of the plane is judged unchanged, and moved along its ray by the errors of
--errors-mm, by the rules for distance and noise.  *Missed* is a moved point with the level ok.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addons.review import Level, Thresholds, judge
from igtl_gateway.addons.review.model import Array, EndReview
from igtl_gateway.addons.review.scene import DepthCloud, DepthScene
from igtl_gateway.addons.review.surface import fit

_MM = 1000.0
_CANDIDATES, _LEAST, _APART_M = 3000, 150, 0.008
_STEEPEST = 2.0  # 1 / cosine between ray and normal: 60°
_CLIP = 3.5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--pcd", type=Path, nargs="+", help="files of the Point Cloud Library, z forward")
    source.add_argument("--bag", type=Path, help="ROS 1 or ROS 2 bag with a PointCloud2")
    parser.add_argument("--camera", default="", help="with --bag: optical frame of the camera, found by /tf")
    parser.add_argument("--areas", type=int, default=40)
    parser.add_argument("--reference-mm", type=float, default=25.0, help="radius of the reference (default: 25)")
    parser.add_argument("--errors-mm", type=float, nargs="+", default=[2, 4, 8], help="planted errors (default: 2 4 8)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    clouds = [*map(pcd, options.pcd)] if options.pcd else [from_bag(options.bag, options.camera)]
    scene = DepthScene.of([DepthCloud("/cloud", "camera_optical", i + 1, i + 1, each) for i, each in enumerate(clouds)])
    areas = flat_areas(scene, options.reference_mm / _MM, options.areas, np.random.default_rng(options.seed))
    print(row(scene, areas, options.errors_mm))
    return 0 if areas else 1


def row(scene: DepthScene, areas: list[tuple[Array, float]], errors_mm: list[float]) -> str:
    """Return the row of the table."""
    if not areas:
        return "found no flat area"
    limits = Thresholds()
    unmoved = [end_of(scene, point, limits) for point, _ in areas]
    known = [end for end in unmoved if end.distance_mm is not None and end.error_mm]
    ratios = np.array([(end.distance_mm or 0.0) / (end.error_mm or 1.0) for end in known])
    noise = [end.noise_mm for end in unmoved if end.noise_mm is not None]
    middle = float(np.median([point[2] for point, _ in areas]))
    cells = [
        f"{middle:.2f} m",
        f"{float(scene.steps.at(np.array(middle))) * _MM:.1f} mm",
        f"{np.median(noise):.1f} mm" if noise else "unknown",
        f"{np.median([flat for _, flat in areas]) * _MM:.1f} mm",
        f"{np.sqrt(np.mean(ratios**2)):.1f}",
        f"{np.mean(np.abs(ratios) <= 1.96):.0%}",
        levels(unmoved, limits),
    ]
    for error_mm in errors_mm:
        moved = [
            end_of(scene, point * (1 + side * error_mm / _MM / point[2]), limits)
            for point, _ in areas
            for side in (-1, 1)
        ]
        cells.append(levels(moved, limits))
    return f"| {' | '.join(cells)} | {len(areas)} |"


def levels(ends: list[EndReview], limits: Thresholds) -> str:
    """Return the number of points with each level: wrong / look / ok."""
    found = [judge.worst_level([*judge.of_end("point", end, limits)])[0] for end in ends]
    return " / ".join(str(found.count(level)) for level in (Level.WRONG, Level.LOOK, Level.OK))


def end_of(scene: DepthScene, point: Array, limits: Thresholds) -> EndReview:
    """Return distance, error and noise of a point, in optical axes."""
    x, y, z = point.tolist()
    place = scene.around(point[:2] / z, limits.place_mm / _MM / z)
    noise = scene.spatial if scene.temporal is None else scene.temporal
    found = noise[place] if noise is not None and len(place) else np.zeros(0)
    found = found[np.isfinite(found)]
    noise_mm = float(np.median(found)) * _MM if len(found) else None
    surface = fit(scene, point, limits.window_mm / _MM)
    if surface is None:
        return EndReview((x, y, z), noise_mm=noise_mm)
    slant = float(surface.slant((point[:2] / z)[None])[0])
    return EndReview(
        (x, y, z),
        distance_mm=float(surface.distance(point[None])[0]) * _MM,
        error_mm=surface.error / slant * _MM,
        noise_mm=noise_mm,
    )


def flat_areas(scene: DepthScene, radius: float, count: int, random: np.random.Generator) -> list[tuple[Array, float]]:
    """Return points (3,) of the flattest planes in optical axes, and the scatter of the readings about them, metres."""
    known = np.flatnonzero(np.isfinite(scene.depth))
    found: list[tuple[float, Array]] = []
    for pixel in random.choice(known, min(_CANDIDATES, len(known)), replace=False).tolist():
        ray, depth = scene.rays[pixel], float(scene.depth[pixel])
        around = scene.around(ray, radius / depth)
        around = around[np.isfinite(scene.depth[around])]
        if len(around) >= _LEAST and (plane := plane_at(ray, scene.rays[around], scene.depth[around], radius)):
            z, scatter = plane
            found.append((scatter, np.array([*(ray * z), z])))
    chosen: list[tuple[Array, float]] = []
    for scatter, point in sorted(found, key=lambda each: each[0]):
        if all(np.linalg.norm(point - other) > _APART_M for other, _ in chosen):
            chosen.append((point, scatter))
        if len(chosen) == count:
            break
    return chosen


def plane_at(ray: Array, rays: Array, depth: Array, radius: float) -> tuple[float, float] | None:
    """Return the depth of the plane at a ray and the scatter of the readings about it, metres; None without one."""
    middle = float(np.median(depth))
    near = np.abs(depth - middle) < 3 * radius
    sides = rays - ray
    inside = (sides[near] < 0).mean(axis=0) if near.any() else np.zeros(2)
    if near.mean() < 0.9 or (np.abs(inside - 0.5) > 0.2).any():  # an edge
        return None
    columns = np.concatenate([np.ones((len(rays), 1)), sides], axis=1)
    kept = near
    for _ in range(4):  # in 1 / z a plane is linear over the rays
        numbers, *_ = np.linalg.lstsq(columns[kept], 1 / depth[kept], rcond=None)
        off = (columns @ numbers * depth - 1) * depth
        scatter = 1.4826 * float(np.median(np.abs(off[kept])))
        kept = np.abs(off) < _CLIP * max(scatter, 1e-5)
    if kept.mean() < 0.9 or numbers[0] <= 0:
        return None
    z = 1 / float(numbers[0])
    slant = float(np.hypot(1.0, np.hypot(*numbers[1:]) * z))
    return (z, float(np.std(off[kept]))) if slant < _STEEPEST else None


def pcd(path: Path) -> Array:
    """Return the points (height, width, 3) of a PCD file, metres, NaN without a depth."""
    with path.open("rb") as stream:
        head: dict[str, list[str]] = {}
        while "DATA" not in head:
            word, *values = stream.readline().decode("ascii").split()
            head[word] = values
        data = stream.read()
    count = int(head["POINTS"][0])
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(head["TYPE"], head["SIZE"], strict=True)]
    sizes = [int(each) for each in head["COUNT"]]
    shape = int(head["HEIGHT"][0]), int(head["WIDTH"][0]), 3
    if head["DATA"] == ["ascii"]:
        points = np.loadtxt(data.decode("ascii").splitlines(), ndmin=2)[
            :, [head["FIELDS"].index(axis) for axis in "xyz"]
        ]
    elif head["DATA"] == ["binary"]:
        dtype = np.dtype([(name, kind, (size,)) for name, kind, size in zip(head["FIELDS"], kinds, sizes, strict=True)])
        table = np.frombuffer(data, dtype, count)
        points = np.stack([table[axis][:, 0] for axis in "xyz"], axis=-1)
    else:
        packed, unpacked = np.frombuffer(data, "<u4", 2).tolist()
        raw, at, columns = lzf(data[8 : 8 + packed], unpacked), 0, {}
        for name, kind, size in zip(head["FIELDS"], kinds, sizes, strict=True):
            columns[name] = np.frombuffer(raw, kind, count * size, at)
            at += count * size * np.dtype(kind).itemsize
        points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    return np.asarray(points, np.float64).reshape(shape)


def lzf(data: bytes, size: int) -> bytes:
    """Decompress LZF: literal runs, and references to what was decompressed before."""
    out, at = bytearray(), 0
    while at < len(data):
        control = data[at]
        at += 1
        if control < 32:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[at]
            at += 1
        begin = len(out) - ((control & 31) << 8) - data[at] - 1
        at += 1
        for place in range(begin, begin + length + 2):
            out.append(out[place])
    if len(out) != size:
        raise ValueError(f"found {len(out)} bytes, expected {size}")
    return bytes(out)


def from_bag(path: Path, camera: str) -> Array:
    """Return the points (height, width, 3) of the first cloud, in the camera's optical frame if it is given."""
    from rosbags.highlevel import AnyReader

    edges: dict[str, tuple[str, Array]] = {}
    cloud: Any = None
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            if connection.msgtype.endswith("PointCloud2") and cloud is None:
                cloud = reader.deserialize(raw, connection.msgtype)
            elif connection.msgtype == "tf2_msgs/msg/TFMessage":
                message: Any = reader.deserialize(raw, connection.msgtype)
                for each in message.transforms:
                    if cloud is None or each.child_frame_id not in edges:
                        edges[each.child_frame_id.lstrip("/")] = (
                            each.header.frame_id.lstrip("/"),
                            matrix(each.transform),
                        )
    if cloud is None:
        raise ValueError(f"{path}: found no PointCloud2")
    rows = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_step)
    places = {each.name: each.offset for each in cloud.fields}
    points = np.stack([rows[:, places[axis] : places[axis] + 4].copy().view("<f4")[:, 0] for axis in "xyz"], axis=-1)
    points = points.astype(np.float64)
    if camera:
        above = [chain(edges, frame) for frame in (cloud.header.frame_id.lstrip("/"), camera)]
        if above[0][0] != above[1][0]:
            raise ValueError(f"{path}: found no transform from {cloud.header.frame_id!r} to {camera!r}")
        pose = np.linalg.inv(above[1][1]) @ above[0][1]
        points = points @ pose[:3, :3].T + pose[:3, 3]
    return points.reshape(cloud.height, cloud.width, 3)


def chain(edges: dict[str, tuple[str, Array]], frame: str) -> tuple[str, Array]:
    """Return the root above a frame, and the pose (4, 4) of the frame in it."""
    pose = np.eye(4)
    for _ in edges:
        if frame not in edges:
            break
        frame, step = edges[frame]
        pose = step @ pose
    return frame, pose


def matrix(transform: Any) -> Array:
    """Return a pose (4, 4)."""
    x, y, z, w = (float(getattr(transform.rotation, axis)) for axis in "xyzw")
    pose = np.eye(4)
    pose[:3, :3] = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    pose[:3, 3] = [float(getattr(transform.translation, axis)) for axis in "xyz"]
    return pose


if __name__ == "__main__":
    sys.exit(main())
