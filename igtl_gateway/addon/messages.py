"""Messages of both protocols: conversions one at a time, pictures, units, names, metadata, definitions.

Their classes are in ``addon.igtl`` and ``addon.ros``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.convert.bitstream import is_key_frame as is_key_frame
    from igtl_gateway.convert.cdr import CdrReader as CdrReader
    from igtl_gateway.convert.clouds import cloud_to_polydata as cloud_to_polydata
    from igtl_gateway.convert.clouds import colour_bytes as colour_bytes
    from igtl_gateway.convert.clouds import colour_field as colour_field
    from igtl_gateway.convert.context import ConvertedMessage as ConvertedMessage
    from igtl_gateway.convert.context import ToIgtlContext as ToIgtlContext
    from igtl_gateway.convert.context import ToRosContext as ToRosContext
    from igtl_gateway.convert.exchanges import ACTION_SERVICES as ACTION_SERVICES
    from igtl_gateway.convert.exchanges import ACTION_TOPICS as ACTION_TOPICS
    from igtl_gateway.convert.exchanges import IN_ACTION as IN_ACTION
    from igtl_gateway.convert.exchanges import OUTCOMES as OUTCOMES
    from igtl_gateway.convert.exchanges import SERVICE_EVENT as SERVICE_EVENT
    from igtl_gateway.convert.exchanges import ServiceEvent as ServiceEvent
    from igtl_gateway.convert.exchanges import action_of as action_of
    from igtl_gateway.convert.exchanges import feedback_goal as feedback_goal
    from igtl_gateway.convert.exchanges import goal_states as goal_states
    from igtl_gateway.convert.exchanges import service_of as service_of
    from igtl_gateway.convert.frames import frame_id as frame_id
    from igtl_gateway.convert.framesize import frame_size as frame_size
    from igtl_gateway.convert.images import image_to_igtl as image_to_igtl
    from igtl_gateway.convert.images import pixel_layout as pixel_layout
    from igtl_gateway.convert.interfaces import PACKAGES as DEFINED_PACKAGES
    from igtl_gateway.convert.interfaces import definition_folder as definition_folder
    from igtl_gateway.convert.interfaces import interface_files as interface_files
    from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS as MULTI_ARRAYS
    from igtl_gateway.convert.names import frames_of as frames_of
    from igtl_gateway.convert.names import frames_of_name as frames_of_name
    from igtl_gateway.convert.names import short_device_name as short_device_name
    from igtl_gateway.convert.names import topic_token as topic_token
    from igtl_gateway.convert.pictures import JPEG as JPEG
    from igtl_gateway.convert.pictures import PNG as PNG
    from igtl_gateway.convert.pictures import Coding as Coding
    from igtl_gateway.convert.pictures import bayer_pattern as bayer_pattern
    from igtl_gateway.convert.pictures import coding_of as coding_of
    from igtl_gateway.convert.pictures import demosaiced as demosaiced
    from igtl_gateway.convert.pictures import depths as depths
    from igtl_gateway.convert.pictures import is_deep_png as is_deep_png
    from igtl_gateway.convert.polydata import polydata_to_igtl as polydata_to_igtl
    from igtl_gateway.convert.poses import rotation_matrix as rotation_matrix
    from igtl_gateway.convert.poses import unit_quaternion as unit_quaternion
    from igtl_gateway.convert.scaling import into_ros as into_ros
    from igtl_gateway.convert.structs import Pose as Pose
    from igtl_gateway.convert.surfaces import has_faces as has_faces
    from igtl_gateway.convert.surfaces import has_lines as has_lines
    from igtl_gateway.convert.surfaces import marker_to_igtl as marker_to_igtl
    from igtl_gateway.convert.surfaces import mesh_to_igtl as mesh_to_igtl
    from igtl_gateway.convert.surfaces import polydata_to_lines as polydata_to_lines
    from igtl_gateway.convert.surfaces import polydata_to_mesh as polydata_to_mesh
    from igtl_gateway.convert.table import TO_ROS as TO_ROS
    from igtl_gateway.convert.trajectories import trajectories_to_igtl as trajectories_to_igtl
    from igtl_gateway.convert.units import LengthUnits as LengthUnits
    from igtl_gateway.convert.units import ieee_754 as ieee_754
    from igtl_gateway.convert.units import millimetres as millimetres
    from igtl_gateway.convert.units import scale as scale
    from igtl_gateway.convert.videos import FORMATS as VIDEO_FORMATS
    from igtl_gateway.convert.volumes import volume_to_image as volume_to_image
    from igtl_gateway.edges.video.still import decoded_still as decoded_still
    from igtl_gateway.edges.video.worker import MAX_PIXELS as MAX_PIXELS
    from igtl_gateway.edges.video.worker import THREADS as VIDEO_THREADS
    from igtl_gateway.edges.video.worker import import_av as import_av
    from igtl_gateway.gateway import header_names as header_names
    from igtl_gateway.gateway.metadata import CHILD_FRAME_ID as CHILD_FRAME_ITEM
    from igtl_gateway.gateway.metadata import FRAME_ID as FRAME_ITEM
    from igtl_gateway.gateway.metadata import FULL_NAME as NAME_ITEM
    from igtl_gateway.gateway.metadata import OURS as OUR_ITEMS
    from igtl_gateway.gateway.metadata import STAMP as STAMP_ITEM
    from igtl_gateway.gateway.metadata import restore_metadata as restore_metadata

#: Names that are others there; the rest of the group is above.
__all__ = [
    "CHILD_FRAME_ITEM",
    "DEFINED_PACKAGES",
    "FRAME_ITEM",
    "NAME_ITEM",
    "OUR_ITEMS",
    "STAMP_ITEM",
    "VIDEO_FORMATS",
    "VIDEO_THREADS",
]

HOMES: Homes = (
    # Conversions of pictures and geometry
    ("convert.table", "TO_ROS"),
    ("convert.context", "ConvertedMessage ToIgtlContext ToRosContext"),
    ("convert.images", "image_to_igtl pixel_layout"),
    ("convert.volumes", "volume_to_image"),
    ("convert.clouds", "cloud_to_polydata colour_bytes colour_field"),
    ("convert.polydata", "polydata_to_igtl"),
    ("convert.surfaces", "has_faces has_lines marker_to_igtl mesh_to_igtl polydata_to_lines polydata_to_mesh"),
    ("convert.trajectories", "trajectories_to_igtl"),
    # Pictures and video: codings, and a library that an extra installs
    ("convert.pictures", "Coding JPEG PNG bayer_pattern coding_of demosaiced depths is_deep_png"),
    ("convert.bitstream", "is_key_frame"),
    ("convert.framesize", "frame_size"),
    ("convert.videos", "VIDEO_FORMATS=FORMATS"),
    ("edges.video.still", "decoded_still"),
    ("edges.video.worker", "MAX_PIXELS VIDEO_THREADS=THREADS import_av"),
    # Services and actions as topics
    (
        "convert.exchanges",
        "ACTION_SERVICES ACTION_TOPICS IN_ACTION OUTCOMES SERVICE_EVENT ServiceEvent action_of feedback_goal "
        "goal_states service_of",
    ),
    # Units and rotations
    ("convert.scaling", "into_ros"),
    ("convert.units", "LengthUnits ieee_754 millimetres scale"),
    ("convert.poses", "rotation_matrix unit_quaternion"),
    ("convert.structs", "Pose"),
    # Names: of devices, topics and frames; items of metadata that the gateway writes
    ("convert.names", "frames_of frames_of_name short_device_name topic_token"),
    ("convert.frames", "frame_id"),
    ("gateway", "header_names"),
    (
        "gateway.metadata",
        "CHILD_FRAME_ITEM=CHILD_FRAME_ID FRAME_ITEM=FRAME_ID NAME_ITEM=FULL_NAME OUR_ITEMS=OURS "
        "STAMP_ITEM=STAMP restore_metadata",
    ),
    # Definitions of ROS messages, and their bytes
    ("convert.interfaces", "DEFINED_PACKAGES=PACKAGES definition_folder interface_files"),
    ("convert.multi_arrays", "MULTI_ARRAYS"),
    ("convert.cdr", "CdrReader"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
