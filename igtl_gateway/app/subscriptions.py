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

#: What ``--record-all`` records: as ``ros2 bag record --all``, all topics, services and actions.
EVERYTHING = ("**", "**/_service_event", "**/_action/**")
#: Topics of ROS itself, which are recorded if they are named.
_OF_ROS = ("/parameter_events", "/rosout")
#: Beginning of a hidden level of a topic: of actions, and of events of services.
_HIDDEN = "/_"


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
        return bridged or (RECORDED if any(names(glob, topic) for glob in self._recorded) else None)


def names(glob: str, topic: str) -> bool:
    """Return whether a glob selects a topic for recording.

    A topic is hidden if any of its levels begins with ``_``.  A glob without such a level selects none of them, as in a
    shell, and no wildcard selects a topic of ROS itself: a glob names them.  ``/fib/_action/**`` selects all topics of
    an action; ``/fib/**`` does not.
    """
    if topic in _OF_ROS:
        return glob == topic
    return (_HIDDEN in glob or _HIDDEN not in topic) and matches(glob, topic)


def _not_encoded(_topic: str, _type: str) -> Qos | None:
    """No images are encoded."""
    return None
