"""Services whose requests and responses are serialised messages: servers that answer later or never, and clients."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any

from igtl_gateway.base.errors import RosError
from igtl_gateway.base.quantities import count_text
from igtl_gateway.convert.exchanges import SERVICE_EVENT, action_of
from igtl_gateway.edges.ros.middleware import interface_class
from igtl_gateway.edges.ros.node import RosNode

#: Requests that wait in a server's queue; of a client that wait for their responses.
_WAITING, _UNANSWERED = 1_000, 10_000

#: Sends the response to a request, CDR, from any thread.
Answer = Callable[[bytes], None]


def serve_later(node: RosNode, name: str, type_name: str, on_request: Callable[[bytes, Answer], None]) -> None:
    """Offer a service.

    Args:
        node: the node.
        name: of the service.
        type_name: ``package/srv/Name``, or that of a service of an action: ``package/action/Name_SendGoal``.
        on_request: called with a request, CDR, and what sends the response, in a thread of the executor.

    Raises UnknownTypeError, and other errors of rclpy.
    """
    service_type = interface_class(type_name)
    serialization, lock = node.rclpy.serialization, threading.Lock()
    with node.lock:
        service = node.handle.create_service(
            service_type,
            name,
            lambda request, _response: request,
            qos_profile=node.rclpy.qos.QoSProfile(depth=_WAITING),
            callback_group=node.rclpy.callback_groups.ReentrantCallbackGroup(),
        )
    respond = service.send_response

    def take(request: Any, header: Any) -> None:
        def answer(data: bytes) -> None:
            response = serialization.deserialize_message(data, service_type.Response)
            with lock:  # rcl has none for it
                respond(response, header)

        on_request(bytes(serialization.serialize_message(request)), answer)

    # rclpy sends what the callback returns, at once and always: this takes the request instead
    service.send_response = take


class Caller:
    """A client that sends the requests of events of service introspection.

    Args:
        node: the node.
        name: of the service.
        event_type: ``package/srv/Name_Event``, or of a service of an action.
        goals: recorded ids of goals → their ids now, for the clients of one action: a server takes an id once.

    Attributes:
        sent, answered: numbers of requests.

    Raises UnknownTypeError, and other errors of rclpy.
    """

    def __init__(self, node: RosNode, name: str, event_type: str, goals: dict[bytes, bytes]) -> None:
        self.name = name
        self.sent = self.answered = 0
        self._node, self._goals = node, goals
        self._part = (action_of(f"{name}{SERVICE_EVENT}") or (None, None))[1]
        self._event_type = interface_class(event_type)
        with node.lock:
            self._client = node.handle.create_client(
                interface_class(event_type.removesuffix("_Event")),
                name,
                qos_profile=node.rclpy.qos.QoSProfile(depth=_WAITING),
                callback_group=node.rclpy.callback_groups.ReentrantCallbackGroup(),
            )

    @property
    def is_ready(self) -> bool:
        """Whether there is a server."""
        return bool(self._client.service_is_ready())

    def call(self, event: bytes) -> None:
        """Send the request of an event, CDR.

        Raises RosError: no server, or too many requests without responses.
        """
        if not self.is_ready:
            raise RosError("no node offers the service")
        if self.sent - self.answered >= _UNANSWERED:
            raise RosError(f"{count_text(_UNANSWERED, 'request')} have no response yet")
        (request,) = self._node.rclpy.serialization.deserialize_message(event, self._event_type).request
        self._renew_goal(request)
        self.sent += 1
        self._client.call_async(request).add_done_callback(self._on_answer)

    def _on_answer(self, _future: object) -> None:
        self.answered += 1
        self._node.notify()

    def _renew_goal(self, request: Any) -> None:
        """Replace the id of a goal by that of this replay; the request of a goal begins a new one."""
        if self._part is None:
            return
        about = request.goal_info.goal_id if self._part == "cancel_goal" else request.goal_id
        recorded = about.uuid.tobytes()
        if self._part == "send_goal":
            self._goals[recorded] = os.urandom(len(recorded))
        about.uuid = list(self._goals.get(recorded, recorded))
