"""What the programs of the STAR session call their topics, frames and devices, and the clouds that they exchange."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert.rosmsg import Header, Image, Marker, PointCloud2, PointField, String, TransformStamped
from igtl_gateway_lab.simulate.star_numbers import Array

CAMERA_FRAME = "star_camera_optical"
BASE_FRAME = "lwr_base"
TOOL_FRAME = "suture_tool"

CLOUD = "/star/cloud"
IMAGE = "/star/camera/image"
CAMERA_INFO = "/star/camera/camera_info"
CAMERA_POSE = "/star/camera_pose"
MARKERS = "/star/nir_markers"
TOOL = "/star/tool"
PLAN = "/star/plan"
PLAN_POINTS = "/star/plan_points"
STATUS = "/star/status"

#: Devices of OpenIGTLink.  A corrected plan comes back under the name that it went out with, as from 3D Slicer.
CLOUD_DEVICE, POINTS_DEVICE, STATUS_DEVICE = "TissueCloud", "PlanPoints", "StarStatus"
PLANNER_DEVICE = "Navigation"

#: What the gateway makes of a corrected plan, and of an approval.
CORRECTED = f"/igtl/in/{POINTS_DEVICE}/points"
SAID = f"/igtl/in/{PLANNER_DEVICE}/string"
APPROVAL = "plan approved"  #: how the text begins by which the plan is released

CONFIG = Config(
    base_frame=BASE_FRAME,
    to_igtl=tuple(
        ToIgtlRow(topic=topic, device=device, type=igtl_type)
        for topic, device, igtl_type in (
            (CLOUD, CLOUD_DEVICE, "POLYDATA"),
            (IMAGE, "Camera", "IMAGE"),
            (TOOL, "ToolToBase", "TRANSFORM"),
            (CAMERA_POSE, "CameraToBase", "TRANSFORM"),
            (MARKERS, "NirMarkers", "POINT"),
            (PLAN, "SuturePlan", "POLYDATA"),
            (PLAN_POINTS, POINTS_DEVICE, "POINT"),
            (STATUS, STATUS_DEVICE, "STRING"),
        )
    ),
    # points of OpenIGTLink have no frame: these have the frame of the plan that they correct
    to_ros=(ToRosRow(device=POINTS_DEVICE, frame_id=CAMERA_FRAME),),
)

TYPES = {
    CLOUD: PointCloud2.TYPE,
    IMAGE: Image.TYPE,
    CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
    CAMERA_POSE: TransformStamped.TYPE,
    MARKERS: PointCloud2.TYPE,
    TOOL: TransformStamped.TYPE,
    PLAN: Marker.TYPE,
    PLAN_POINTS: PointCloud2.TYPE,
    STATUS: String.TYPE,
    CORRECTED: PointCloud2.TYPE,
    SAID: String.TYPE,
}

_FLOAT32 = 7  # sensor_msgs/PointField
_XYZ = tuple(PointField(name, 4 * i, _FLOAT32) for i, name in enumerate("xyz"))
_XYZRGB = (*_XYZ, PointField("rgb", 12, _FLOAT32))


def coloured_cloud(header: Header, points: NDArray[np.float32], rgb: NDArray[np.uint8]) -> PointCloud2:
    """An organised cloud with gaps; colours packed as the Point Cloud Library does, 0x00RRGGBB in a float's bytes."""
    height, width, _ = points.shape
    wide = rgb.astype(np.uint32)
    data = np.empty((height, width, 4), "<u4")
    data[..., :3] = points.astype("<f4").view("<u4")
    data[..., 3] = wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2]
    return PointCloud2(header, height, width, _XYZRGB, False, 16, 16 * width, data.tobytes(), False)


def plain_cloud(header: Header, points: Array) -> PointCloud2:
    """A list of points (n, 3), metres."""
    count = len(points)
    return PointCloud2(header, 1, count, _XYZ, False, 12, 12 * count, points.astype("<f4").tobytes(), True)


def positions(cdr: Buffer) -> NDArray[np.float32]:
    """(height, width, 3) float32 of a cloud whose x, y and z are float32, side by side at the beginning of a point."""
    cloud = PointCloud2.unpack(cdr)
    rows = np.frombuffer(cloud.data, np.uint8).reshape(cloud.height, cloud.row_step)
    points = rows[:, : cloud.width * cloud.point_step].reshape(cloud.height, cloud.width, cloud.point_step)
    return np.ascontiguousarray(points[..., :12]).view("<f4")
