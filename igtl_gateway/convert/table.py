"""The table of conversions from OpenIGTLink types to ROS types and back.

A row defines everything about a conversion; routing, documentation and tests read this table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from igtl_gateway.base.qos import Qos
from igtl_gateway.convert import (
    clouds,
    columns,
    commands,
    common_msgs,
    igtl_msgs,
    images,
    lists,
    numbers,
    polydata,
    poses,
    queries,
    robots,
    rosmsg,
    surfaces,
    texts,
    tracking,
    trajectories,
    videos,
    volumes,
)
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.colort import ColorTable
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.query import QUERIES
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.trajectory import Trajectories
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video

#: Tracking data: a subscriber that lags by 2 s at 1 kHz loses no message.
_STATES = Qos(depth=2000)
#: Strings are rare, and each one matters.
_TEXTS = Qos(depth=100)
#: The operating state of a robot changes rarely, and late joiners need it.
_STATES_LATCHED = Qos(depth=5, latched=True)
#: Images: 0.2 s at 30 Hz.  Old images have megabytes each and no value for a subscriber that lags.
_PICTURES = Qos(depth=6)
#: Clouds are smaller: 1 s at 30 Hz.
_CLOUDS = Qos(depth=30)
#: Plans and surfaces are sent once, and late joiners need them.
_SURFACES = Qos(depth=5, latched=True)
#: Volumes are latched like surfaces, but each can have hundreds of megabytes.
_VOLUMES = Qos(depth=2, latched=True)
#: All slices of a volume are published at once.
_SLICES = Qos(depth=1000)
#: Video frames depend on earlier ones: a subscriber that lags by seconds loses none.
_FRAMES = Qos(depth=300)


class Role(Enum):
    """Role of a row among the rows that convert the same OpenIGTLink message."""

    STANDARD = "standard"  #: a message of the common ROS packages
    FULL = "full"  #: a message of igtl_msgs, for data that the standard messages cannot hold
    ON_REQUEST = "on request"  #: published if the configuration names its kind


@dataclass(frozen=True, slots=True)
class ConversionToRos:
    """A conversion from OpenIGTLink to ROS.

    Attributes:
        igtl_types: type names on the wire.
        content: class of the decoded content, or a tuple of its possible classes.
        message: class of the ROS message.
        kind: last token of the topic.
        convert: conversion function; the messages of a list are published in its order.
        qos: quality of service of the publisher.
        lossy: the information that the conversion loses; "" if none.
        applies: returns whether this row applies to a content; several rows can apply to one message.
        role: role among the rows of the same type.
        topic: fixed topic, such as /tf; "" for the configured one.
    """

    igtl_types: tuple[str, ...]
    content: type | tuple[type, ...]
    message: type[RosMessage]
    kind: str
    convert: Callable[[Any, ToRosContext], RosMessage | list[RosMessage]]
    qos: Qos
    lossy: str = ""
    applies: Callable[[Any], bool] = lambda content: True
    role: Role = Role.STANDARD
    topic: str = ""


@dataclass(frozen=True, slots=True)
class ConversionToIgtl:
    """A conversion from ROS to OpenIGTLink.

    Attributes:
        message: class of the ROS message.
        igtl_type: type name on the wire, or one of several if the content determines it.  The first row of a ROS type
            is its default.
        convert: conversion function.
        qos: quality of service of the subscription.
        lossy: the information that the conversion loses; "" if none.
    """

    message: type[RosMessage]
    igtl_type: str
    convert: Callable[[Any, ToIgtlContext], ConvertedMessage]
    qos: Qos
    lossy: str = ""


_POINT_LOSS = "names, groups and owners"
_TEXT_LOSS = "bytes that are invalid text, bytes after a NUL"
_LONG_TEXTS = "the end of strings that are longer than their field"
#: The gateway rejects lists whose conversion would delay all other messages, see ``columns.check_rows``.
_LONG_LIST = f"lists of more than {columns.MAX_ROWS:,}"
#: The library's conversion of nanoseconds is not injective, see ``stamp``.
_SCAN_LOSS = f"{_TEXT_LOSS}; up to 10 ns of scan times that were not written by the library; {_LONG_LIST}"
_LABEL_LOSS = f"{_TEXT_LOSS}; {_LONG_LIST}"
_VIDEO_LOSS = (
    f"{_TEXT_LOSS}; last bit of the focal length; matrices with NaN or infinity, signs of zeros in vectors "
    f"of zero length; {_LONG_LIST}"
)
#: Error of each number of a rotation in float32, as matrix or as quaternion; measured: 7e-8.
_ROUNDED = "rotations rounded by up to 2e-7"
_TO_FLOAT32 = f"double precision (float32; {_ROUNDED})"
_HEADER_1 = "frame ids and metadata for peers with header version 1"
_TOOLS = (TrackingData, QuaternionTrackingData)
_PLACE_LOSS = "content versions other than 1, matrices with NaN or infinity, signs of zeros in the matrix"
_FRAME_LOSS = "size, sub-volume, key-frame flag (but see the bit stream), grey flag, spacing, orientation and position"
_FORMAT_LOSS = f"words of the format other than the codec, {_HEADER_1}; size 0 until the first key frame"
_POSES = (
    f"scale and shear (with a warning), length and sign of quaternions; {_ROUNDED}; "
    f"more than {tracking.MAX_TOOLS:,} tools"
)
_NO_POSE = "tools with an invalid rotation (reflections, zeros) are"

TO_ROS: tuple[ConversionToRos, ...] = (
    ConversionToRos(
        ("TRANSFORM",),
        Transform,
        rosmsg.TransformStamped,
        "transform",
        poses.transform_to_ros,
        _STATES,
        lossy=f"{_ROUNDED}; scale and shear if the matrix is not orthonormal (a warning); reflections are rejected",
    ),
    ConversionToRos(
        ("POSITION", "QTRANS"),
        Position,
        rosmsg.TransformStamped,
        "transform",
        poses.position_to_ros,
        _STATES,
        lossy="length and sign of the quaternion, which form was used",
    ),
    ConversionToRos(
        ("STRING",), String, rosmsg.String, "string", texts.string_to_ros, _TEXTS, lossy="stamp, encoding (UTF-8)"
    ),
    ConversionToRos(
        ("CLIENTINFO",),
        ClientInfo,
        rosmsg.String,
        "client_info",
        texts.string_to_ros,
        _TEXTS,
        lossy="stamp, encoding (UTF-8)",
    ),
    ConversionToRos(("STATUS",), Status, rosmsg.DiagnosticStatus, "status", texts.status_to_ros, _TEXTS, lossy="stamp"),
    ConversionToRos(
        ("IMAGE",),
        Image,
        rosmsg.Image,
        "image",
        images.image_to_ros,
        _PICTURES,
        lossy="spacing, orientation and position",
        applies=volumes.is_flat,
    ),
    ConversionToRos(
        ("POINT",),
        Points,
        rosmsg.PointStamped,
        "point",
        clouds.point_to_ros,
        _STATES,
        lossy=f"{_POINT_LOSS}, colour, diameter",
        applies=clouds.is_single,
    ),
    ConversionToRos(
        ("POINT",), Points, rosmsg.PointCloud2, "points", clouds.points_to_cloud, _SURFACES, lossy=_POINT_LOSS
    ),
    ConversionToRos(
        ("POLYDATA",),
        PolyData,
        rosmsg.PointCloud2,
        "points",
        clouds.polydata_to_cloud,
        _CLOUDS,
        lossy="cells, attributes of cells",
        applies=surfaces.is_point_cloud,
    ),
    ConversionToRos(
        ("POLYDATA",),
        PolyData,
        rosmsg.Mesh,
        "mesh",
        surfaces.polydata_to_mesh,
        _SURFACES,
        lossy="stamp, attributes, lines and vertices; polygons become triangles",
        applies=surfaces.has_faces,
    ),
    ConversionToRos(
        ("POLYDATA",),
        PolyData,
        rosmsg.Marker,
        "marker",
        surfaces.polydata_to_marker,
        _SURFACES,
        lossy="attributes other than colour; polygons become triangles without shared points",
        applies=surfaces.has_faces,
    ),
    ConversionToRos(
        ("POLYDATA",),
        PolyData,
        rosmsg.Marker,
        "lines",
        surfaces.polydata_to_lines,
        _SURFACES,
        lossy="attributes other than colour; polylines become segments",
        applies=surfaces.has_lines,
    ),
    ConversionToRos(("SENSOR",), Sensor, igtl_msgs.Sensor, "sensor", numbers.sensor_to_ros, _STATES, role=Role.FULL),
    ConversionToRos(
        ("SENSOR",),
        Sensor,
        MULTI_ARRAYS["f8"],
        "values",
        numbers.sensor_to_values,
        _STATES,
        lossy="stamp, unit, status",
    ),
    ConversionToRos(("NDARRAY",), NdArray, igtl_msgs.NdArray, "array", numbers.array_to_ros, _STATES, role=Role.FULL),
    *(
        ConversionToRos(
            ("NDARRAY",),
            NdArray,
            message,
            f"{np.dtype(code).name}_array",
            numbers.array_to_multi,
            _STATES,
            lossy="stamp",
            applies=numbers.is_array_of(code),
        )
        for code, message in MULTI_ARRAYS.items()
    ),
    ConversionToRos(
        ("COMMAND",),
        Command,
        igtl_msgs.Command,
        "command",
        commands.command_to_ros,
        _TEXTS,
        lossy=_TEXT_LOSS,
        role=Role.FULL,
    ),
    ConversionToRos(
        ("RTS_COMMAND",),
        Command,
        igtl_msgs.CommandReply,
        "command_reply",
        commands.reply_to_ros,
        _TEXTS,
        lossy=_TEXT_LOSS,
        role=Role.FULL,
    ),
    ConversionToRos(
        tuple(QUERIES),
        tuple(dict.fromkeys(QUERIES.values())),
        igtl_msgs.Query,
        "query",
        queries.query_to_ros,
        _TEXTS,
        lossy="which messages of a BIND are requested, intervals below a millisecond, undocumented content, "
        "whether an empty content was present",
        role=Role.FULL,
    ),
    ConversionToRos(
        ("TDATA", "QTDATA"),
        _TOOLS,
        igtl_msgs.TrackingData,
        "tracking",
        tracking.tracking_to_ros,
        _STATES,
        lossy=f"which form was used, reserved bytes, {_TEXT_LOSS}, {_POSES}; {_NO_POSE} left out",
        role=Role.FULL,
    ),
    ConversionToRos(
        ("TDATA", "QTDATA"),
        _TOOLS,
        common_msgs.PoseArray,
        "poses",
        tracking.tracking_to_poses,
        _STATES,
        lossy=f"names, types, {_POSES}; {_NO_POSE} NaN",
    ),
    ConversionToRos(
        ("TRANSFORM",),
        Transform,
        common_msgs.TFMessage,
        "tf",
        tracking.transform_to_tf,
        _STATES,
        lossy="as with TransformStamped; a frame that would be its own parent is left out",
        topic="/tf",
    ),
    ConversionToRos(
        ("POSITION", "QTRANS"),
        Position,
        common_msgs.TFMessage,
        "tf",
        tracking.position_to_tf,
        _STATES,
        lossy="as with TransformStamped; a frame that would be its own parent is left out",
        topic="/tf",
    ),
    ConversionToRos(
        ("TDATA", "QTDATA"),
        _TOOLS,
        common_msgs.TFMessage,
        "tf",
        tracking.tracking_to_tf,
        _STATES,
        lossy=f"types, frames that would be their own parents, {_POSES}; names become frame ids; {_NO_POSE} left out",
        topic="/tf",
    ),
    ConversionToRos(
        ("TRAJ",),
        Trajectories,
        igtl_msgs.TrajectoryList,
        "trajectories",
        trajectories.trajectories_to_ros,
        _SURFACES,
        lossy=f"reserved bytes, {_TEXT_LOSS}; {_LONG_LIST}",
        role=Role.FULL,
    ),
    ConversionToRos(
        ("TRAJ",),
        Trajectories,
        rosmsg.Marker,
        "lines",
        trajectories.trajectories_to_lines,
        _SURFACES,
        lossy=f"{_POINT_LOSS}, diameters, trajectories of one point (a warning if they have both ends); "
        "a line without a colour (all 0) is grey",
    ),
    ConversionToRos(
        ("POINT",),
        Points,
        igtl_msgs.PointList,
        "landmarks",
        trajectories.points_to_point_list,
        _SURFACES,
        lossy=f"{_TEXT_LOSS}; lists of more than {trajectories.MAX_POINTS:,}",
        applies=trajectories.is_labeled,
        role=Role.FULL,
    ),
    *(
        ConversionToRos(types, content, message, kind, convert, _SURFACES, lossy=lossy, role=Role.FULL)
        for types, content, message, kind, convert, lossy in (
            (("IMGMETA",), ImageMetaList, igtl_msgs.ImageMetaList, "images", lists.images_to_ros, _SCAN_LOSS),
            (("LBMETA",), LabelMetaList, igtl_msgs.LabelMetaList, "labels", lists.labels_to_ros, _LABEL_LOSS),
            (("VIDEOMETA",), VideoMetaList, igtl_msgs.VideoMetaList, "videos", lists.videos_to_ros, _VIDEO_LOSS),
            (("COLORT", "COLORTABLE"), ColorTable, igtl_msgs.ColorTable, "color_table", lists.colors_to_ros, ""),
            (
                *(("CAPABILITY", "CAPABIL"), Capability, igtl_msgs.Capability),
                *("capability", lists.capability_to_ros, _TEXT_LOSS),
            ),
        )
    ),
    ConversionToRos(
        ("BIND",),
        Bind,
        igtl_msgs.Bind,
        "bind",
        lists.bind_to_ros,
        _TEXTS,
        lossy=_TEXT_LOSS + ", padding",
        role=Role.FULL,
    ),
    ConversionToRos(
        ("IMAGE",),
        Image,
        igtl_msgs.Volume,
        "volume",
        volumes.image_to_volume,
        _VOLUMES,
        lossy=f"{_PLACE_LOSS}; scalar type 15 (becomes 2), coordinate system 0 (LPS, a warning); "
        "a centre nearer to the frame's origin than the size of the image / 2^27",
        applies=volumes.exceeds_picture,
        role=Role.FULL,
    ),
    ConversionToRos(
        ("IMAGE",),
        Image,
        rosmsg.Image,
        "slices",
        volumes.image_to_slices,
        _SLICES,
        lossy="spacing, orientation and position",
        applies=volumes.has_slices,
        role=Role.ON_REQUEST,
    ),
    ConversionToRos(
        ("POLYDATA",),
        PolyData,
        igtl_msgs.PolyData,
        "polydata",
        polydata.polydata_to_ros,
        _SURFACES,
        lossy="names of attributes that are invalid text, NaN and infinite coordinates, padding",
        applies=polydata.exceeds_standard,
        role=Role.FULL,
    ),
    ConversionToRos(
        ("VIDEO",),
        Video,
        igtl_msgs.VideoFrame,
        "video_frame",
        videos.video_to_ros,
        _FRAMES,
        lossy=f"{_PLACE_LOSS}; byte orders other than 1 (big) and 2, coordinate system 0, codecs that are invalid text",
        role=Role.FULL,
    ),
    ConversionToRos(
        ("VIDEO",),
        Video,
        common_msgs.CompressedImage,
        "compressed_image",
        videos.video_to_compressed_image,
        _FRAMES,
        lossy=_FRAME_LOSS,
        applies=videos.is_compressed,
    ),
    ConversionToRos(
        ("VIDEO",),
        Video,
        common_msgs.CompressedVideo,
        "compressed_video",
        videos.video_to_compressed_video,
        _FRAMES,
        lossy=_FRAME_LOSS,
        applies=videos.is_compressed,
    ),
    ConversionToRos(
        ("TRANSFORM",),
        Transform,
        common_msgs.PoseStamped,
        "pose",
        robots.transform_to_pose,
        _STATES,
        lossy=f"child frame; {_ROUNDED}; scale and shear if the matrix is not orthonormal (a warning)",
        role=Role.ON_REQUEST,
    ),
    ConversionToRos(
        ("NDARRAY",),
        NdArray,
        common_msgs.JointState,
        "joint_state",
        robots.array_to_joints,
        _STATES,
        lossy="values of a quantity that no joint has; names for peers with header version 1",
        applies=robots.is_joint_state,
        role=Role.ON_REQUEST,
    ),
    *(
        ConversionToRos(("SENSOR",), Sensor, message, kind, convert, _STATES, lossy, role=Role.ON_REQUEST)
        for message, kind, convert, lossy in (
            (common_msgs.JointState, "joint_command", robots.sensor_to_joints, "unit, status"),
            (common_msgs.TwistStamped, "twist", robots.sensor_to_twist, "unit, status"),
            (common_msgs.WrenchStamped, "wrench", robots.sensor_to_wrench, "unit, status"),
            (
                common_msgs.Joy,
                "buttons",
                robots.sensor_to_joy,
                "unit, status; values that are not integers are rejected",
            ),
        )
    ),
    *(
        ConversionToRos(("STRING",), String, message, kind, convert, _TEXTS, lossy, role=Role.ON_REQUEST)
        for message, kind, convert, lossy in (
            (common_msgs.OperatingState, "operating_state", robots.string_to_state, "words other than homed and busy"),
            (common_msgs.StringStamped, "string_stamped", robots.string_to_stamped, "encoding (UTF-8)"),
            (common_msgs.Empty, "empty", robots.string_to_empty, "the text"),
        )
    ),
)

TO_IGTL: tuple[ConversionToIgtl, ...] = (
    ConversionToIgtl(
        rosmsg.TransformStamped, "TRANSFORM", poses.transform_to_igtl, _STATES, f"{_TO_FLOAT32}, {_HEADER_1}"
    ),
    ConversionToIgtl(
        rosmsg.TransformStamped,
        "POSITION",
        poses.position_to_igtl,
        _STATES,
        f"double precision (float32), length of the quaternion, {_HEADER_1}",
    ),
    ConversionToIgtl(
        rosmsg.String, "STRING", texts.string_to_igtl, _TEXTS, "strings of more than 65,535 bytes are rejected"
    ),
    ConversionToIgtl(
        rosmsg.String, "CLIENTINFO", texts.string_to_igtl, _TEXTS, "strings of more than 65,535 bytes are rejected"
    ),
    ConversionToIgtl(
        rosmsg.DiagnosticStatus, "STATUS", texts.status_to_igtl, _TEXTS, "name, hardware id, further values"
    ),
    ConversionToIgtl(rosmsg.Image, "IMAGE", images.image_to_igtl, _PICTURES, f"{_HEADER_1}; BGR is sent as RGB"),
    ConversionToIgtl(rosmsg.PointStamped, "POINT", clouds.point_to_igtl, _STATES, f"double precision, {_HEADER_1}"),
    ConversionToIgtl(
        rosmsg.PointCloud2,
        "POLYDATA",
        clouds.cloud_to_polydata,
        _CLOUDS,
        f"rows and columns, NaN and infinite points, {_HEADER_1}; fields become float32",
    ),
    ConversionToIgtl(
        rosmsg.PointCloud2,
        "POINT",
        clouds.cloud_to_points,
        _CLOUDS,
        f"rows and columns, NaN and infinite points, fields other than colour and diameter, {_HEADER_1}",
    ),
    ConversionToIgtl(rosmsg.Mesh, "POLYDATA", surfaces.mesh_to_igtl, _SURFACES, "double precision"),
    ConversionToIgtl(
        rosmsg.Marker,
        "POLYDATA",
        surfaces.marker_to_igtl,
        _SURFACES,
        f"double precision, uniform colour, {_HEADER_1}",
    ),
    ConversionToIgtl(igtl_msgs.Sensor, "SENSOR", numbers.sensor_to_igtl, _STATES, "unit_text if there is a unit"),
    ConversionToIgtl(
        common_msgs.JointState,
        "SENSOR",
        numbers.joints_to_sensor,
        _STATES,
        "names, velocity, effort; positions of prismatic joints get the unit radian too",
    ),
    ConversionToIgtl(igtl_msgs.NdArray, "NDARRAY", numbers.array_to_igtl, _STATES, "byte order (big-endian)"),
    *(
        ConversionToIgtl(message, "NDARRAY", numbers.multi_to_array, _STATES, "labels, gaps between rows")
        for message in MULTI_ARRAYS.values()
    ),
    ConversionToIgtl(MULTI_ARRAYS["f8"], "SENSOR", numbers.values_to_sensor, _STATES, "layout"),
    ConversionToIgtl(
        igtl_msgs.Command, "COMMAND", commands.command_to_igtl, _TEXTS, "timeout, names of more than 127 bytes"
    ),
    ConversionToIgtl(
        igtl_msgs.CommandReply,
        "RTS_COMMAND",
        commands.reply_to_igtl,
        _TEXTS,
        "reason for a missing reply (TIMEOUT and NO_PEER become FAIL), error message of a success, "
        "names of more than 127 bytes",
    ),
    ConversionToIgtl(
        igtl_msgs.Query, "GET_STATUS", queries.query_to_igtl, _TEXTS, "fields that the query does not have"
    ),
    ConversionToIgtl(
        igtl_msgs.TrackingData,
        "TDATA",
        tracking.tracking_to_tdata,
        _STATES,
        f"{_TO_FLOAT32}, names of more than 19 bytes, {_HEADER_1}",
    ),
    ConversionToIgtl(
        igtl_msgs.TrackingData,
        "QTDATA",
        tracking.tracking_to_qtdata,
        _STATES,
        f"double precision (float32), length of quaternions, names of more than 19 bytes, {_HEADER_1}",
    ),
    ConversionToIgtl(
        common_msgs.PoseArray,
        "TDATA",
        tracking.poses_to_tdata,
        _STATES,
        f"{_TO_FLOAT32}, {_HEADER_1}; the tools get the names Tool1, Tool2, …",
    ),
    ConversionToIgtl(
        common_msgs.PoseStamped, "TRANSFORM", poses.pose_to_transform, _STATES, f"{_TO_FLOAT32}, {_HEADER_1}"
    ),
    ConversionToIgtl(
        common_msgs.PoseStamped,
        "POSITION",
        poses.pose_to_position,
        _STATES,
        f"double precision (float32), length of the quaternion, {_HEADER_1}",
    ),
    ConversionToIgtl(
        igtl_msgs.TrajectoryList,
        "TRAJ",
        trajectories.trajectories_to_igtl,
        _SURFACES,
        f"double precision (float32), {_LONG_TEXTS}, {_HEADER_1}; NaN and infinity are not sent",
    ),
    ConversionToIgtl(
        igtl_msgs.PointList,
        "POINT",
        trajectories.point_list_to_igtl,
        _SURFACES,
        f"double precision (float32), {_LONG_TEXTS}, {_HEADER_1}; NaN and infinity are not sent",
    ),
    *(
        ConversionToIgtl(message, igtl_type, convert, _SURFACES, lossy)
        for message, igtl_type, convert, lossy in (
            (igtl_msgs.ImageMetaList, "IMGMETA", lists.images_to_igtl, _LONG_TEXTS),
            (igtl_msgs.LabelMetaList, "LBMETA", lists.labels_to_igtl, _LONG_TEXTS),
            (
                *(igtl_msgs.VideoMetaList, "VIDEOMETA", lists.videos_to_igtl),
                f"{_LONG_TEXTS}; double precision of directions, spacing and centre",
            ),
            (igtl_msgs.ColorTable, "COLORT", lists.colors_to_igtl, "byte order (big-endian)"),
            (igtl_msgs.Capability, "CAPABILITY", lists.capability_to_igtl, "names of more than 12 bytes are rejected"),
        )
    ),
    ConversionToIgtl(igtl_msgs.Bind, "BIND", lists.bind_to_igtl, _TEXTS, "names of more than 20 bytes"),
    ConversionToIgtl(
        igtl_msgs.Volume,
        "IMAGE",
        volumes.volume_to_image,
        _VOLUMES,
        f"double precision of direction, spacing and origin (float32), {_HEADER_1}",
    ),
    ConversionToIgtl(
        igtl_msgs.PolyData,
        "POLYDATA",
        polydata.polydata_to_igtl,
        _SURFACES,
        f"double precision of points (float32), names of more than 255 bytes, {_HEADER_1}; "
        "NaN and infinite points are not sent",
    ),
    ConversionToIgtl(
        igtl_msgs.VideoFrame,
        "VIDEO",
        videos.video_to_igtl,
        _FRAMES,
        f"double precision of direction, spacing and centre (float32), {_HEADER_1}",
    ),
    ConversionToIgtl(common_msgs.CompressedImage, "VIDEO", videos.compressed_image_to_igtl, _FRAMES, _FORMAT_LOSS),
    ConversionToIgtl(common_msgs.CompressedVideo, "VIDEO", videos.compressed_video_to_igtl, _FRAMES, _FORMAT_LOSS),
    ConversionToIgtl(
        common_msgs.JointState, "NDARRAY", robots.joints_to_array, _STATES, f"names with a comma, names and {_HEADER_1}"
    ),
    *(
        ConversionToIgtl(message, igtl_type, convert, qos, lossy)
        for message, igtl_type, convert, qos, lossy in (
            (common_msgs.TwistStamped, "SENSOR", robots.twist_to_sensor, _STATES, _HEADER_1),
            (common_msgs.WrenchStamped, "SENSOR", robots.wrench_to_sensor, _STATES, _HEADER_1),
            (common_msgs.Joy, "SENSOR", robots.joy_to_sensor, _STATES, f"axes; {_HEADER_1}"),
            (
                *(common_msgs.OperatingState, "STRING", robots.state_to_string, _STATES_LATCHED),
                f"states with a blank; {_HEADER_1}",
            ),
            (common_msgs.StringStamped, "STRING", robots.stamped_to_string, _TEXTS, _HEADER_1),
        )
    ),
)


def rows_to_ros(igtl_type: str) -> tuple[ConversionToRos, ...]:
    """Return the rows of an OpenIGTLink type in the order of the table; none for a type without conversion."""
    return _TO_ROS.get(igtl_type, ())


def row_to_igtl(ros_type: str, igtl_type: str = "") -> ConversionToIgtl | None:
    """Return the row of a ROS type for ``igtl_type``, by default the first one; None if no row exists."""
    return _TO_IGTL.get((ros_type, igtl_type))


_TO_ROS = {name: tuple(row for row in TO_ROS if name in row.igtl_types) for row in TO_ROS for name in row.igtl_types}
_TO_IGTL = {(row.message.TYPE, row.igtl_type): row for row in TO_IGTL} | {
    (row.message.TYPE, ""): row for row in reversed(TO_IGTL)
}
