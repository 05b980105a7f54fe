"""The services that the gateway offers, as messages that need no ROS, and their calls over Zenoh.

A call is a query on the key of the service; its reply has the sequence number and the gid of the call.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import MISSING, dataclass, fields
from threading import Semaphore
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar

from igtl_gateway.addon import Clock
from igtl_gateway.addon.messages import definition_folder
from igtl_gateway.addon.reading import Level
from igtl_gateway.addon.ros import (
    BOOL,
    STRING,
    UINT8,
    MarkRequest,
    MarkResponse,
    MetadataItem,
    SendCommandRequest,
    SendCommandResponse,
    Struct,
)
from igtl_gateway.addon.ros_side import Reports
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files
from igtl_gateway.addons.zenoh.names import attachment, read_attachment

#: Calls that run at once, and calls that wait or run; further ones are refused.
_CALLS_AT_ONCE = 8
_CALLS_WAITING = 100
#: Largest request.
_REQUEST_BYTES = 16 << 20


@dataclass(frozen=True, slots=True)
class TriggerRequest(Struct):
    """std_srvs/srv/Trigger, the call: a message without fields has one byte."""

    TYPE: ClassVar[str] = "std_srvs/srv/Trigger_Request"
    nothing: Annotated[int, UINT8] = 0


@dataclass(frozen=True, slots=True)
class TriggerResponse(Struct):
    """std_srvs/srv/Trigger, the answer."""

    TYPE: ClassVar[str] = "std_srvs/srv/Trigger_Response"
    success: Annotated[bool, BOOL] = False
    message: Annotated[str, STRING] = ""


@dataclass(frozen=True, slots=True)
class Service:
    """A type of services.

    Attributes:
        name: ``package/srv/Name``.
        request, response: the messages.
        text: the definition; "": that of the file of igtl_msgs.
    """

    name: str
    request: type[Struct]
    response: type[Struct]
    text: str = ""

    @property
    def definition(self) -> str:
        """The ``.srv`` text."""
        package, _, own = self.name.split("/")
        return self.text or files.read_bytes(definition_folder(package) / "srv" / f"{own}.srv").decode()


#: By type.
SERVICES = {
    each.name: each
    for each in (
        Service("std_srvs/srv/Trigger", TriggerRequest, TriggerResponse, "---\nbool success\nstring message\n"),
        Service("igtl_msgs/srv/Mark", MarkRequest, MarkResponse),
        Service("igtl_msgs/srv/SendCommand", SendCommandRequest, SendCommandResponse),
    )
}

#: Python classes of messages that callers of a service fill in.
MESSAGES: dict[str, type[Struct]] = {MetadataItem.TYPE: MetadataItem}

Answer = Callable[[Any, Any], Any]


class Calls:
    """Answers the calls of all services of a node, in threads of its own.

    Args:
        reports: takes the notes.
        clock: source of the time of replies.
    """

    def __init__(self, reports: Reports, clock: Clock) -> None:
        self._reports = reports
        self._clock = clock
        self._free = Semaphore(_CALLS_WAITING)
        self._threads = ThreadPoolExecutor(_CALLS_AT_ONCE, thread_name_prefix="igtl-zenoh-call")

    def handler(self, name: str, service: Service, answer: Answer) -> Callable[[Any], None]:
        """Return what Zenoh calls with each query of a service."""

        def on_query(query: Any) -> None:
            if not self._free.acquire(blocking=False):
                self._refuse(name, query, f"more than {_CALLS_WAITING} calls wait")
                return
            try:
                self._threads.submit(self._answer, name, service, answer, query)
            except RuntimeError:  # at stop
                self._free.release()

        return on_query

    def stop(self) -> None:
        """End the threads; calls that run are waited for: their owner has ended what they wait for."""
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _answer(self, name: str, service: Service, answer: Answer, query: Any) -> None:
        try:
            sequence, _, of_gid = read_attachment(query.attachment.to_bytes() if query.attachment else b"")
            payload = query.payload
            if payload is None or len(payload) > _REQUEST_BYTES:
                found = 0 if payload is None else len(payload)
                raise ValueError(f"found a request of {counted(found, 'byte')}, expected {service.request.TYPE}")
            request = service.request.unpack(payload.to_bytes())
            response: Any = service.response
            usual = {each.name: None if each.default is MISSING else each.default for each in fields(response)}
            filled = answer(request, SimpleNamespace(**usual))
            values = {each: getattr(filled, each) for each in usual}
            values |= {each: tuple(value) for each, value in values.items() if isinstance(value, list)}
            reply = response(**values).pack()
            query.reply(query.key_expr, reply, attachment=attachment(sequence, self._clock.utc_ns(), of_gid))
        except Exception as error:  # of a foreign request, or of the middleware: this call has no answer
            self._refuse(name, query, str(error))
        finally:
            self._free.release()

    def _refuse(self, name: str, query: Any, why: str) -> None:
        self._reports.note_once(Level.WARN, "ros_call_refused", f"{name}: call refused: {why}", name)
        try:
            query.reply_err(why.encode())
        except Exception as error:  # the caller is gone, or the session is closed
            self._reports.callback_failed(name, error, name)
