"""Definitions of ROS types in files of other programs: ``ros2msg`` text and hash, separate for each file.

The definition in the file has priority over installed ones: the bytes were written with it, and a type might have had
other fields at that time.
"""

from __future__ import annotations

from rosbags.typesys.base import TypesysError

from igtl_gateway.addon import new_store
from igtl_gateway.addon import ros_definitions as definitions


def definition(ros_type: str, text: str, encoding: str) -> tuple[str, str] | None:
    """Return ``ros2msg`` text and RIHS01 hash of a definition in ``ros2msg`` or ``ros2idl``; None without a definition.

    The hash is ``""`` if it cannot be computed, for example if the definition of a nested type is missing, or in a
    dialect that rosbags does not read.

    Raises:
        DamagedRecording: a definition that is invalid, or above the limits.
    """
    if not text.strip() or encoding not in (definitions.MSG, definitions.IDL):
        return None
    try:
        types = definitions.parse_definition(text, ros_type, encoding)
        known = {**new_store().fielddefs, **types}  # includes Time and Duration, which need no definition
        made = text if encoding == definitions.MSG else definitions.definition_text(known, ros_type)
        return made, definitions.type_hash(known, ros_type)
    except (definitions.UnreadableDefinition, TypesysError, KeyError, AssertionError):
        return (text, "") if encoding == definitions.MSG else None
