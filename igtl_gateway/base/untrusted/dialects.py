"""The dialects of definitions of ROS types, as schemas of MCAP name them: ``ros2msg`` and ``ros2idl``.

``ros2idl`` shows itself by its beginning, so text needs no name of its dialect beside it.
"""

from __future__ import annotations

import re

MSG, IDL = "ros2msg", "ros2idl"
#: What separates a type from the next one.
RULE = "=" * 80

_IDL_HEAD = re.compile(rf"\s*(?:{RULE}[ \t]*\r?\n)?IDL: ")


def is_idl(text: str) -> bool:
    """Return whether a definition is ``ros2idl``, by its beginning."""
    return bool(_IDL_HEAD.match(text))


def readable(data: bytes, encoding: str, ros_type: str) -> str:
    """Return a definition as text that shows its dialect; its comments might be in any character set."""
    text = data.decode("utf-8", "replace")
    return f"{RULE}\nIDL: {ros_type}\n{text}" if encoding == IDL and not is_idl(text) else text
