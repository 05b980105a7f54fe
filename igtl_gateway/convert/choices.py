"""Names that a user chooses from, without the tables that they name: the command line shows them before it needs those.

A test compares them with the tables.
"""

from __future__ import annotations

#: The profile that is detected, and the names of ``profiles.PROFILES``.
AUTO = "auto"
PROFILES = (
    "default", "slicer", "plus", "plus-v1", "brainlab", "holoscan", "legacy-v1", "openigtlink4j", "openigtlink-rust",
)  # fmt: skip

#: Length units: those of ``units.UNITS``.
UNITS = ("m", "dm", "cm", "mm", "um")

#: Kinds of messages on topics: those of the rows of ``table.TO_ROS``, sorted.
KINDS = (
    "array",
    "bind",
    "buttons",
    "capability",
    "client_info",
    "color_table",
    "command",
    "command_reply",
    "compressed_image",
    "compressed_video",
    "empty",
    "float32_array",
    "float64_array",
    "image",
    "images",
    "int16_array",
    "int32_array",
    "int8_array",
    "joint_command",
    "joint_state",
    "labels",
    "landmarks",
    "lines",
    "marker",
    "mesh",
    "operating_state",
    "point",
    "points",
    "polydata",
    "pose",
    "poses",
    "query",
    "sensor",
    "slices",
    "status",
    "string",
    "string_stamped",
    "tf",
    "tracking",
    "trajectories",
    "transform",
    "twist",
    "uint16_array",
    "uint32_array",
    "uint8_array",
    "values",
    "video_frame",
    "videos",
    "volume",
    "wrench",
)
