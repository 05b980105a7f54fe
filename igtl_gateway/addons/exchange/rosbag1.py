"""Import of ROS 1 bags (``.bag``, also with bz2 and lz4 chunks): every message becomes CDR of its ROS 2 type.

If ROS 2 has the type, the message is converted field by field: ``std_msgs/Header`` loses ``seq``, renamed fields
(``CameraInfo`` D → d) are converted, and ``tf/tfMessage`` becomes ``tf2_msgs/TFMessage``.  Other types keep their own
definition, as ``package/msg/Name``.  Notes list the fields without a counterpart, and names that ROS 2 does not allow.

The times of ROS 2 end on 2038-01-19: a message with a later one is missing in the account.

If a definition cannot be used, only its topics are left out, and their rows have the reason.

Memory: that of ``rosbag1_file``, and one message.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.convert.converter import is_same_wireformat, migrate_bytes
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from igtl_gateway.addon import DamagedRecording
from igtl_gateway.addon.reading import Kind, Qos, StampPlaces
from igtl_gateway.addon.untrusted import ElementCounter, Types, code_size, limits, new_store, register_types
from igtl_gateway.addon.untrusted import ros_definitions as definitions
from igtl_gateway.addon.writing import Definition
from igtl_gateway.addons.exchange.rosbag1_file import BagConnection, BagFile
from igtl_gateway.addons.exchange.rostypes import names_not_allowed
from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream, NonRosSource

#: Type → its different name in ROS 2.
RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}

_HEADER = "std_msgs/msg/Header"
_NUMBER = (Nodetype.BASE, ("uint32", 0))
#: Types that every ROS 1 program knows, as their bytes are: definitions do not contain ``time`` and ``duration``.
_ROS1_TYPES: Types = {
    "builtin_interfaces/msg/Time": ([], [("sec", _NUMBER), ("nanosec", _NUMBER)]),
    "builtin_interfaces/msg/Duration": ([], [("sec", _NUMBER), ("nanosec", _NUMBER)]),
    _HEADER: (
        [],
        [
            ("seq", _NUMBER),
            ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time")),
            ("frame_id", (Nodetype.BASE, ("string", 0))),
        ],
    ),
}
_SECONDS = struct.Struct("<i")
_Convert = Callable[[bytes], memoryview]


class Rosbag1(NonRosSource):
    """An open ROS 1 bag.  Raises UnsupportedRecording, DamagedRecording."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"ROS 1 bag {path.name}", {"imported_format": "rosbag1"})
        self._target = new_store(Stores.ROS2_JAZZY)
        self._known = frozenset(self._target.fielddefs)
        self._fields = 0
        self._latched: set[tuple[str, str]] = set()
        self._converters: dict[int, tuple[str, str, ImportedStream, _Convert | None]] = {}
        self._texts: dict[str, str] = {}
        self._times = StampPlaces(self._texts, all_times=True)
        self._bag = BagFile(path)
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        declared: dict[int, int] = {}
        for chunk in self._bag.chunks:
            for number, count in chunk.counts.items():
                declared[number] = declared.get(number, 0) + count
        rows: dict[tuple[str, str], ImportedStream] = {}
        converters: dict[tuple[str, str], tuple[_Convert | None, str]] = {}
        for connection in self._bag.connections:
            topic = "/" + "/".join(word for word in connection.topic.split("/") if word)
            name = ros2_name(connection.ros1_type)
            ros_type = RENAMED.get(name, name)
            row = rows.setdefault((topic, ros_type), ImportedStream(topic, 0, ros_type))
            row.declared += declared.get(connection.number, 0)
            key = (name, connection.definition)
            if key not in converters:
                converters[key] = self._converter(connection, name, ros_type)
                if names := names_not_allowed(self._target.fielddefs, ros_type):
                    self.notes.append(f"{ros_type}: {names}")
            convert, why = converters[key]
            if convert is None:
                row.left_out += declared.get(connection.number, 0)
                row.why = why
            if connection.latching or topic == "/tf_static":  # its publishers always latch
                self._latched.add((topic, ros_type))
            self._converters[connection.number] = (topic, ros_type, row, convert)
        self.rows = [rows[key] for key in sorted(rows)]

    def _converter(self, connection: BagConnection, name: str, ros_type: str) -> tuple[_Convert | None, str]:
        """Return the function that converts messages of a connection to CDR and ``""``; or None and the reason."""
        try:
            types = definitions.parse_definition(connection.definition, name)
            source = new_store()
            source.fielddefs.update(types)
            if ros_type not in self._target.fielddefs:
                own = definitions.parse_definition(definitions.definition_text(source.fielddefs, name), ros_type)
                # types that ROS 2 has, such as Header, keep the definition of ROS 2
                self._register(self._target, {key: fields for key, fields in own.items() if key not in self._known})
                self._texts[ros_type] = definitions.definition_text(self._target.fielddefs, ros_type)
            if is_same_wireformat(source, self._target, name, ros_type):
                elements = ElementCounter({**types, **_ROS1_TYPES}, name, ros1=True)
                return partial(_rewritten, self._target, ros_type, elements), ""
            source = new_store()
            self._register(source, types)
            elements = ElementCounter({**_ROS1_TYPES, **types}, name, ros1=True)
            lost = sorted(lost_fields(source, self._target, name, ros_type))
            if lost:
                self.notes.append(f"{ros_type}: ROS 2 has no counterpart of {', '.join(lost)}")
            return partial(_migrated, source, self._target, name, ros_type, {}, elements), ""
        except (DamagedRecording, TypesysError, KeyError, AssertionError) as error:
            return None, f"its definition cannot be used: {error}"

    def _register(self, store: Typestore, types: Types) -> None:
        self._fields += sum(map(code_size, types.values()))
        limits.check_limit("fields", self._fields, "definitions of the bag", 2 * limits.current_limits().fields)
        register_types(store, types)

    def items(self) -> Iterator[ImportedItem]:
        for message in self._bag.messages():
            if message.connection not in self._converters:
                raise DamagedRecording(
                    f"{self.title}: found a message of connection {message.connection}, which is not in the index"
                )
            topic, ros_type, row, convert = self._converters[message.connection]
            if convert is None:
                continue
            try:
                payload = convert(message.data)
                self._check_times(ros_type, payload)
            except Exception as error:  # generated code raises many types of errors for damaged bytes
                reason = f"{type(error).__name__}: {error}"
                row.why = f"some cannot be converted, the latest at {message.time_ns} ns: {reason}"
                continue
            row.taken += 1
            yield ImportedItem(message.time_ns, Kind.ROS_IN, payload, topic, ros_type)

    def _check_times(self, ros_type: str, payload: memoryview) -> None:
        """Raise OverflowError for a time that ROS 2 takes for one before 1970."""
        for place in self._times.of(ros_type, payload) or ():
            (seconds,) = _SECONDS.unpack_from(payload, place)
            if seconds < 0:
                raise OverflowError(f"found a time of {seconds + (1 << 32)} s, expected at most {(1 << 31) - 1} (2038)")

    def qos_of(self, topic: str, ros_type: str) -> Qos | None:
        return Qos(latched=True) if (topic, ros_type) in self._latched else None

    def definition_of(self, ros_type: str) -> Definition | None:
        if ros_type in self._known or ros_type not in self._target.fielddefs:
            return None
        types = self._target.fielddefs
        try:
            text, type_hash = definitions.definition_text(types, ros_type), definitions.type_hash(types, ros_type)
        except (TypesysError, KeyError):
            return None  # the definition of a nested type is missing
        return Definition(text.encode(), definitions.MSG, type_hash)

    def close(self) -> None:
        self._bag.close()


def ros2_name(ros1_type: str) -> str:
    """Return ``package/Name`` as ``package/msg/Name``."""
    package, slash, name = ros1_type.partition("/")
    return f"{package}/msg/{name}" if slash and "/" not in name else ros1_type


def lost_fields(
    source: Typestore, target: Typestore, old: str, new: str, seen: frozenset[str] = frozenset()
) -> set[str]:
    """Return the fields of ``old`` without a counterpart in ``new``, as ``Type.field``; except ``seq`` of Header."""
    if old == _HEADER or old in seen:
        return set()
    before, after = dict(source.fielddefs[old][1]), dict(target.fielddefs[new][1])
    free = [kind for name, kind in after.items() if name not in before]  # possible new names of renamed fields
    lost = set()
    for name, kind in before.items():
        if name not in after:
            if kind in free:
                free.remove(kind)
            else:
                lost.add(f"{old}.{name}")
            continue
        inner, outer = _name_in(kind), _name_in(after[name])
        if inner and outer:
            lost |= lost_fields(source, target, inner, outer, seen | {old})
    return lost


def _name_in(kind: Any) -> str:
    """Return the message type of a field, of a single message or an array; ``""`` for basic types."""
    kind = kind[1][0] if isinstance(kind[1], tuple) and isinstance(kind[1][0], tuple) else kind
    return kind[1] if isinstance(kind[1], str) else ""


def _rewritten(target: Typestore, ros_type: str, elements: ElementCounter, data: bytes) -> memoryview:
    elements.check(data)
    return target.ros1_to_cdr(data, typename=ros_type)


def _migrated(
    source: Typestore,
    target: Typestore,
    old: str,
    new: str,
    cache: dict[str, object],
    elements: ElementCounter,
    data: bytes,
) -> memoryview:
    elements.check(data)
    return migrate_bytes(source, target, old, new, cache, data, src_is2=False, dst_is2=True)
