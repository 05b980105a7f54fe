"""The table of drawings: how each ROS type is drawn.

A new drawing needs one row here.  A type without a row is logged once in the log of the session, and its messages are
rows without a drawing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from igtl_gateway.addon import ros
from igtl_gateway.addon.messages import MULTI_ARRAYS, ServiceEvent
from igtl_gateway.addon.reading import Buffer
from igtl_gateway.addon.untrusted import DerivedType
from igtl_gateway.addons.view import clouds, markers, numbers, other_msgs, pictures2d, poses, surfaces, volumes, words
from igtl_gateway.addons.view.contents import EntityKind


class Readable(Protocol):
    """What a row needs of its message class."""

    TYPE: str

    @classmethod
    def unpack(cls, cdr: Buffer) -> Any: ...


class Bulk(Enum):
    """How many messages of a topic that differ in numbers only are drawn, see ``rows``."""

    NONE = "none"  #: one by one
    RUNS = "runs"  #: at once, those that follow each other: a trail leads from each to the next
    FORMS = "forms"  #: at once, all that have the same form


@dataclass(frozen=True, slots=True)
class Picture:
    """One ROS type.

    Attributes:
        message: class of the message.
        what: kind; some functions refine it by the first message.
        draw: draws a message.
        bulk: how many of them are drawn; with another one than NONE, the class has ``read``.
        fullness: of the messages converted from one OpenIGTLink message, 3-D views show the one with the highest.
    """

    message: Any
    what: EntityKind
    draw: Callable[[Any, Any], None]
    fullness: int = 0
    bulk: Bulk = Bulk.NONE


_ROWS = (
    Picture(ros.PointCloud2, EntityKind.CLOUD, clouds.draw_cloud, 2),
    Picture(ros.PointStamped, EntityKind.POINTS, clouds.draw_point, 1),
    Picture(ros.PointList, EntityKind.POINTS, clouds.draw_point_list, 3),
    Picture(ros.TransformStamped, EntityKind.POSE, poses.draw_transform, bulk=Bulk.RUNS),
    Picture(ros.PoseStamped, EntityKind.POSE, poses.draw_pose, bulk=Bulk.RUNS),
    Picture(ros.PoseArray, EntityKind.POSES, poses.draw_poses, 1, Bulk.RUNS),
    Picture(ros.TrackingData, EntityKind.POSES, poses.draw_tracking, 3, Bulk.RUNS),
    Picture(ros.TFMessage, EntityKind.FRAMES, poses.draw_tf, bulk=Bulk.FORMS),
    Picture(ros.Image, EntityKind.IMAGE, pictures2d.draw_image, 1),
    Picture(ros.CompressedImage, EntityKind.VIDEO, pictures2d.draw_compressed_image, 1),
    Picture(ros.CompressedVideo, EntityKind.VIDEO, pictures2d.draw_compressed_video, 2),
    Picture(ros.VideoFrame, EntityKind.VIDEO, pictures2d.draw_video_frame, 3),
    Picture(ros.CameraInfo, EntityKind.CAMERA, pictures2d.draw_camera),
    Picture(ros.Volume, EntityKind.VOLUME, volumes.draw_volume, 2),
    Picture(ros.ColorTable, EntityKind.IMAGE, pictures2d.draw_color_table),
    Picture(ros.Mesh, EntityKind.MESH, surfaces.draw_mesh, 2),
    Picture(ros.Marker, EntityKind.MARKERS, surfaces.draw_marker, 1),
    Picture(markers.MarkerArray, EntityKind.MARKERS, surfaces.draw_marker_array),
    Picture(ros.PolyData, EntityKind.MESH, surfaces.draw_polydata, 3),
    Picture(ros.TrajectoryList, EntityKind.LINES, surfaces.draw_trajectories, 3),
    Picture(other_msgs.Path, EntityKind.LINES, surfaces.draw_path),
    Picture(ros.JointState, EntityKind.PLOT, numbers.draw_joints, bulk=Bulk.FORMS),
    Picture(ros.Sensor, EntityKind.PLOT, numbers.draw_sensor, bulk=Bulk.FORMS),
    Picture(other_msgs.Float64, EntityKind.PLOT, numbers.draw_number, bulk=Bulk.FORMS),
    Picture(ros.WrenchStamped, EntityKind.PLOT, numbers.draw_wrench, bulk=Bulk.FORMS),
    Picture(ros.TwistStamped, EntityKind.PLOT, numbers.draw_twist, bulk=Bulk.FORMS),
    Picture(ros.Joy, EntityKind.PLOT, numbers.draw_buttons, bulk=Bulk.FORMS),
    Picture(ros.OperatingState, EntityKind.TEXT, words.draw_state),
    Picture(ros.StringStamped, EntityKind.TEXT, words.draw_stamped_string),
    Picture(ros.Empty, EntityKind.TEXT, words.draw_empty),
    Picture(ros.NdArray, EntityKind.PLOT, numbers.draw_array),
    *(Picture(message, EntityKind.PLOT, numbers.draw_multi_array) for message in MULTI_ARRAYS.values()),
    Picture(ros.String, EntityKind.TEXT, words.draw_string),
    Picture(ros.DiagnosticStatus, EntityKind.TEXT, words.draw_status),
    Picture(ros.Log, EntityKind.TEXT, words.draw_log),
    Picture(ros.Command, EntityKind.TEXT, words.draw_command),
    Picture(ros.CommandReply, EntityKind.TEXT, words.draw_reply),
    Picture(ros.Query, EntityKind.TEXT, words.draw_query),
    Picture(ros.Metadata, EntityKind.TEXT, words.draw_metadata),
    Picture(ros.Capability, EntityKind.TEXT, words.draw_capability),
    Picture(ros.LinkStatusList, EntityKind.TEXT, words.draw_links),
    Picture(ros.Bind, EntityKind.TEXT, words.draw_bind),
    Picture(ros.ImageMetaList, EntityKind.TEXT, words.draw_images),
    Picture(ros.LabelMetaList, EntityKind.TEXT, words.draw_labels),
    Picture(ros.VideoMetaList, EntityKind.TEXT, words.draw_videos),
    Picture(ros.RawMessage, EntityKind.TEXT, words.draw_raw),
    Picture(words.GoalStates, EntityKind.TEXT, words.draw_goals),
)
#: Of the events of all services, and the feedback of all actions: each has a type of its own.
_EVENT = Picture(ServiceEvent, EntityKind.TEXT, words.draw_event)
_FEEDBACK = Picture(words.Feedback, EntityKind.TEXT, words.draw_feedback)

#: ROS type → its row.
PICTURES: dict[str, Picture] = {row.message.TYPE: row for row in _ROWS}


def picture_of(ros_type: str) -> Picture | None:
    """Return the row of a type; None without one."""
    if derived := DerivedType.of(ros_type):
        return _EVENT if derived.suffix.endswith("Event") else _FEEDBACK
    return PICTURES.get(ros_type)
