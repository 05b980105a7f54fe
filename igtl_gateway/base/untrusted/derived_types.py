"""Messages that rosidl derives from a service or an action: events of introspection, and feedback.

No file has their definitions: a ``.srv`` has the fields of request and response, an ``.action`` those of goal, result
and feedback.  rosbag2 writes such a file where a definition is expected, behind a line ``SRV: package/srv/Name``, and
nothing for most messages of actions.  From here comes the text of the message itself, which all readers of ``ros2msg``
read; so nested types have two parts in their names, ``package/Name_Request``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from igtl_gateway.base.untrusted.dialects import RULE

_TYPE = re.compile(r"([A-Za-z]\w*)/(srv|action)/([A-Za-z][A-Za-z0-9]*)_(\w+)", re.ASCII)
_FILE = re.compile(r"[A-Za-z]\w*/(srv|action)/[A-Za-z][A-Za-z0-9]*", re.ASCII)
_BETWEEN = re.compile(r"^---[ \t\r]*$", re.MULTILINE)
_HEAD = re.compile(rf"\s*{RULE}[ \t]*\r?\n(?:SRV|ACTION): [^\n]*\n")
_PARTS = {"srv": 2, "action": 3}
_GOAL_ID = "unique_identifier_msgs/UUID goal_id\n"
#: Of each message: its fields; then the suffixes of its types, each with its fields or the number of their part.
_EVENT = "service_msgs/ServiceEventInfo info\n{of}_Request[<=1] request\n{of}_Response[<=1] response\n"
_MESSAGES: dict[tuple[str, str], tuple[str, tuple[tuple[str, str | int], ...]]] = {
    ("srv", "Event"): (_EVENT, (("Request", 0), ("Response", 1))),
    ("action", "FeedbackMessage"): (f"{_GOAL_ID}{{of}}_Feedback feedback\n", (("Feedback", 2),)),
    ("action", "SendGoal_Event"): (
        _EVENT.replace("{of}", "{of}_SendGoal"),
        (
            ("SendGoal_Request", f"{_GOAL_ID}{{of}}_Goal goal\n"),
            ("SendGoal_Response", "bool accepted\nbuiltin_interfaces/Time stamp\n"),
            ("Goal", 0),
        ),
    ),
    ("action", "GetResult_Event"): (
        _EVENT.replace("{of}", "{of}_GetResult"),
        (
            ("GetResult_Request", _GOAL_ID),
            ("GetResult_Response", "int8 status\n{of}_Result result\n"),
            ("Result", 1),
        ),
    ),
}
#: What the text of rosbag2 leaves out: the types that rosidl adds.
_ADDED = {
    "service_msgs/ServiceEventInfo": "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\n"
    "int64 sequence_number\n",
    "unique_identifier_msgs/UUID": "uint8[16] uuid\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
}


@dataclass(frozen=True, slots=True)
class DerivedType:
    """A message of a service or an action.

    Attributes:
        package, kind, name: of the file that has its fields: ``PACKAGE/KIND/NAME.KIND``.
        suffix: what the message is of it.
    """

    package: str
    kind: str
    name: str
    suffix: str

    @classmethod
    def of(cls, ros_type: str) -> DerivedType | None:
        """Of ``package/srv/Name_Event``, ``package/action/Name_FeedbackMessage``, …; None for other types."""
        found = _TYPE.fullmatch(ros_type)
        return cls(*found.groups()) if found and found.group(2, 4) in _MESSAGES else None

    @property
    def file(self) -> str:
        """The place of the definition in a ``share`` folder."""
        return f"{self.package}/{self.kind}/{self.name}.{self.kind}"

    def text(self, definition: str) -> str | None:
        """The ``ros2msg`` text of the message, without the types of other files; None if there are other parts."""
        parts = _BETWEEN.split(definition)
        if len(parts) != _PARTS[self.kind]:
            return None
        own = f"{self.package}/{self.name}"
        fields, nested = _MESSAGES[self.kind, self.suffix]
        sections = [fields.format(of=own)]
        for suffix, content in nested:
            of_part = parts[content] if isinstance(content, int) else content.format(of=own)
            sections.append(f"MSG: {own}_{suffix}\n{of_part}")
        return _joined(sections)

    def true_name(self, name: str) -> str:
        """The name in ROS of one of the types of :meth:`text`."""
        own = f"{self.package}/msg/{self.name}_"
        nested = [suffix for suffix, _ in _MESSAGES[self.kind, self.suffix][1]]
        is_own = name.startswith(own) and name[len(own) :] in nested
        return f"{self.package}/{self.kind}/{self.name}_{name[len(own) :]}" if is_own else name


def messages_of(ros_type: str) -> list[str]:
    """Return the messages that a definition of a type is for: of a service or an action, those of its topics."""
    of_file = _FILE.fullmatch(ros_type)
    if not of_file:
        return [ros_type]
    return [f"{ros_type}_{suffix}" for kind, suffix in _MESSAGES if kind == of_file[1]]


def is_of_file(text: str) -> bool:
    """Return whether a definition is that of a service or an action, and not of a message."""
    return bool(_HEAD.match(text)) or bool(_BETWEEN.search(text.partition(f"{RULE}\n")[0]))


def as_message(text: str, ros_type: str) -> str:
    """Return the definition of a derived message, where ``text`` is that of its file; other text as it is."""
    derived = DerivedType.of(ros_type)
    if derived is None or not is_of_file(text):
        return text
    head = _HEAD.match(text)
    body, *others = re.split(rf"^{RULE}[ \t]*\r?\n", text[head.end() if head else 0 :], flags=re.MULTILINE)
    made = derived.text(body)
    if made is None:
        return text
    there = {line.partition(" ")[2].strip().replace("/msg/", "/") for each in others for line in each.splitlines()[:1]}
    sections = [made, *others]
    for name, fields in _ADDED.items():
        if name not in there and any(name in each for each in sections):
            sections.append(f"MSG: {name}\n{fields}")
    return _joined(sections)


def _joined(sections: Sequence[str]) -> str:
    whole = (each if each.endswith("\n") else f"{each}\n" for each in sections)
    return f"{RULE}\n".join(whole).replace("\r\n", "\n")  # of Windows, which rosbags refuses
