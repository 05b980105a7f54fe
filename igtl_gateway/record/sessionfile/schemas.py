"""Definitions of ROS message types for the file: the bytes of their own files, and the type hash.

Searched in this order: the types of the recording itself; the files of the installation, which are in
``share/PACKAGE/msg/`` under each folder of ``AMENT_PREFIX_PATH`` and under ``sys.prefix`` (where the ROS wheels put
them); the files of this package (``ros_interfaces``); the types of ROS 2 Jazzy that rosbags contains, for machines
without an installation.

A definition is written as rosbag2 writes it: the ``.msg`` file as it is, behind it those that it needs; where one of
them is missing, the ``.idl`` files.  It is written also if it cannot be read here, since other programs might.  The
hash is that of the ``.json`` file beside it, which rosidl has installed; without one it is computed.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import TypesysError

from igtl_gateway.base.errors import RecordingError
from igtl_gateway.base.untrusted import definitions, files
from igtl_gateway.base.untrusted.derived_types import DerivedType
from igtl_gateway.base.untrusted.dialects import IDL, MSG, RULE
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.convert.interfaces import SHARES
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.layout import OWN_TYPES

_TYPE_NAME = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)
_HASH = re.compile(r"RIHS01_[0-9a-f]{64}")
#: Files of one definition, and bytes of all of them: more than any real one has.
_MOST_FILES, _MOST_BYTES = 1000, 4 << 20
_HEADER, _STD_HEADER = "msg/Header", "std_msgs/msg/Header"


class RosTypes:
    """Finds definitions, and keeps them.

    Args:
        shares: folders with ``PACKAGE/msg/NAME.msg``; default: those of the installation, then our own.
    """

    def __init__(self, shares: Sequence[Path] | None = None) -> None:
        self._types = dict(get_typestore(Stores.ROS2_JAZZY).fielddefs)
        self._shares = (*installed_shares(), *SHARES) if shares is None else tuple(shares)
        self._found: dict[str, Definition | None] = {}
        with limits_in_force(FileLimits()):  # a user's limits are of the file that is read, these are our own
            for name, text in OWN_TYPES.items():
                self._types |= definitions.parse_definition(text, name)

    def find(self, ros_type: str) -> Definition | None:
        """The definition of ``package/msg/Name``, or of a `DerivedType`; None where it is not complete."""
        if ros_type not in self._found:
            self._found[ros_type] = self._of_files(ros_type)
        return self._found[ros_type]

    def service_hash(self, ros_type: str, text: str) -> str:
        """The REP-2016 hash of the service ``package/srv/Name`` by its ``.srv`` text.

        Raises RecordingError or KeyError for a definition that cannot be read.
        """
        known = dict(self._types)
        for part in definitions.halves(text):
            for _, fields in definitions.parse_definition(part, ros_type.replace("/srv/", "/msg/")).values():
                for name in definitions.types_of_fields(fields):
                    if name not in known and (found := self.find(name)):
                        known |= definitions.parse_definition(found.text(name), name)
        return definitions.service_hash(known, ros_type, text)

    def _of_files(self, ros_type: str) -> Definition | None:
        for encoding in (MSG, IDL):
            try:
                texts = self._texts(ros_type, encoding)
            except (OSError, RecordingError, ValueError):  # a file that cannot be read, or is no text of any kind
                texts = {}
            if texts:
                found = Definition(_joined(texts, encoding), encoding)
                return replace(found, type_hash=self._hash_of(ros_type, found.text(ros_type)))
        return None

    def _texts(self, ros_type: str, encoding: str) -> dict[str, bytes]:
        """The type and all that it needs, by name; empty if one of them is missing."""
        found: dict[str, bytes] = {}
        wanted, size = [ros_type], 0
        while wanted:
            name = wanted.pop(0)
            if name in found:
                continue
            data = self._text(name, encoding)
            if data is None:
                if not name.endswith(_HEADER) or name == _STD_HEADER:
                    return {}
                wanted.insert(0, _STD_HEADER)  # a Header without a package
                continue
            found[name], size = data, size + len(data)
            if len(found) > _MOST_FILES or size > _MOST_BYTES:
                return {}
            wanted += definitions.needs_of_file(data.decode("utf-8", "replace"), name, encoding)
        return found

    def _text(self, ros_type: str, encoding: str) -> bytes | None:
        if encoding == IDL:
            return self._file(f"{ros_type}.idl") if _TYPE_NAME.fullmatch(ros_type) else None
        if own := OWN_TYPES.get(ros_type):  # our messages are what this version writes
            return own.encode()
        if _TYPE_NAME.fullmatch(ros_type):
            data = self._file(f"{ros_type}.msg")
            return self._known(ros_type) if data is None else data
        if derived := DerivedType.of(ros_type):
            text = derived.text((self._file(derived.file) or b"").decode("utf-8", "replace"))
            return text.encode() if text else None
        return None

    def _known(self, ros_type: str) -> bytes | None:
        """The text of a type of ROS 2 Jazzy that is not installed here."""
        if ros_type not in self._types:
            return None
        return definitions.definition_text(self._types, ros_type).partition(f"{RULE}\n")[0].encode()

    def _file(self, name: str) -> bytes | None:
        """A definition file of the first folder that has it."""
        found = self._place(name)
        return files.read_bytes(found) if found else None

    def _place(self, name: str) -> Path | None:
        return next((path for share in self._shares if (path := share / name).is_file()), None)

    def _hash_of(self, ros_type: str, text: str) -> str:
        if stated := self._stated_hash(ros_type):
            return stated
        try:
            known: dict[str, Any] = {**self._types, **definitions.parse_definition(text, ros_type)}
            return definitions.type_hash(known, ros_type)
        except (TypesysError, RecordingError, KeyError):
            return ""  # it cannot be read here

    def _stated_hash(self, ros_type: str) -> str:
        """The hash in the ``.json`` file beside the definition."""
        if ros_type in OWN_TYPES:
            return ""
        derived = DerivedType.of(ros_type)
        names = [derived.file] if derived else [f"{ros_type}.msg", f"{ros_type}.idl"]
        place = next((each for name in names if (each := self._place(name))), None)
        try:
            rows = json.loads(files.read_bytes(place.with_suffix(".json")))["type_hashes"] if place else []
            stated = {row["type_name"]: row["hash_string"] for row in rows}.get(ros_type, "")
        except (OSError, RecordingError, ValueError, KeyError, TypeError, AttributeError):
            return ""
        return stated if isinstance(stated, str) and _HASH.fullmatch(stated) else ""


def _joined(texts: dict[str, bytes], encoding: str) -> bytes:
    """Definition files behind each other, as rosbag2 joins them."""
    parts = []
    for number, (name, data) in enumerate(texts.items()):
        package, _, last = name.partition("/msg/")
        if encoding == IDL:
            parts.append(f"{RULE}\nIDL: {name}\n".encode())
        elif number:
            parts.append(f"{RULE}\nMSG: {package}/{last}\n".encode())
        parts.append(data if not data or data.endswith(b"\n") else data + b"\n")
    return b"".join(parts)


def installed_shares() -> tuple[Path, ...]:
    """The ``share`` folders of the ROS installation, the overlay first."""
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    return tuple(Path(prefix) / "share" for prefix in prefixes if prefix)
