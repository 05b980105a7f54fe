"""Definitions of ROS message types for the file: ``ros2msg`` text and type hash.

Searched in this order: the types of the recording itself; the types of ROS 2 Jazzy that rosbags contains (no
installation needed); the ``.msg`` files of the installation, which are in ``share/PACKAGE/msg/`` under each folder of
``AMENT_PREFIX_PATH`` and under ``sys.prefix`` (where the ROS wheels put them); the files of this package
(``ros_interfaces``).
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import TypesysError

from igtl_gateway.base.errors import RecordingError
from igtl_gateway.base.untrusted import definitions, files
from igtl_gateway.convert.interfaces import SHARES
from igtl_gateway.record.sessionfile.layout import OWN_TYPES

_TYPE_NAME = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)
#: The type of the feedback of an action, whose ``.action`` file has the fields behind its second separator.
_FEEDBACK = re.compile(r"([A-Za-z]\w*)/action/([A-Za-z]\w*)_FeedbackMessage", re.ASCII)
_SEPARATOR = re.compile(r"^---[ \t]*$", re.MULTILINE)
_PARTS_OF_AN_ACTION = 3


@dataclass(frozen=True, slots=True)
class Definition:
    """The definition of a message type in a file.

    Attributes:
        text: the definition with all it depends on, as in ``ros2msg`` schemas.
        type_hash: REP-2016 hash, ``RIHS01_…``.
    """

    text: str
    type_hash: str


class RosTypes:
    """Finds definitions, and keeps them.

    Args:
        shares: folders with ``PACKAGE/msg/NAME.msg``; default: those of the installation, then our own.
    """

    def __init__(self, shares: Sequence[Path] | None = None) -> None:
        self._types = dict(get_typestore(Stores.ROS2_JAZZY).fielddefs)
        self._shares = (*installed_shares(), *SHARES) if shares is None else tuple(shares)
        for name, text in OWN_TYPES.items():
            self._types |= definitions.parse_definition(text, name)

    def find(self, ros_type: str) -> Definition | None:
        """The definition of ``package/msg/Name``, or of the feedback of an action; None where it is not complete."""
        try:
            if not self._load(ros_type):
                return None
            return Definition(
                definitions.definition_text(self._types, ros_type), definitions.type_hash(self._types, ros_type)
            )
        except (TypesysError, RecordingError, UnicodeDecodeError, KeyError):
            # a file that is unreadable, or in a dialect that rosbags does not know
            return None

    def service_hash(self, ros_type: str, text: str) -> str:
        """The REP-2016 hash of the service ``package/srv/Name`` by its ``.srv`` text.

        Raises RecordingError or KeyError for a definition that cannot be read.
        """
        for part in definitions.halves(text):
            for _, fields in definitions.parse_definition(
                f"{part}\nuint8 x\n", ros_type.replace("/srv/", "/msg/")
            ).values():
                for name in definitions.types_of_fields(fields):
                    self._load(name)
        return definitions.service_hash(self._types, ros_type, text)

    def _load(self, ros_type: str) -> bool:
        """Find the type and all types that it needs."""
        found: dict[str, Any] = {}
        wanted = [ros_type]
        while wanted:
            name = wanted.pop()
            if name in self._types or name in found:
                continue
            text = self._text(name)
            if text is None:
                return False
            types = definitions.parse_definition(text, name)
            found.update(types)
            for _, fields in types.values():
                wanted += definitions.types_of_fields(fields)
        self._types |= found
        return True

    def _text(self, ros_type: str) -> str | None:
        if _TYPE_NAME.fullmatch(ros_type):
            return self._file(f"{ros_type}.msg")
        if feedback := _FEEDBACK.fullmatch(ros_type):
            package, name = feedback.groups()
            parts = _SEPARATOR.split(self._file(f"{package}/action/{name}.action") or "")
            own = f"{package}/{name}_Feedback"
            head = f"unique_identifier_msgs/UUID goal_id\n{own} feedback\n{'=' * 80}\nMSG: {own}\n"
            return head + parts[2] if len(parts) == _PARTS_OF_AN_ACTION else None
        return None

    def _file(self, name: str) -> str | None:
        """A definition file of the first folder that has it.  Raises UnicodeDecodeError."""
        paths = (share / name for share in self._shares)
        found = next((path for path in paths if path.is_file()), None)
        return files.read_bytes(found).decode("utf-8") if found else None


def installed_shares() -> tuple[Path, ...]:
    """The ``share`` folders of the ROS installation, the overlay first."""
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    return tuple(Path(prefix) / "share" for prefix in prefixes if prefix)
