"""The table of drawings: how each ROS type is drawn.

A new drawing needs one row here.  A type without a row is logged once in the log of the session, and its messages are
rows without a drawing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from igtl_gateway.addon import Buffer
from igtl_gateway.addons.view import clouds, markers, numbers, other_msgs, pictures2d, poses, surfaces, volumes, words
from igtl_gateway.addons.view.canvas import Canvas
from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.convert import common_msgs, igtl_msgs, rosmsg
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS


class Readable(Protocol):
    """What a row needs of its message class."""

    TYPE: str

    @classmethod
    def unpack(cls, cdr: Buffer) -> Any: ...


@dataclass(frozen=True, slots=True)
class Picture:
    """One ROS type.

    Attributes:
        message: class of the message.
        what: kind; some functions refine it by the first message.
        draw: draws a message.
        fullness: of the messages converted from one OpenIGTLink message, 3-D views show the one with the highest.
    """

    message: Any
    what: EntityKind
    draw: Callable[[Any, Canvas], None]
    fullness: int = 0


_ROWS = (
    Picture(rosmsg.PointCloud2, EntityKind.CLOUD, clouds.draw_cloud, 2),
    Picture(rosmsg.PointStamped, EntityKind.POINTS, clouds.draw_point, 1),
    Picture(igtl_msgs.PointList, EntityKind.POINTS, clouds.draw_point_list, 3),
    Picture(rosmsg.TransformStamped, EntityKind.POSE, poses.draw_transform),
    Picture(common_msgs.PoseStamped, EntityKind.POSE, poses.draw_pose),
    Picture(common_msgs.PoseArray, EntityKind.POSES, poses.draw_poses, 1),
    Picture(igtl_msgs.TrackingData, EntityKind.POSES, poses.draw_tracking, 3),
    Picture(common_msgs.TFMessage, EntityKind.FRAMES, poses.draw_tf),
    Picture(rosmsg.Image, EntityKind.IMAGE, pictures2d.draw_image, 1),
    Picture(common_msgs.CompressedImage, EntityKind.VIDEO, pictures2d.draw_compressed_image, 1),
    Picture(common_msgs.CompressedVideo, EntityKind.VIDEO, pictures2d.draw_compressed_video, 2),
    Picture(igtl_msgs.VideoFrame, EntityKind.VIDEO, pictures2d.draw_video_frame, 3),
    Picture(common_msgs.CameraInfo, EntityKind.CAMERA, pictures2d.draw_camera),
    Picture(igtl_msgs.Volume, EntityKind.VOLUME, volumes.draw_volume, 2),
    Picture(igtl_msgs.ColorTable, EntityKind.IMAGE, pictures2d.draw_color_table),
    Picture(rosmsg.Mesh, EntityKind.MESH, surfaces.draw_mesh, 2),
    Picture(rosmsg.Marker, EntityKind.MARKERS, surfaces.draw_marker, 1),
    Picture(markers.MarkerArray, EntityKind.MARKERS, surfaces.draw_marker_array),
    Picture(igtl_msgs.PolyData, EntityKind.MESH, surfaces.draw_polydata, 3),
    Picture(igtl_msgs.TrajectoryList, EntityKind.LINES, surfaces.draw_trajectories, 3),
    Picture(other_msgs.Path, EntityKind.LINES, surfaces.draw_path),
    Picture(common_msgs.JointState, EntityKind.PLOT, numbers.draw_joints),
    Picture(igtl_msgs.Sensor, EntityKind.PLOT, numbers.draw_sensor),
    Picture(other_msgs.Float64, EntityKind.PLOT, numbers.draw_number),
    Picture(common_msgs.WrenchStamped, EntityKind.PLOT, numbers.draw_wrench),
    Picture(common_msgs.TwistStamped, EntityKind.PLOT, numbers.draw_twist),
    Picture(common_msgs.Joy, EntityKind.PLOT, numbers.draw_buttons),
    Picture(common_msgs.OperatingState, EntityKind.TEXT, words.draw_state),
    Picture(common_msgs.StringStamped, EntityKind.TEXT, words.draw_stamped_string),
    Picture(common_msgs.Empty, EntityKind.TEXT, words.draw_empty),
    Picture(igtl_msgs.NdArray, EntityKind.PLOT, numbers.draw_array),
    *(Picture(message, EntityKind.PLOT, numbers.draw_multi_array) for message in MULTI_ARRAYS.values()),
    Picture(rosmsg.String, EntityKind.TEXT, words.draw_string),
    Picture(rosmsg.DiagnosticStatus, EntityKind.TEXT, words.draw_status),
    Picture(common_msgs.Log, EntityKind.TEXT, words.draw_log),
    Picture(igtl_msgs.Command, EntityKind.TEXT, words.draw_command),
    Picture(igtl_msgs.CommandReply, EntityKind.TEXT, words.draw_reply),
    Picture(igtl_msgs.Query, EntityKind.TEXT, words.draw_query),
    Picture(igtl_msgs.Metadata, EntityKind.TEXT, words.draw_metadata),
    Picture(igtl_msgs.Capability, EntityKind.TEXT, words.draw_capability),
    Picture(igtl_msgs.LinkStatusList, EntityKind.TEXT, words.draw_links),
    Picture(igtl_msgs.Bind, EntityKind.TEXT, words.draw_bind),
    Picture(igtl_msgs.ImageMetaList, EntityKind.TEXT, words.draw_images),
    Picture(igtl_msgs.LabelMetaList, EntityKind.TEXT, words.draw_labels),
    Picture(igtl_msgs.VideoMetaList, EntityKind.TEXT, words.draw_videos),
    Picture(igtl_msgs.RawMessage, EntityKind.TEXT, words.draw_raw),
)

#: ROS type → its row.
PICTURES: dict[str, Picture] = {row.message.TYPE: row for row in _ROWS}
