"""ROS 1 bags (``.bag``, also with bz2 and lz4 chunks): every message as the CDR of its ROS 2 type.

Where ROS 2 has the type, a message is moved over field by field: ``std_msgs/Header`` loses ``seq``, renamed fields
(``CameraInfo`` D → d) follow, and ``tf/tfMessage`` becomes ``tf2_msgs/TFMessage``.  Other types keep their own
definition, as ``package/msg/Name``.  Fields without a counterpart are named.

Memory: the index of the bag (some 100 bytes a message) and one chunk.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.convert.converter import is_same_wireformat, migrate_bytes
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from igtl_gateway.errors import DamagedRecording
from igtl_gateway.exchange.source import Item, Row, Told, reading
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Kind

#: Types that have another name in ROS 2.
RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}

_HEADER = "std_msgs/msg/Header"
_Convert = Callable[[bytes], memoryview]


class Rosbag1(Told):
    """An open ROS 1 bag.  Raises DamagedRecording."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"ROS 1 bag {path.name}", {"imported_format": "rosbag1"})
        self._path = path
        self._reader = Reader(path)
        with reading(path):
            self._reader.open()
        self._target = get_typestore(Stores.ROS2_JAZZY)
        self._known = frozenset(self._target.fielddefs)
        self._latched: set[tuple[str, str]] = set()
        self._converters: dict[int, tuple[str, str, Row, _Convert | None]] = {}
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        declared: dict[int, int] = {}
        for chunk in self._reader.chunk_infos:
            for number, count in chunk.connection_counts.items():
                declared[number] = declared.get(number, 0) + count
        rows: dict[tuple[str, str], Row] = {}
        made: dict[tuple[str, str], tuple[_Convert | None, str]] = {}
        for connection in self._reader.connections:
            topic = "/" + connection.topic.lstrip("/")
            ros_type = RENAMED.get(connection.msgtype, connection.msgtype)
            row = rows.setdefault((topic, ros_type), Row(topic, 0, ros_type))
            row.declared += declared.get(connection.id, 0)
            key = (connection.msgtype, connection.msgdef.data)
            if key not in made:
                made[key] = self._converter(connection, ros_type)
            convert, why = made[key]
            if convert is None:
                row.left_out += declared.get(connection.id, 0)
                row.why = why
            if getattr(connection.ext, "latching", None) or topic == "/tf_static":  # whose publishers always latch
                self._latched.add((topic, ros_type))
            self._converters[connection.id] = (topic, ros_type, row, convert)
        self.rows = [rows[key] for key in sorted(rows)]

    def _converter(self, connection: Connection, ros_type: str) -> tuple[_Convert | None, str]:
        """What makes CDR of this connection's messages; or None, and why nothing can."""
        source, name = get_typestore(Stores.EMPTY), connection.msgtype
        try:
            source.register(get_types_from_msg(connection.msgdef.data, name))
            if ros_type not in self._target.fielddefs:
                text = source.generate_msgdef(name, ros_version=2)[0]
                types = get_types_from_msg(text, ros_type)
                # what ROS 2 knows stays as ROS 2 has it, such as the Header
                self._target.register({key: fields for key, fields in types.items() if key not in self._known})
            if is_same_wireformat(source, self._target, name, ros_type):
                return partial(self._target.ros1_to_cdr, typename=ros_type), ""
            lost = sorted(lost_fields(source, self._target, name, ros_type))
            if lost:
                self.notes.append(f"{ros_type}: ROS 2 has no counterpart of {', '.join(lost)}")
            return partial(_migrated, source, self._target, name, ros_type, {}), ""
        except (TypesysError, KeyError, AssertionError) as error:
            return None, f"its definition cannot be used: {error}"

    def items(self) -> Iterator[Item]:
        messages = self._reader.messages()
        while True:
            try:
                connection, time_ns, data = next(messages)
            except StopIteration:
                return
            except Exception as error:  # of the library: whatever it makes of damaged bytes
                raise DamagedRecording(f"{self._path}: {type(error).__name__}: {error}") from error
            topic, ros_type, row, convert = self._converters[connection.id]
            if convert is None:
                continue
            try:
                payload = convert(data)
            except Exception as error:  # of generated code: whatever it makes of damaged bytes
                row.why = f"not convertible, the first at {time_ns} ns: {type(error).__name__}: {error}"
                continue
            row.taken += 1
            yield Item(time_ns, Kind.ROS_IN, payload, topic, ros_type)

    def qos_of(self, topic: str, ros_type: str) -> Qos | None:
        return Qos(latched=True) if (topic, ros_type) in self._latched else None

    def definition_of(self, ros_type: str) -> tuple[str, str] | None:
        if ros_type in self._known or ros_type not in self._target.fielddefs:
            return None
        return self._target.generate_msgdef(ros_type, ros_version=2)[0], self._target.hash_rihs01(ros_type)

    def close(self) -> None:
        if self._reader.bio:
            self._reader.close()


def lost_fields(
    source: Typestore, target: Typestore, old: str, new: str, seen: frozenset[str] = frozenset()
) -> set[str]:
    """Fields of ``old`` that ``new`` does not take over, as ``Type.field``; the Header's ``seq`` is known to go."""
    if old == _HEADER or old in seen:
        return set()
    before, after = dict(source.fielddefs[old][1]), dict(target.fielddefs[new][1])
    free = [kind for name, kind in after.items() if name not in before]  # where a renamed field may have gone
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
    """The message type that a field holds, alone or many of; ``""`` for plain ones."""
    kind = kind[1][0] if isinstance(kind[1], tuple) and isinstance(kind[1][0], tuple) else kind
    return kind[1] if isinstance(kind[1], str) else ""


def _migrated(
    source: Typestore, target: Typestore, old: str, new: str, cache: dict[str, object], data: bytes
) -> memoryview:
    return migrate_bytes(source, target, old, new, cache, data, src_is2=False, dst_is2=True)
