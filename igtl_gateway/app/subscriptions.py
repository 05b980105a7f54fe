"""Which topics of the ROS graph a bridge subscribes to: those that it converts, encodes or records."""

from __future__ import annotations

from collections.abc import Callable

from igtl_gateway.base.globs import matches
from igtl_gateway.base.once import Once
from igtl_gateway.base.qos import Qos
from igtl_gateway.gateway import Core
from igtl_gateway.gateway.log.note import Level, Note

#: QoS of topics that are recorded only: the depth covers a burst; the reliability is that of the publishers.
RECORDED = Qos(depth=100)

#: Topics that `--record-all` leaves out, as `ros2 bag record --all` does: hidden topics and those of ROS itself.
_NEVER_RECORDED = ("/parameter_events", "/rosout", "**/_*")


class Subscriptions:
    """Decides for each topic.

    Args:
        gateway: knows the topics that are converted.
        recorded: globs of topics that are recorded in addition.
        on_note: takes notes.

    Attributes:
        encoded: returns the QoS of a topic whose images are encoded as VIDEO.
    """

    def __init__(self, gateway: Core, recorded: tuple[str, ...], on_note: Callable[[Note], None]) -> None:
        self.encoded: Callable[[str, str], Qos | None] = _not_encoded
        self._gateway = gateway
        self._recorded = recorded
        self._on_note = on_note
        self._noted = Once()  # topic and type of the reported topics without a conversion

    def wanted(self, topic: str, ros_type: str) -> Qos | None:
        """Return the QoS for a discovered topic, or None if it is not subscribed to.

        Reports a topic once if the configuration names it, but no conversion for its type exists.
        """
        lacks = self._gateway.lacks_conversion(topic, ros_type) and self.encoded(topic, ros_type) is None
        if lacks and self._noted.first(topic, ros_type):
            text = f"{topic} is not sent to OpenIGTLink: no conversion for {ros_type}"
            self._on_note(Note(Level.WARN, "no_conversion", text, topic))
        return self.qos(topic, ros_type)

    def qos(self, topic: str, ros_type: str) -> Qos | None:
        """Return the QoS for a topic that is bridged or recorded, else None."""
        bridged = self._gateway.subscription(topic, ros_type) or self.encoded(topic, ros_type)
        if bridged or any(matches(glob, topic) for glob in _NEVER_RECORDED):
            return bridged
        return RECORDED if any(matches(glob, topic) for glob in self._recorded) else None


def _not_encoded(_topic: str, _type: str) -> Qos | None:
    """No images are encoded."""
    return None
