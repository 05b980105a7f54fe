"""The service ``~/mark``: one call makes a mark, and the answer has the reason if that was not possible."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import GatewayError, RosError
from igtl_gateway.base.stamp import ros_to_ns
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.gateway.log.marks import MarkNote, ago_of_stamp

SERVICE = "~/mark"
SERVICE_TYPE = "igtl_msgs/srv/Mark"
#: Who makes the marks of ROS that name no person.
WHO = "ros"


class MarkService:
    """A part: answers the calls of the service.

    Args:
        side: offers the service.
        mark: makes a mark, see ``Bridge.mark``.
        clock: that of stamps.
    """

    def __init__(self, side: RosSide, mark: Callable[[MarkNote], None], clock: Clock) -> None:
        self._side = side
        self._mark = mark
        self._clock = clock

    def start(self) -> None:
        """Offer the service, if its messages are installed; `commands` reports it if not."""
        try:
            self._side.message_class(MetadataItem.TYPE)
        except RosError:
            return
        self._side.serve(SERVICE, SERVICE_TYPE, self.call)

    def stop(self) -> None:
        """It ends with the node."""

    def call(self, request: Any, response: Any) -> Any:
        """Make the mark of a request and fill in the response."""
        try:
            since_ns = ago_of_stamp(_stamp_ns(request), self._clock.utc_ns())
            self._mark(MarkNote(request.label, request.text, request.who or WHO, request.phase, since_ns))
            response.success, response.message = True, ""
        except GatewayError as error:
            response.success, response.message = False, str(error)
        return response


def _stamp_ns(request: Any) -> int:
    """Return the stamp of a request of Zenoh, whose class is ours, or of ROS; 0 without one, as in older packages."""
    stamp = getattr(request, "stamp", None)
    return ros_to_ns(stamp.sec, stamp.nanosec) if stamp else getattr(request, "stamp_ns", 0)
