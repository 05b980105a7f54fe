"""The unit of lengths in the messages of each stream of a session."""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.streams import Streams


class StreamUnits:
    """The unit of each stream: that of its row in the configuration, or of its arm.

    An output has the unit of the stream that it is made of.  Outputs of several streams, such as /tf, and those of
    streams that are not known yet have the unit of the session.

    Args:
        config: the configuration of the session.
        streams: its streams in the order of their appearance: kind, name and type of their entries.
    """

    def __init__(self, config: Config, streams: Iterable[tuple[Kind, str, str]] = ()) -> None:
        self._config = config
        self._streams = Streams(config)
        self._units: dict[tuple[Kind, str], str] = {}
        for request in config.tf_out:
            unit = config.lengths(request).igtl
            self._units[Kind.IGTL_OUT, self._streams.device(request.request().device)] = unit
        for kind, name, type_name in streams:
            self.of(kind, name, type_name)

    def of(self, kind: Kind, name: str, type_name: str) -> str:
        """Return the unit of a stream, a key of ``convert.units.UNITS``.

        Args:
            kind: kind of its entries.
            name: their channel: the topic, or TYPE/device.
            type_name: their type.
        """
        key = (kind, name)
        match kind:
            case Kind.IGTL_IN if key not in self._units:
                igtl_type, _, device = name.partition("/")
                self._units[key] = self._config.lengths(self._config.row_to_ros(igtl_type, device)).igtl
                if shown := self._streams.to_ros(igtl_type, device):
                    for conversion, topic in shown.outputs:
                        if not conversion.topic:
                            self._units.setdefault((Kind.ROS_OUT, topic), shown.lengths.ros)
            case Kind.ROS_IN if key not in self._units:
                row = self._config.row_to_igtl(name)
                self._units[key] = self._config.lengths(row).ros if row else self._config.ros_unit
                if sent := self._streams.to_igtl(name, type_name):
                    self._units.setdefault((Kind.IGTL_OUT, sent.device), sent.lengths.igtl)
            case Kind.IGTL_OUT:
                return self._units.get((kind, name.partition("/")[2]), self._config.igtl_unit)
        return self._units.get(key, self._config.ros_unit)
