"""The messages of the ROS side of ``every-type``: one for each row of the conversion table from ROS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import ToIgtlRow
from igtl_gateway.convert import common_msgs, igtl_msgs, rosmsg
from igtl_gateway.convert.common_msgs import FrameTransform, MultiArrayDimension, MultiArrayLayout, TFMessage
from igtl_gateway.convert.geometry import IDENTITY
from igtl_gateway.convert.igtl_msgs import MetadataItem, Query, TrackedTool
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.rosmsg import Header, RosMessage
from igtl_gateway.convert.structs import Pose
from igtl_gateway.wire.image import LPS, RAS
from igtl_gateway.wire.tracking import TOOL_3D, TOOL_6D
from igtl_gateway_lab.simulate.every_igtl import H264_KEY, H264_NEXT, TILTED, TURNED

#: Device name and what else its topic has, type name for OpenIGTLink ("" = that of the table), message.
Published = tuple[str, str, RosMessage]

_BASE = Header(0, "Base")
_IN_CAMERA = Header(0, "Camera")
_ITEMS = (MetadataItem("operator", 0, "A. B."), MetadataItem("site", 4, "Zürich"))

_POSE = (0.1, -0.2, 0.3, *TURNED)
_CORNERS = np.array([[0, 0, 0], [0.03, 0, 0], [0, 0.04, 0], [0, 0, 0.05]])
_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.uint32)
_RED, _CLEAR = (255, 0, 0, 255), (0, 0, 0, 0)


def tracking_step(step: int) -> igtl_msgs.TrackingData:
    """Two tools in the frame of the camera; the first moves 8 mm a step along z."""
    probe = TrackedTool("Probe", TOOL_6D, (0.1, 0.2, 0.3 + step / 128, *TURNED))
    return igtl_msgs.TrackingData(_IN_CAMERA, (probe, TrackedTool("Stylus", TOOL_3D, (0.0, 0.0, 0.5, *TURNED))), _ITEMS)


def tool_pose(step: int) -> common_msgs.PoseStamped:
    """A pose that moves 8 mm a step along x."""
    return common_msgs.PoseStamped(_BASE, (step / 128, 0.25, 0.5, *TURNED))


def tf_frames(*transforms: tuple[str, str, Pose]) -> TFMessage:
    """Parent, child and pose of each, for /tf or /tf_static."""
    return TFMessage(tuple(FrameTransform(Header(0, parent), child, pose) for parent, child, pose in transforms))


def _poses() -> Iterator[Published]:
    stamped = rosmsg.TransformStamped(_BASE, "Tool", _POSE[:3], _POSE[3:])
    yield "Pose/transform", "", stamped
    yield "Pose/transform_as_position", "POSITION", stamped
    yield "Pose", "", tool_pose(0)
    yield "Pose/as_position", "POSITION", tool_pose(0)
    yield "Tools/poses", "", common_msgs.PoseArray(_BASE, np.array([_POSE, _POSE]))
    yield "Tools", "", tracking_step(0)
    yield "Tools/as_quaternions", "QTDATA", tracking_step(0)


def _texts() -> Iterator[Published]:
    yield "A greeting from ROS with a long name", "", rosmsg.String("hello from ROS 2")
    yield "Greeting", "", rosmsg.String("Grüße, 你好")
    yield "Wish", "CLIENTINFO", rosmsg.String("<ClientInfo/>")
    values = (("code", "13"), ("subcode", "-7"), ("error_name", "NOT_HOMED"))
    yield "Device", "", rosmsg.DiagnosticStatus(2, "arm", "move to the home position", "lwr", values)
    yield "Peer", "", igtl_msgs.Capability(_BASE, ("TRANSFORM", "IMAGE", "GET_CAPABIL"), _ITEMS)


def _pictures() -> Iterator[Published]:
    for encoding, width in (("mono8", 1), ("mono16", 2), ("rgb8", 3), ("bgr8", 3), ("rgba8", 4), ("32FC1", 4)):
        data = (np.arange(12, dtype="<f4") / 8).tobytes() if encoding == "32FC1" else bytes(range(12 * width))
        yield "Picture", "", rosmsg.Image(_BASE, 3, 4, encoding, 0, 4 * width, data)
    voxels = np.arange(24)
    # what 3D Slicer cannot read unchanged: integers beyond 2^24, and LPS
    for scalar, values, coordinate in (
        (4, (voxels * 100 - 1000).astype("<i2"), RAS),
        (7, (voxels * 0x01010101).astype("<u4"), LPS),
    ):
        place = (coordinate, TILTED, (0.001, 0.002, 0.0025), (0.01, -0.02, 0.03))
        yield "Volume", "", igtl_msgs.Volume(_BASE, (4, 3, 2), scalar, 1, False, *place, values.tobytes(), _ITEMS)


def _geometry() -> Iterator[Published]:
    yield "Points/target", "", rosmsg.PointStamped(_BASE, (0.0015, -0.0025, 0.0035))
    points = np.zeros(4, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("heat", "<f4")]))
    for axis, name in enumerate("xyz"):
        points[name] = _CORNERS[:, axis]
    points["rgb"], points["heat"] = [0xFF0000, 0x00FF00, 0x0000FF, 0xFFFFFF], [0.0, 0.25, 0.5, 1.0]
    points["x"][3] = np.nan  # a hole of the organised cloud
    fields = tuple(rosmsg.PointField(name, 4 * at, 7) for at, name in enumerate(points.dtype.names or ()))
    cloud = rosmsg.PointCloud2(_BASE, 2, 2, fields, False, 20, 40, points.tobytes(), False)
    yield "Cloud", "", cloud
    yield "Points/cloud", "POINT", cloud
    yield "Surface/mesh", "", rosmsg.Mesh(_FACES, _CORNERS)
    marker = rosmsg.Marker(_BASE, "demo", 0, rosmsg.Marker.TRIANGLE_LIST, points=_CORNERS[_FACES.reshape(-1)])
    yield "Surface/marker", "", marker
    colors = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 0.5]], np.float32)
    path = rosmsg.Marker(_BASE, "demo", 1, rosmsg.Marker.LINE_STRIP, points=_CORNERS, colors=colors)
    yield "Surface/marker", "", path
    heat, sides = np.arange(4, dtype=np.float32) / 4, np.arange(8, dtype=np.float32)
    attributes = (
        igtl_msgs.PolyDataAttribute("heat", 0, 1, heat),
        igtl_msgs.PolyDataAttribute("sides", 0x14, 4, sides),  # colours of cells
    )
    cells = ([1, 3], [2, 0, 3], [4, 0, 1, 2, 3], [4, 0, 1, 3, 2])
    vertices, lines, polygons, strips = (np.array(each, np.uint32) for each in cells)
    whole = igtl_msgs.PolyData(_BASE, _CORNERS, vertices, lines, polygons, strips, attributes, _ITEMS)
    yield "Surface/polydata", "", whole
    plan = igtl_msgs.Trajectory("Left", "Plan", 3, _RED, (0.01, 0.02, 0.03), (0.04, 0.05, 0.06), 0.0015, "Head")
    yield "Plan", "", igtl_msgs.TrajectoryList(_BASE, (plan,), _ITEMS)
    named = igtl_msgs.LabeledPoint("Gehörgang", "Fiducials", _CLEAR, (-0.0705, 0.0, 0.0), 0.0025, "Head")
    yield "Points/landmarks", "", igtl_msgs.PointList(_BASE, (named,), _ITEMS)


def _numbers() -> Iterator[Published]:
    force = np.array([0.5, -1.25, 9.75])
    yield "Force", "", igtl_msgs.Sensor(_BASE, 0, 0, "N", force, _ITEMS)
    yield "Force/joints", "", common_msgs.JointState(_BASE, ("a1", "a2", "a3"), force)
    square = MultiArrayLayout((MultiArrayDimension("rows", 2, 6), MultiArrayDimension("columns", 3, 3)))
    for code, message in MULTI_ARRAYS.items():
        yield f"Array/{np.dtype(code).name}", "", message(square, np.arange(6).astype(code))
    yield "Force/values", "SENSOR", MULTI_ARRAYS["f8"](MultiArrayLayout(), force)
    complex_pair = np.array([1 + 2j, 3 - 4j], "<c16").tobytes()
    yield "Array/array", "", igtl_msgs.NdArray(_BASE, 13, np.array([2]), False, complex_pair, _ITEMS)
    ramp = np.arange(256, dtype="<u2") * 257
    yield "Colors", "", igtl_msgs.ColorTable(_BASE, 3, 5, False, ramp.tobytes(), _ITEMS)


def robot_messages() -> Iterator[Published]:
    """What an arm with CRTK topics sends."""
    state = common_msgs.JointState(_BASE, ("yaw", "insertion"), np.array([0.25, 0.125]), effort=np.array([0.5, 1.0]))
    yield "Arm/measured_js", "NDARRAY", state
    yield "Arm/measured_cv", "", common_msgs.TwistStamped(_BASE, (0.125, 0.25, 0.5, 1.0, 2.0, 4.0))
    yield "Arm/measured_cf", "", common_msgs.WrenchStamped(_BASE, (1.0, 2.0, 3.0, 0.125, 0.25, 0.5))
    yield "Arm/clutch", "", common_msgs.Joy(_BASE, buttons=np.array([1], np.int32))
    yield "Arm/operating_state", "", common_msgs.OperatingState(_BASE, "ENABLED", is_homed=True)
    yield "Arm/state_command", "", common_msgs.StringStamped(_BASE, "home")


def _videos() -> Iterator[Published]:
    """A key frame, which contains the image size, and the frame that follows it."""
    yield "Camera/compressed_image", "", common_msgs.CompressedImage(_BASE, "h264", H264_KEY)
    yield "Camera/compressed_image", "", common_msgs.CompressedImage(_BASE, "h264", H264_NEXT)
    yield "Camera/compressed_video", "", common_msgs.CompressedVideo(0, "Base", H264_KEY, "h264")
    place = (IDENTITY, (0.001, 0.001, 0.001), (0.01, 0.02, 0.03))
    sizes = ((32, 32, 1), (0, 0, 0), (32, 32, 1))
    yield "Camera/video_frame", "", igtl_msgs.VideoFrame(_BASE, "H264", 1, False, *sizes, RAS, *place, H264_KEY, _ITEMS)


def _lists() -> Iterator[Published]:
    scanned_ns = 1_700_000_000 * NS_PER_S
    image = igtl_msgs.ImageMeta("Head", "MR_1", "MR", "Phantom^One", "P-1", scanned_ns, (256, 256, 60), 5)
    yield "Images", "", igtl_msgs.ImageMetaList(_BASE, (image,), _ITEMS)
    label = igtl_msgs.LabelMeta("Liver", "Labels_1", 7, (160, 80, 40, 255), (256, 256, 60), "MR_1")
    yield "Labels", "", igtl_msgs.LabelMetaList(_BASE, (label,), _ITEMS)
    video = igtl_msgs.VideoMeta(
        *("Scope", "Endoscope", "Phantom^One", "P-1", -2, 0.0355, (1920, 1080, 1)),
        *(IDENTITY, (0.001, 0.001, 0.001), (0.01, 0.02, 0.03), 3),
    )
    yield "Videos", "", igtl_msgs.VideoMetaList(_BASE, (video,), _ITEMS)
    bound = igtl_msgs.BoundMessage("STRING", "Text", b"\x00\x03\x00\x03odd")
    yield "Bundle", "", igtl_msgs.Bind(_BASE, (bound,), _ITEMS)


def messages() -> Iterator[Published]:
    """All messages from ROS except commands, queries and raw messages."""
    yield from _poses()
    yield from _texts()
    yield from _pictures()
    yield from _geometry()
    yield from _numbers()
    yield from _lists()
    yield from _videos()


def topic(name: str) -> str:
    """Where a message for a device is published."""
    return "/igtl/out/" + name.replace(" ", "_")


def rows() -> tuple[ToIgtlRow, ...]:
    """The configuration that gives each message its device and type, where its topic alone does not."""
    asked = {
        (topic(name), name.partition("/")[0], igtl_type): None
        for name, igtl_type, _ in (*messages(), *robot_messages())
    }
    return tuple(
        ToIgtlRow(topic=place, device=device, type=igtl_type)
        for place, device, igtl_type in asked
        if igtl_type or place != topic(device) or " " in device
    )


def queries(link: int) -> Iterator[Query]:
    """Queries for one peer: one of each kind of content and of each shortened name, every field filled in."""
    for query in (
        *(
            Query(_BASE, Query.GET, igtl_type)
            for igtl_type in ("STRING", "TRANSFORM", "CAPABILITY", "VIDEOMETA", "BIND")
        ),
        Query(_BASE, Query.START, "IMAGE"),
        Query(_BASE, Query.START, "TDATA", "Tools", resolution=50, coordinate_name="Base"),
        Query(_BASE, Query.START, "VIDEO", "Camera", resolution=40, codec="H264"),
        Query(_BASE, Query.START, "POLYDATA", resolution=50),
        Query(_BASE, Query.START, "BIND", resolution=50),
        Query(_BASE, Query.STOP, "IMAGE"),
        Query(_BASE, Query.REPLY, "TDATA", status=1),
    ):
        yield replace(query, link=link)
