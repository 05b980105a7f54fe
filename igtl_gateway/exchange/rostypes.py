"""Definitions of ROS types as foreign files carry them: ``ros2msg`` text and hash, each file's types by themselves.

A type may have had other fields when the file was written than it has today, and the bytes follow those: so a file's
definition goes before what is known of the type otherwise.
"""

from __future__ import annotations

from rosbags.typesys.base import TypesysError

from igtl_gateway.untrusted import definitions
from igtl_gateway.untrusted.decoding import new_store


def definition(ros_type: str, text: str, encoding: str) -> tuple[str, str] | None:
    """``ros2msg`` text and RIHS01 hash of a definition in ``ros2msg`` or ``ros2idl``; None where there is none.

    The hash is ``""`` where it cannot be computed, such as for a text without all it depends on, or in a dialect that
    rosbags does not read.

    Raises:
        DamagedRecording: a definition that no type can have, or that is above the limits.
    """
    if not text.strip() or encoding not in (definitions.MSG, definitions.IDL):
        return None
    try:
        types = definitions.parse_definition(text, ros_type, encoding)
        known = {**new_store().fielddefs, **types}  # Time and Duration are known without a definition
        made = text if encoding == definitions.MSG else definitions.definition_text(known, ros_type)
        return made, definitions.type_hash(known, ros_type)
    except (definitions.UnreadableDefinition, TypesysError, KeyError, AssertionError):
        return (text, "") if encoding == definitions.MSG else None
