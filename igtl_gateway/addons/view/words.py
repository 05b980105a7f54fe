"""Text, status, commands, lists: each message is a line in the log of the session, unless it is the same again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import rerun as rr

from igtl_gateway.addon import ConversionError, RecordingError, ros
from igtl_gateway.addon.messages import OUTCOMES, ServiceEvent, feedback_goal, goal_states
from igtl_gateway.addon.reading import Buffer
from igtl_gateway.addon.ros import DiagnosticStatus, Empty, Log, OperatingState, String, StringStamped
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.view.canvas import Canvas

#: Last part of the topic of a URDF (robot_state_publisher).
ROBOT_DESCRIPTION = "robot_description"

_LEVELS = ("INFO", "WARN", "ERROR", "WARN")
_MAX_LINE = 300
_ROS_WARN, _ROS_ERROR = 30, 40
_QUERIES = {1: "GET", 2: "START", 3: "STOP", 4: "REPLY"}
_STEPS = ("client sends request", "server receives request", "server sends response", "client receives response")
_REPLIES = {1: "success", 2: "failed", 3: "no reply in time", 4: "no peer"}


def draw_string(message: String, canvas: Canvas) -> None:
    """std_msgs/String: the text unchanged; a robot description is drawn as a robot, too."""
    namespace, _, name = canvas.shown.topic.rpartition("/")
    if name != ROBOT_DESCRIPTION:
        _log_text(canvas, message.data)
        return
    canvas.log(rr.TextDocument(canvas.pen.displayable(message.data)))
    try:
        canvas.robots.describe(message.data, namespace, canvas)
    except RecordingError as error:
        raise ConversionError(str(error)) from None


def draw_status(message: DiagnosticStatus, canvas: Canvas) -> None:
    """diagnostic_msgs/DiagnosticStatus."""
    level = _LEVELS[min(message.level, len(_LEVELS) - 1)]
    _log_text(canvas, f"{message.name} {message.message}".strip(), level)


def draw_state(message: OperatingState, canvas: Canvas) -> None:
    """crtk_msgs/OperatingState: a fault is an error."""
    level = _LEVELS[2 if message.state == "FAULT" else 0]
    words = (message.state, *(["homed"] if message.is_homed else []), *(["busy"] if message.is_busy else []))
    _log_text(canvas, " ".join(words), level)


def draw_stamped_string(message: StringStamped, canvas: Canvas) -> None:
    """crtk_msgs/StringStamped."""
    _log_text(canvas, message.string)


def draw_empty(_message: Empty, canvas: Canvas) -> None:
    """std_msgs/Empty: that it came."""
    _log_text(canvas, "(empty)")


def draw_log(message: Log, canvas: Canvas) -> None:
    """rcl_interfaces/Log: levels are 10 (debug), 20, 30, 40, 50 (fatal)."""
    level = _LEVELS[(message.level >= _ROS_WARN) + (message.level >= _ROS_ERROR)]
    _log_text(canvas, f"{message.name}: {message.msg}", level)


def draw_command(message: ros.Command, canvas: Canvas) -> None:
    """igtl_msgs/Command."""
    _log_text(canvas, f"command {message.id} {message.name!r}: {message.content}")


def draw_reply(message: ros.CommandReply, canvas: Canvas) -> None:
    """igtl_msgs/CommandReply."""
    good = message.status == message.SUCCESS
    outcome = _REPLIES.get(message.status, str(message.status))
    text = f"reply to {message.id} {message.name!r}: {outcome} {message.error_message} {message.content}".strip()
    _log_text(canvas, text, _LEVELS[0] if good else _LEVELS[1])


def draw_query(message: ros.Query, canvas: Canvas) -> None:
    """igtl_msgs/Query."""
    kind = _QUERIES.get(message.kind, str(message.kind))
    _log_text(canvas, f"{kind} {message.type} {message.device_name}".strip())


def draw_metadata(message: ros.Metadata, canvas: Canvas) -> None:
    """igtl_msgs/Metadata."""
    items = [f"{item.key} = {item.value}" for item in message.items]
    _list(canvas, f"metadata of {message.type} {message.device_name}", items)


def draw_capability(message: ros.Capability, canvas: Canvas) -> None:
    """igtl_msgs/Capability."""
    _list(canvas, "reads", message.types)


def draw_links(message: ros.LinkStatusList, canvas: Canvas) -> None:
    """igtl_msgs/LinkStatusList."""
    rows = [
        f"{link.link}: {link.peer} {'connected' if link.connected else 'gone'}, {link.profile}, "
        f"header version {link.header_version}"
        for link in message.links
    ]
    _list(canvas, "peers", rows)


def draw_bind(message: ros.Bind, canvas: Canvas) -> None:
    """igtl_msgs/Bind."""
    _list(canvas, "bundle", [f"{child.type} {child.name}" for child in message.children])


def draw_images(message: ros.ImageMetaList, canvas: Canvas) -> None:
    """igtl_msgs/ImageMetaList: names and sizes, without patient data."""
    _list(canvas, "images", [f"{each.name} ({each.device_name}) {_size(each.size)}" for each in message.images])


def draw_labels(message: ros.LabelMetaList, canvas: Canvas) -> None:
    """igtl_msgs/LabelMetaList."""
    _list(canvas, "labels", [f"{each.label} {each.name} {_size(each.size)}" for each in message.labels])


def draw_videos(message: ros.VideoMetaList, canvas: Canvas) -> None:
    """igtl_msgs/VideoMetaList."""
    _list(canvas, "videos", [f"{each.name} ({each.device_name}) {_size(each.size)}" for each in message.videos])


def draw_raw(message: ros.RawMessage, canvas: Canvas) -> None:
    """igtl_msgs/RawMessage: bytes of a type without a conversion."""
    _log_text(canvas, f"{message.type} {message.device_name}: {counted(memoryview(message.data).nbytes, 'byte')}")


@dataclass(frozen=True, slots=True)
class GoalStates:
    """action_msgs/GoalStatusArray: id and status of each goal that a server knows."""

    TYPE: ClassVar[str] = "action_msgs/msg/GoalStatusArray"
    goals: tuple[tuple[bytes, int], ...]

    @classmethod
    def unpack(cls, cdr: Buffer) -> GoalStates:
        """Raises ConversionError."""
        return cls(tuple(goal_states(cdr)))


@dataclass(frozen=True, slots=True)
class Feedback:
    """The feedback of an action: the id of its goal."""

    goal: bytes

    @classmethod
    def unpack(cls, cdr: Buffer) -> Feedback:
        """Raises ConversionError."""
        return cls(feedback_goal(cdr))


def draw_event(message: ServiceEvent, canvas: Canvas) -> None:
    """An event of a service: which step of a call it is."""
    _log_text(canvas, f"{_STEPS[message.kind]} {message.number}")


def draw_feedback(message: Feedback, canvas: Canvas) -> None:
    """A feedback: of which goal; its values are those of its action."""
    _log_text(canvas, f"goal {message.goal.hex()[:8]} has feedback")


def draw_goals(message: GoalStates, canvas: Canvas) -> None:
    """The states of goals; those that a server has aborted are warnings."""
    states = (f"goal {goal.hex()[:8]} {OUTCOMES.get(status, 'goes on')}" for goal, status in message.goals)
    is_aborted = any(OUTCOMES.get(status) == "aborted" for _, status in message.goals)
    _log_text(canvas, ", ".join(states) or "no goals", _LEVELS[is_aborted])


def _size(size: Sequence[int]) -> str:
    return " x ".join(map(str, size))


def _list(canvas: Canvas, title: str, items: Sequence[str]) -> None:
    items = items or ("none",)
    document = f"**{title}**\n\n" + "\n".join(f"- {item}" for item in items)
    canvas.log(rr.TextDocument(canvas.pen.displayable(document), media_type="text/markdown"))
    canvas.text(_line(f"{title}: {', '.join(items)}"), is_list=True)


def _log_text(canvas: Canvas, text: str, level: str = "INFO") -> None:
    canvas.log(rr.TextDocument(canvas.pen.displayable(text)))
    canvas.text(_line(text), level)


def _line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _MAX_LINE else line[: _MAX_LINE - 1] + "…"
