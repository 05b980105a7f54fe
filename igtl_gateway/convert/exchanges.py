"""Services and actions as topics: the events of service introspection, and the topics of an action.

A service with introspection publishes ``service_msgs/ServiceEventInfo`` and the contents on ``SERVICE/_service_event``,
as client and as server.  An action is three services and two topics below ``ACTION/_action/``.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import ros_to_ns

#: Ends of the topics of services, and what stands before the parts of an action.
SERVICE_EVENT, IN_ACTION = "/_service_event", "/_action/"
#: The parts of an action: its services, then its topics.
ACTION_SERVICES, ACTION_TOPICS = ("send_goal", "cancel_goal", "get_result"), ("feedback", "status")
#: Kinds of events, by their numbers.
REQUEST_SENT, REQUEST_RECEIVED, RESPONSE_SENT, RESPONSE_RECEIVED = range(4)
#: Ends of goals in action_msgs/GoalStatus.
OUTCOMES = {4: "succeeded", 5: "canceled", 6: "aborted"}

#: Bytes of the encapsulation before the values of a message, and of the id of a goal.
HEAD, ID = 4, 16
# kind, seconds, nanoseconds, client, number; then both contents, each as a sequence of 0 or 1
_INFO = {1: struct.Struct("<4xB3xiI16s4xq"), 0: struct.Struct(">4xB3xiI16s4xq")}
_COUNT = {1: struct.Struct("<I"), 0: struct.Struct(">I")}


def service_of(topic: str) -> str:
    """Return the service whose events a topic has; ``""`` of other topics."""
    return topic.removesuffix(SERVICE_EVENT) if topic.endswith(SERVICE_EVENT) else ""


def action_of(topic: str) -> tuple[str, str] | None:
    """Return the action of a topic and which part of it the topic is; None of other topics."""
    action, found, part = topic.rpartition(IN_ACTION)
    service = service_of(f"/{part}").removeprefix("/")
    if not found or not action:
        return None
    return (action, service or part) if service in ACTION_SERVICES or part in ACTION_TOPICS else None


@dataclass(frozen=True, slots=True)
class ServiceEvent:
    """A message of the type ``package/srv/Name_Event``, without the content of its request.

    Attributes:
        kind: ``REQUEST_SENT``, ….
        stamp_ns: when it happened, UTC ns.
        client: the client, 16 bytes.
        number: of the request, for this client.
        has_request: whether it has the content of a request, which introspection can leave out.
        goal: what the content of a request begins with: of a service of an action, the id of a goal.
        response: the content of the response as a message of its own, CDR; None without one.
    """

    kind: int
    stamp_ns: int
    client: bytes
    number: int
    has_request: bool
    goal: bytes
    response: bytes | None

    @classmethod
    def unpack(cls, cdr: Buffer) -> ServiceEvent:
        """Raises ConversionError for bytes without an event, and for one with two requests."""
        data = bytes(cdr)
        order = data[1] if len(data) > 1 else 1
        if data[:1] != b"\0" or order not in _INFO or len(data) < _INFO[order].size + 2 * _COUNT[order].size:
            raise ConversionError(f"found {counted(len(data), 'byte')}, expected an event of a service")
        info, count = _INFO[order], _COUNT[order]
        kind, seconds, rest_ns, client, number = info.unpack_from(data)
        (requests,) = count.unpack_from(data, info.size)
        # with a request, the number of responses is behind its content
        responses = 0 if requests else count.unpack_from(data, info.size + count.size)[0]
        if kind > RESPONSE_RECEIVED or max(requests, responses) > 1:
            raise ConversionError(
                f"found an event of kind {kind} with {counted(requests, 'request')} and "
                f"{counted(responses, 'response')}, expected a kind up to {RESPONSE_RECEIVED} and at most one of each"
            )
        # behind both counts a content begins at a multiple of 8 bytes, so it is aligned as in a message of its own
        response = data[:HEAD] + data[info.size + 2 * count.size :] if responses else None
        at = info.size + count.size
        goal = data[at : at + ID] if requests else b""
        return cls(kind, ros_to_ns(seconds, rest_ns), client, number, requests == 1, goal, response)


def feedback_goal(cdr: Buffer) -> bytes:
    """Return the id of the goal of a feedback.  Raises ConversionError."""
    goal = bytes(cdr[HEAD : HEAD + ID])
    if len(goal) < ID:
        raise ConversionError(f"found {counted(len(cdr), 'byte')}, expected the feedback of a goal")
    return goal


def goal_states(cdr: Buffer) -> list[tuple[bytes, int]]:
    """Return id and status of each goal of an action_msgs/msg/GoalStatusArray.  Raises ConversionError."""
    data = bytes(cdr)
    order = data[1] if len(data) > 1 else 1
    if data[:1] != b"\0" or order not in _COUNT or len(data) < HEAD + 4:
        raise ConversionError(f"found {counted(len(data), 'byte')}, expected the states of goals")
    (count,) = _COUNT[order].unpack_from(data, HEAD)
    found: list[tuple[bytes, int]] = []
    at = HEAD + 4  # of a goal: an id, a time aligned to 4 bytes, and a byte
    for _ in range(count):
        end = (at + ID + 3) // 4 * 4 + 8
        if end >= len(data):
            raise ConversionError(f"found {counted(len(data), 'byte')}, expected {counted(count, 'state')} of goals")
        found.append((data[at : at + ID], data[end]))
        at = end + 1
    return found
