"""The data of a session that a review needs: entries in, clouds, versions of the plan and poses out.

Streams are selected by content.  The cloud is the PointCloud2 stream with the most points; organised clouds precede
unorganised ones.  The plan is pairs of points on its tissue.  The tool is the moving frame that comes closest to the
plan.  A caller can select any of them by topic instead.

Memory is bounded: of each stream at most twice ``clouds`` clouds are kept, evenly distributed over the session.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, ConversionError, GatewayError, did_you_mean, near_streams
from igtl_gateway.addon.messages import frame_id
from igtl_gateway.addon.reading import Entry, EntryStream, Head, Heads, Kind, Rows
from igtl_gateway.addon.ros import PointCloud2
from igtl_gateway.addon.streams import StreamTimes
from igtl_gateway.addon.terminal import by_count, count_text
from igtl_gateway.addons.review.addon import NO_CLOUD, NO_PLAN
from igtl_gateway.addons.review.choices import CLOUDS
from igtl_gateway.addons.review.frames import FramePoses
from igtl_gateway.addons.review.messages import PLANS, POSES, DrawnPlan, cloud_of, is_large_cloud, plan_of, poses_of
from igtl_gateway.addons.review.pose_rows import PoseRows, pose_rows
from igtl_gateway.addons.review.scene import DepthCloud, DepthScene

Array = npt.NDArray[Any]

#: Last time that a stamp of OpenIGTLink can state, in 2106.  Later ones count as this one, so that the difference of
#: any two times of a session, also of those in ROS messages (1901 to 2038), is an integer of 64 bits.
_LAST_NS = (1 << 32) * NS_PER_S - 1
_ROS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})
_MAX_VERSIONS = 200  # of one stream
_NEAR_M = 0.03  # largest distance of a plan's points from the observed depth
_HIT_RADIUS = 0.01  # as x / z: radius around a point in which the depth is observed


@dataclass(slots=True)
class _Clouds:
    """One stream of clouds, decimated: every ``stride``-th cloud is kept."""

    limit: int
    unit_m: float
    seen: int = 0
    stride: int = 1
    kept: list[DepthCloud] = field(default_factory=list)

    def add(self, entry: Entry) -> None:
        if self.seen % self.stride == 0 and (cloud := cloud_of(entry)):
            cloud = replace(cloud, points=cloud.points * self.unit_m)
            if self.kept and (
                cloud.points.shape != self.kept[-1].points.shape or cloud.frame_id != self.kept[-1].frame_id
            ):
                self.kept.clear()  # the camera was reconfigured: its pixels have other rays
            self.kept.append(cloud)
            if len(self.kept) >= 2 * self.limit:
                del self.kept[1::2]
                self.stride *= 2
        self.seen += 1

    @property
    def rank(self) -> tuple[bool, int]:
        """Sort key: organised clouds above unorganised ones, then by the number of points."""
        height, width, _ = self.kept[-1].points.shape if self.kept else (0, 0, 0)
        return height > 1 and width > 1, height * width


class Material:
    """Collects the data for a review: ``take`` each entry of a session, then call the other methods.

    Args:
        plan: topic of the plan; "" = selected by content.
        cloud: topic of the clouds; "" = selected by content.
        tool: topic or frame id of the tool; "" = selected by content.
        clouds: maximum number of clouds to use.
        unit_m: the unit of length of the session's ROS side, in metres.

    Attributes:
        frames: the poses of all frames, metres.
        notes: notes for the reader of the review: what was left out or assumed.
    """

    def __init__(
        self, plan: str = "", cloud: str = "", tool: str = "", clouds: int = CLOUDS, unit_m: float = 1.0
    ) -> None:
        self.frames = FramePoses()
        self.notes: list[str] = []
        self._plan, self._cloud, self._tool = plan, cloud, tool
        self._limit = clouds
        self._unit_m = unit_m
        self._clouds: dict[str, _Clouds] = {}
        self._plans: dict[str, list[DrawnPlan]] = {}
        self._bad: set[str] = set()
        self._others: dict[str, set[str]] = {"cloud": set(), "plan": set()}  # topics that were not selected

    @staticmethod
    def reads(stream: EntryStream | Head) -> bool:
        """Whether entries of a stream are more than nothing to ``take``."""
        return stream.kind in _ROS and stream.type in {*POSES, *PLANS, PointCloud2.TYPE}

    def take(self, entry: Entry) -> None:
        """Read an entry; only ROS messages are used."""
        if entry.kind not in _ROS:
            return
        if entry.stamp_ns > _LAST_NS:
            entry = replace(entry, stamp_ns=_LAST_NS)
        try:
            self._read(entry)
        except ConversionError as error:
            if entry.channel not in self._bad:
                self._bad.add(entry.channel)
                self.notes.append(f"{entry.channel}: invalid messages are left out: {error}")

    def take_rows(self, rows: Rows, heads: Heads) -> None:
        """Read entries, as ``take`` does each of them; poses many at once."""
        wanted = np.array([self.reads(head) for head in heads.known], np.bool_)[rows.heads]
        are_poses = np.array([head.type in POSES for head in heads.known], np.bool_)[rows.heads] & wanted
        found = pose_rows(rows.where(are_poses), heads) if are_poses.any() else None
        if found is not None:
            wanted &= ~are_poses
            self.frames.add_rows([self._in_metres(each) for each in found])
        for entry in rows.where(wanted).entries(heads):  # others, such as pictures, become no objects
            self.take(entry)

    def _in_metres(self, found: PoseRows) -> PoseRows:
        poses = found.poses.copy()
        poses[:, :3] *= self._unit_m
        return replace(found, poses=poses, arrivals=np.minimum(found.arrivals, _LAST_NS))

    def _read(self, entry: Entry) -> None:
        if entry.type in POSES:
            for parent, child, pose, stamp_ns in poses_of(entry):
                x, y, z = (self._unit_m * value for value in pose[:3])
                self.frames.add(parent, child, (x, y, z, *pose[3:]), stamp_ns, entry.stamp_ns, entry.channel)
        elif entry.type == PointCloud2.TYPE and is_large_cloud(entry.data()):
            if not self._cloud or entry.channel == self._cloud:
                self._clouds.setdefault(entry.channel, _Clouds(self._limit, self._unit_m)).add(entry)
            else:
                self._others["cloud"].add(entry.channel)
        elif entry.type in PLANS and self._plan not in ("", entry.channel):
            self._others["plan"].add(entry.channel)
        elif entry.type in PLANS:
            versions = self._plans.setdefault(entry.channel, [])
            if len(versions) < _MAX_VERSIONS and (drawn := plan_of(entry)):
                drawn = replace(drawn, entry=drawn.entry * self._unit_m, exit=drawn.exit * self._unit_m)
                if not versions or not drawn.equals(versions[-1]):
                    versions.append(drawn)

    def scene(self) -> tuple[DepthScene, str]:
        """Return the combined clouds, and their topic.  Raises ConfigError or GatewayError without clouds."""
        streams = {topic: stream for topic, stream in self._clouds.items() if stream.kept}
        if not streams:
            if self._cloud:
                what = "found no sensor_msgs/PointCloud2 with x, y, z on this topic"
                raise ConfigError(f"--cloud {self._cloud}: {what}{_question(self._cloud, self._others['cloud'])}")
            raise GatewayError(f"{NO_CLOUD}, expected a sensor_msgs/PointCloud2 stream: see `info`, --cloud")
        topic = max(streams, key=lambda name: streams[name].rank)
        stream = streams[topic]
        clouds = stream.kept
        if len(clouds) > self._limit:
            clouds = [clouds[number * len(clouds) // self._limit] for number in range(self._limit)]
        if len(clouds) < stream.seen:
            self.notes.append(
                f"{len(clouds)} of {count_text(stream.seen, 'cloud')} of {topic} "
                f"{by_count(len(clouds), 'is', 'are')} used, evenly distributed"
            )
        return DepthScene.of(clouds), topic

    def versions(self, scene: DepthScene) -> list[DrawnPlan]:
        """Return all versions of the plan in order of time, in the frame of the clouds.

        Raises ConfigError or GatewayError without a plan.
        """
        base = scene.clouds[-1].frame_id
        streams = {topic: self._in_frame(plans, base) for topic, plans in self._plans.items()}
        unplaced = [topic for topic, plans in streams.items() if self._plans[topic] and not plans]
        streams = {topic: plans for topic, plans in streams.items() if plans}
        if not self._plan:
            streams = {topic: plans for topic, plans in streams.items() if _on_tissue(plans[0], scene)}
            if any(plans[0].lines for plans in streams.values()):
                streams = {topic: plans for topic, plans in streams.items() if plans[0].lines}
        if not streams:
            if unplaced:
                raise GatewayError(f"found no plan whose place is known: {'; '.join(self.notes)}")
            if self._plan:
                question = _question(self._plan, self._others["plan"])
                raise ConfigError(f"--plan {self._plan}: found no pairs of points on this topic{question}")
            raise GatewayError(
                f"{NO_PLAN}, expected pairs of points on the tissue (Marker LINE_LIST, TrajectoryList, "
                "PolyData, PointList, small PointCloud2): see `info`, --plan"
            )
        # a plan is drawn once and corrected rarely; a stream that changes with every message is not a plan
        topic = min(streams, key=lambda name: len(streams[name]))
        versions = list(streams.pop(topic))
        for other in sorted((plan for plans in streams.values() for plan in plans), key=lambda plan: plan.stamp_ns):
            if any(other.corrects(version) for version in versions):
                versions.append(other)
        versions.sort(key=lambda plan: plan.stamp_ns)
        kept = versions[:1]
        kept += [plan for before, plan in pairwise(versions) if not plan.equals(before)]
        return kept

    def tools(self, base: str) -> list[str]:
        """Return the frames that can be the tool: moving, connected with ``base``, and not an ancestor of it.

        Raises ConfigError if the requested tool is not one of them.
        """
        above = self.frames.above(base)
        found = {
            child: topic
            for child, topic in self.frames.moving().items()
            if child not in above and self.frames.connected(child, base)
        }
        if not self._tool:
            return list(found)
        named = [child for child, topic in found.items() if self._tool == topic or frame_id(self._tool) == child]
        if not named:
            known = ", ".join(f"{topic} ({child})" for child, topic in found.items()) or "a moving frame"
            raise ConfigError(
                f"--tool {self._tool}: found no such moving frame connected with {base!r}, expected {known}"
                + _question(self._tool, {*found, *found.values()})
            )
        return named

    def note(self, *texts: str) -> None:
        """Add notes, each once."""
        self.notes += [text for text in dict.fromkeys(texts) if text not in self.notes]

    def _in_frame(self, plans: Sequence[DrawnPlan], base: str) -> list[DrawnPlan]:
        """Return the plans of a stream transformed to the frame of the clouds; without those whose place is unknown.

        They are unchanged if the frames are not connected.
        """
        found = []
        for row, plan in enumerate(plans):
            if frame_id(plan.frame_id) == frame_id(base):
                found.append(plan)
                continue
            times = StreamTimes(
                plan.topic, np.array([each.stamp_ns for each in plans]), np.array([each.source_ns for each in plans])
            )
            try:
                placed = self.frames.transformed(plan.ends(), plan.frame_id, base, times, row)
            except ConversionError as error:
                self.note(f"{plan.topic}: used without transformation, as if in the frame of the cloud: {error}")
                found.append(plan)
                continue
            self.note(*placed.notes)
            if placed.known.all():
                entry, leave = np.split(placed.points, 2)
                found.append(replace(plan, entry=entry, exit=leave))
            else:
                self.note(f"{plan.topic}: left out where the pose of its frame {plan.frame_id!r} is not known")
        return found


def _question(name: str, names: Iterable[str]) -> str:
    """Return the question about names that are near to a wrong one, as the end of a line; "" without any."""
    question = did_you_mean(near_streams(name, names))
    return f"; {question}" if question else ""


def _on_tissue(plan: DrawnPlan, scene: DepthScene) -> bool:
    """Return whether more than half of the points are near the observed depth."""
    hits = 0
    for point in scene.axes.to_optical(plan.ends()):
        if point[2] > 0:
            depth = scene.depth[scene.around(point[:2] / point[2], _HIT_RADIUS)]
            depth = depth[np.isfinite(depth)]
            hits += bool(depth.size) and bool(abs(np.median(depth) - point[2]) < _NEAR_M)
    return hits > len(plan.entry)
