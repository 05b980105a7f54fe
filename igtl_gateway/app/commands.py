"""The service ``~/send_command``: one call sends a COMMAND and waits for its reply.

It is a thin layer over the topics.  A call is converted to a message on the command topic, which any node could
publish; its result is the first reply with its id.  So recordings and replays need no support for services.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from igtl_gateway.base.errors import RosError
from igtl_gateway.config.configuration import OUT_PREFIX
from igtl_gateway.convert.igtl_msgs import Command, CommandReply, MetadataItem
from igtl_gateway.convert.names import topic_token
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note

SERVICE = "~/send_command"
SERVICE_TYPE = "igtl_msgs/srv/SendCommand"

#: Range of the ids of calls; the gateway assigns lower ids to commands without one.
_FIRST_ID, _LAST_ID = 0x8000_0000, 0xFFFF_FFFF
#: Wait after the deadline of a command.  The gateway answers at the deadline at the latest, unless it was stopped.
_GRACE_S = 5.0

#: Passes (topic, type, CDR bytes) to the hub.
Publish = Callable[[str, str, bytes], None]


class CommandService:
    """Answers the calls of the service.  The caller must pass every entry of the log to `on_entry`.

    Args:
        side: offers the service.
        publish: passes a ROS message to the gateway.
        timeout_s: timeout of calls that do not set one, in seconds.
        on_note: takes notes.
    """

    def __init__(self, side: RosSide, publish: Publish, timeout_s: float, on_note: Callable[[Note], None]) -> None:
        self._side = side
        self._publish = publish
        self._item: Callable[..., Any] = MetadataItem  # that of ROS, from the start on
        self._timeout_s = timeout_s
        self._on_note = on_note
        self._lock = threading.Lock()
        self._last_id = _LAST_ID
        self._replies: dict[int, CommandReply | None] = {}
        self._answered = threading.Condition(self._lock)
        self._stopped = False

    def start(self) -> None:
        """Offer the service, if its messages are installed."""
        try:
            self._item = self._side.message_class(MetadataItem.TYPE)
        except RosError as error:
            self._on_note(Note(Level.WARN, "no_interfaces", f"no command service and no igtl_msgs: {error}"))
            return
        self._side.serve(SERVICE, SERVICE_TYPE, self.call)

    def call(self, request: Any, response: Any) -> Any:
        """Send the command of a request and fill in the response.  Runs in a thread of its own."""
        timeout_s = float(request.timeout) if 0 < request.timeout < float("inf") else self._timeout_s
        reply = self.send_and_wait(
            Command(
                Header(),
                request.device_name,
                self._new_id(),
                request.name,
                0,
                request.content,
                tuple(MetadataItem(item.key, item.encoding, item.value) for item in request.metadata),
                request.link,
                timeout_s,
            )
        )
        response.status = reply.status
        response.error_message = reply.error_message
        response.content = reply.content
        response.link = reply.link
        response.metadata = [
            self._item(key=item.key, encoding=item.encoding, value=item.value) for item in reply.metadata
        ]
        return response

    def send_and_wait(self, command: Command) -> CommandReply:
        """Send a command, wait, and return its reply; at a timeout or stop a reply with the status TIMEOUT."""
        topic = f"{OUT_PREFIX}{topic_token(command.device_name or 'command')}/command"
        with self._lock:
            self._replies[command.id] = None
        try:
            self._publish(topic, command.TYPE, command.pack())
            with self._lock:
                self._answered.wait_for(
                    lambda: self._stopped or self._replies[command.id] is not None, command.timeout + _GRACE_S
                )
                reply = self._replies[command.id]
        finally:
            with self._lock:
                del self._replies[command.id]
        text = "the gateway stopped" if self._stopped else "no answer from the gateway"
        return reply or CommandReply(
            Header(), command.device_name, command.id, command.name, CommandReply.TIMEOUT, text
        )

    def on_entry(self, entry: Entry) -> None:
        """Receive an entry of the log; a reply to a waiting call ends its wait."""
        if entry.kind is not Kind.ROS_OUT or entry.type != CommandReply.TYPE or not self._replies:
            return
        reply = CommandReply.unpack(entry.payload[0])
        with self._lock:
            if reply.id in self._replies and self._replies[reply.id] is None:
                self._replies[reply.id] = reply
                self._answered.notify_all()

    def stop(self) -> None:
        """End the wait of all calls."""
        with self._lock:
            self._stopped = True
            self._answered.notify_all()

    def _new_id(self) -> int:
        with self._lock:
            self._last_id = self._last_id + 1 if self._last_id < _LAST_ID else _FIRST_ID
            return self._last_id
