"""Definitions of ROS types as foreign files carry them: ``ros2msg`` text and hash, each file's types by themselves.

A type may have had other fields when the file was written than it has today, and the bytes follow those: so a file's
definition goes before what is known of the type otherwise.
"""

from __future__ import annotations

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

_IDL_PART = "=" * 80 + "\n"


def definition(ros_type: str, text: str, encoding: str) -> tuple[str, str] | None:
    """``ros2msg`` text and RIHS01 hash of a definition in ``ros2msg`` or ``ros2idl``; None where there is none.

    The hash is ``""`` where it cannot be computed, such as for a text without all it depends on.
    """
    if not text.strip() or encoding not in ("ros2msg", "ros2idl"):
        return None
    try:
        store = get_typestore(Stores.EMPTY)
        if encoding == "ros2msg":
            store.register(get_types_from_msg(text, ros_type))
        else:
            for part in text.split(_IDL_PART):
                head, _, body = part.partition("\n")
                if part.strip():
                    store.register(get_types_from_idl(body if head.startswith("IDL: ") else part))
        made = store.generate_msgdef(ros_type, ros_version=2)[0]
        return text if encoding == "ros2msg" else made, store.hash_rihs01(ros_type)
    except (TypesysError, KeyError, ValueError):
        return (text, "") if encoding == "ros2msg" else None
