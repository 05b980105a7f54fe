"""Tools and frames: axes with trails, and the transform tree."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from igtl_gateway.addon.messages import frames_of_name
from igtl_gateway.addon.ros import PoseArray, PoseStamped, TFMessage, TrackingData, TransformStamped
from igtl_gateway.addons.view.canvas import Canvas


def draw_transform(message: TransformStamped, canvas: Canvas) -> None:
    """geometry_msgs/TransformStamped: a tool at the path of the topic, and its frame in the tree."""
    frame = canvas.frame(message.header.frame_id)
    _tool((*message.translation, *message.rotation), frame, canvas, "", message.child_frame_id)


def draw_pose(message: PoseStamped, canvas: Canvas) -> None:
    """geometry_msgs/PoseStamped."""
    _tool(message.pose, canvas.frame(message.header.frame_id), canvas)


def draw_poses(message: PoseArray, canvas: Canvas) -> None:
    """geometry_msgs/PoseArray: tools 1, 2, …"""
    frame = canvas.frame(message.header.frame_id)
    for number, pose in enumerate(message.poses.tolist(), 1):
        _tool(pose, frame, canvas, str(number))


def draw_tracking(message: TrackingData, canvas: Canvas) -> None:
    """igtl_msgs/TrackingData: each tool under its name; one that is named ``AToB`` is in B, as on /tf."""
    frame = canvas.frame(message.header.frame_id)
    for tool in message.tools:
        _tool(tool.pose, canvas.frame(frames_of_name(tool.name, frame)[0]), canvas, canvas.part(tool.name))


def draw_tf(message: TFMessage, canvas: Canvas) -> None:
    """tf2_msgs/TFMessage: edges of the transform tree."""
    for each in message.transforms:
        frame = canvas.frame(each.header.frame_id)
        if canvas.is_pose(each.pose):
            canvas.link(each.child_frame_id, frame, each.pose, static=canvas.shown.topic == "/tf_static")


def _tool(pose: Sequence[Any], frame: str, canvas: Canvas, child: str = "", child_frame: str = "") -> None:
    if not canvas.is_pose(pose):
        canvas.text_once(f"{child or 'tool'}: found {tuple(pose)}, expected a pose", f"place {child}")
        return
    canvas.tool(pose, frame, child, labelled=not child_frame)
    canvas.extend_box(pose[:3])
    if child_frame:
        canvas.link(child_frame, frame, pose)
