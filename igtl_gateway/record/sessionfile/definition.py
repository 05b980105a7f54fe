"""The definition of a message type as a file has it, and files with several definitions of one type."""

from __future__ import annotations

from dataclasses import dataclass, field

from igtl_gateway.base.untrusted.derived_types import DerivedType, as_message, is_of_file
from igtl_gateway.base.untrusted.dialects import IDL, MSG, readable

#: A definition of a message without fields, such as std_msgs/msg/Empty: an empty text would look like none.
NO_FIELDS = "# no fields\n"


@dataclass(frozen=True, slots=True)
class Definition:
    """The definition of a message type in a file.

    Attributes:
        data: the definition with all it depends on, as in schemas of MCAP.
        encoding: its dialect: ``ros2msg`` or ``ros2idl``; rosbag2 has ``unknown`` for a service without other types.
        type_hash: REP-2016 hash, ``RIHS01_…``; ``""`` if it is not known.
    """

    data: bytes
    encoding: str = MSG
    type_hash: str = ""

    def text(self, ros_type: str) -> str:
        """Return the definition for the readers of this program, which see its dialect from its beginning.

        Of an event or a feedback it is that of the message, also where the file has that of the service or action.
        """
        text = as_message(readable(self.data, self.encoding, ros_type), ros_type)
        return text or ("" if DerivedType.of(ros_type) else NO_FIELDS)

    def file_hash(self, ros_type: str) -> str:
        """Return the hash as a file has it: none of an event or a feedback.

        Of their types rosbags (0.11) computes another one, and then it opens no message of the file.
        """
        return "" if DerivedType.of(ros_type) else self.type_hash

    def is_read(self, ros_type: str) -> bool:
        """Return whether readers of this program know its dialect."""
        if self.encoding in (MSG, IDL):
            return True
        return DerivedType.of(ros_type) is not None and is_of_file(readable(self.data, self.encoding, ros_type))


@dataclass(slots=True)
class FileDefinitions:
    """The definitions of a file, one for each type: the first.

    A message is decoded with the definition of its type, so what was written with another one is not read at all.

    Attributes:
        known: type → definition.
    """

    known: dict[str, Definition] = field(default_factory=dict)
    _others: dict[tuple[str, bytes, str], bool] = field(default_factory=dict)

    def takes(self, ros_type: str, found: Definition) -> bool:
        """Return whether a definition of a type equals the first one of this type; keep the first one."""
        if not found.is_read(ros_type):
            return True
        first = self.known.get(ros_type)
        if first is None or (not first.data and found.data):
            self.known[ros_type] = found
            return True
        if first.data == found.data or not found.data:
            return True
        key = ros_type, found.data, found.encoding
        if key not in self._others:
            from igtl_gateway.base.untrusted.definitions import is_same  # rosbags, which few readers need

            self._others[key] = is_same(first.text(ros_type), found.text(ros_type), ros_type)
        return self._others[key]

    def texts(self) -> dict[str, str]:
        """Return the definitions as text, see `Definition.text`."""
        return {name: each.text(name) for name, each in self.known.items()}


def another_definition(ros_type: str) -> str:
    """Return why messages with another definition of their type are not read."""
    return f"another definition of {ros_type} than the first one of the file"
